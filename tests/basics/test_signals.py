import os
import signal
import subprocess
import sys
import time

import pytest

from forgetmimic_jax.basics.signals import second_signal_ends, stop_requests

# The main thread waits in XLA, where no handler of Python runs.
STUCK = """
import jax, jax.numpy as jnp, time
from forgetmimic_jax.basics.errors import run_command
from forgetmimic_jax.basics.signals import stop_requests
from forgetmimic_jax.physics.host_call import HostFunction

def never(x):
    print("computing", flush=True)
    time.sleep(600)

def command():
    with stop_requests():
        x = jnp.zeros(3)
        wait = HostFunction(never, (jax.ShapeDtypeStruct((3,), jnp.float32),), b"never")
        jax.block_until_ready(jax.jit(wait)(x))

run_command(command)
"""


@pytest.mark.parametrize(
    ("first", "second", "code"),
    [(signal.SIGINT, signal.SIGINT, 130), (signal.SIGTERM, signal.SIGTERM, 143), (signal.SIGINT, signal.SIGTERM, 143)],
)
def test_the_second_signal_ends_a_process_that_waits_for_xla(first, second, code):
    process = subprocess.Popen([sys.executable, "-c", STUCK], stdout=-1, stderr=-1, text=True)
    try:
        assert process.stdout.readline() == "computing\n"
        process.send_signal(first)
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(timeout=1)
        process.send_signal(second)
        said = process.communicate(timeout=60)
    finally:
        process.kill()
    assert said == ("", "stopped at once; what was saved before is kept\n")
    assert process.returncode == code


def test_a_first_signal_is_a_request_and_the_handlers_come_back():
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    with second_signal_ends(), stop_requests() as stop:
        os.kill(os.getpid(), signal.SIGTERM)
        deadline = time.monotonic() + 60.0
        while not stop and time.monotonic() < deadline:
            time.sleep(0.01)
    assert stop == [signal.SIGTERM]
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before
    assert signal.set_wakeup_fd(-1) == -1
