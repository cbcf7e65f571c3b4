"""A library to draw with that is missing breaks no command that draws nothing."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from forgetmimic_jax.basics.drawing import CHOICE, chosen_library, draw_later

MISSING = ("egl", "glfw", "osmesa", "nonsense")
# As in a container without such a library, whatever this machine has.
IMPORTS = """
import sys
for name in ("glfw", "OpenGL"):
    class Missing:
        def __getattr__(self, attribute):
            raise OSError(f"lib{name} is missing")
    sys.modules[name] = Missing()
from forgetmimic_jax.basics.errors import run_command
def work():
    import forgetmimic_jax.training.run, forgetmimic_jax.evaluation.evaluate, forgetmimic_jax.viewing.offscreen
    print("ready")
run_command(work)
"""


@pytest.mark.parametrize("library", MISSING)
def test_a_library_that_is_missing_breaks_no_command(library):
    environment = os.environ | {"MUJOCO_GL": library}
    environment.pop(CHOICE, None)
    program = [sys.executable, "-m", "forgetmimic_jax", "train", "--help"]
    listed = subprocess.run(program, env=environment, capture_output=True, text=True)
    assert (listed.returncode, listed.stderr) == (0, "")
    done = subprocess.run([sys.executable, "-c", IMPORTS], env=environment, capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, "ready\n", "")


WORKER = """
from pathlib import Path
from forgetmimic_jax.basics.provenance import provenance
from forgetmimic_jax.studies.task import Task, run_task
print(run_task(Task(Path("trial").resolve(), "report", (), 1), Path.cwd(), provenance().code, 1))
"""


@pytest.mark.parametrize("program", [("-m", "experiments.claims", "--help"), ("-c", WORKER)])
def test_it_breaks_no_study_and_no_worker_of_a_cluster(program, tmp_path):
    environment = os.environ | {"MUJOCO_GL": "nonsense", "PYTHONPATH": str(Path(__file__).parents[2])}
    environment.pop(CHOICE, None)
    done = subprocess.run([sys.executable, *program], env=environment, capture_output=True, text=True, cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert "MUJOCO_GL" not in done.stdout


def test_what_draws_still_knows_the_users_choice(monkeypatch):
    monkeypatch.setenv(CHOICE, "")  # so that what this test sets is undone after it
    monkeypatch.delenv(CHOICE)
    monkeypatch.setenv("MUJOCO_GL", "EGL")
    assert chosen_library() == "egl"
    for _ in range(2):  # a second command of the process, or a process of the command
        draw_later()
        assert (os.environ["MUJOCO_GL"], chosen_library()) == ("disable", "egl")
