"""`pip install .` into an environment of its own, outside the checkout, which is what a wheel is for."""

import os
import shutil
import subprocess
import sys
import venv
from pathlib import Path

import numpy
import pytest

CHECKOUT = Path(__file__).resolve().parents[2]
SOURCES = ("pyproject.toml", "setup.py", "README.md", "LICENSE", "NOTICE", "forgetmimic_jax", "robots", "data")
TINY = [
    *("ppo.num_envs=8", "ppo.branches=2", "ppo.num_steps=4", "ppo.epochs=1", "ppo.minibatches=2"),
    "max_episode_steps=20",
]


def run(*command: object, **options) -> str:
    """What a command prints; its whole output where it fails."""
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True, **options)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def environment(tmp_path_factory) -> Path:
    """A virtual environment with the built wheel; the dependencies are those of the Python that runs the tests."""
    folder = tmp_path_factory.mktemp("installed")
    source = folder / "source"
    source.mkdir()
    for name in SOURCES:
        if (CHECKOUT / name).is_dir():
            shutil.copytree(CHECKOUT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(CHECKOUT / name, source)
    offline = ("--quiet", "--disable-pip-version-check", "--no-index", "--no-deps")
    run(sys.executable, "-m", "pip", "wheel", *offline, "--no-build-isolation", "--wheel-dir", folder, source)
    shutil.rmtree(source)

    environment = folder / "environment"
    venv.create(environment)
    (wheel,) = folder.glob("*.whl")
    run(sys.executable, "-m", "pip", "--python", environment / "bin/python", "install", *offline, wheel)
    (packages,) = environment.glob("lib/*/site-packages")
    dependencies = Path(numpy.__file__).parents[1]
    (packages / "dependencies.pth").write_text(f"{dependencies}\n")  # comes after the package itself
    return environment


def test_an_installed_package_unlearns_outside_the_checkout(environment, tmp_path):
    cached = {"XDG_CACHE_HOME": str(tmp_path / "cache"), "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    settings = os.environ | cached
    for name in ("MAKELEVEL", "PYTHONPATH"):
        settings.pop(name, None)
    work = tmp_path / "work"
    work.mkdir()
    there = run(environment / "bin/python", "-c", "import forgetmimic_jax as f; print(f.__file__)", cwd=work)
    assert Path(there.strip()).is_relative_to(environment)
    before = {path for path in environment.rglob("*") if path.suffix != ".pyc" and path.name != "__pycache__"}

    program = environment / "bin/forgetmimic"
    printed = run(
        *(program, "unlearn", "--robot", "g1", "--iterations", "2", "--episodes", "1", "--set", *TINY),
        cwd=work,
        env=settings,
    )
    evaluation = work / "runs/unlearn-g1-001/evaluation.json"
    assert evaluation.is_file()
    last = "runs/unlearn-g1-001/checkpoints/00000002"
    assert f"Next: forgetmimic evaluate --robot g1 --checkpoint {last} --episodes 100" in printed
    assert (work / last).is_dir()
    assert any((tmp_path / "cache/forgetmimic-jax/jax").iterdir())
    after = {path for path in environment.rglob("*") if path.suffix != ".pyc" and path.name != "__pycache__"}
    assert after == before  # nothing is written where the package is


def test_an_installed_package_has_every_robot_clip_and_base(environment):
    """File by file what the checkout has, and the page of the report."""
    (package,) = environment.glob("lib/*/site-packages/forgetmimic_jax")
    for folder in ("robots", "data"):
        ours = {path.relative_to(CHECKOUT) for path in (CHECKOUT / folder).rglob("*") if path.is_file()}
        theirs = {
            path.relative_to(package / "shipped")
            for path in (package / "shipped" / folder).rglob("*")
            if path.is_file()
        }
        assert theirs == ours
    for page in (CHECKOUT / "forgetmimic_jax").rglob("*.html"):
        assert (package.parent / page.relative_to(CHECKOUT)).is_file()
