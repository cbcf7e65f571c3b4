import os
import subprocess
import sys

import pytest

FLAG = "--xla_cpu_multi_thread_eigen"


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (None, f"{FLAG}=false"),
        ("--xla_dump_to=x", f"--xla_dump_to=x {FLAG}=false"),
        (f"{FLAG}=true", f"{FLAG}=true"),
        (f"{FLAG}=false --xla_dump_to=x", f"{FLAG}=false --xla_dump_to=x"),
    ],
    ids=["unset", "another flag", "the user's own", "already so"],
)
def test_import_sets_the_flag_unless_the_user_has(given, expected):
    environment = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    if given is not None:
        environment["XLA_FLAGS"] = given
    code = "import forgetmimic_jax, os, sys; print(os.environ['XLA_FLAGS']); print('jax' in sys.modules)"
    output = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert output.stdout.splitlines() == [expected, "False"]  # in time: jax reads it when it first starts
