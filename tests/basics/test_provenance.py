import dataclasses
import os
import platform
import re
import subprocess
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace

import jax
import mujoco
import pytest

from forgetmimic_jax.basics import provenance as module
from forgetmimic_jax.basics.provenance import PACKAGE, code_hash, commit, made_here, provenance


def git(folder: Path, *arguments: str) -> str:
    name = ("-c", "user.name=A", "-c", "user.email=a@example.org")
    return subprocess.run(
        ["git", "-C", folder, *name, *arguments], check=True, capture_output=True, text=True
    ).stdout.strip()


@pytest.fixture
def package(tmp_path) -> Path:
    """A committed checkout of a package with its robots and studies."""
    for name in ("forgetmimic_jax/__init__.py", "robots/g1.yaml", "experiments/a.py", "experiments/a.md", "README.md"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("old\n")
    git(tmp_path, "init", "--quiet")
    git(tmp_path, "add", "--all")
    git(tmp_path, "commit", "--quiet", "--message", "first")
    return tmp_path / "forgetmimic_jax"


def test_a_checkout_gives_its_commit(package):
    assert commit(package) == git(package, "rev-parse", "HEAD")


@pytest.mark.parametrize(
    ("file", "marked"),
    [
        ("forgetmimic_jax/__init__.py", True),
        ("forgetmimic_jax/new.py", True),  # which git does not know
        ("robots/g1.yaml", True),
        ("experiments/a.py", True),
        ("experiments/a.md", False),  # what a study writes is not code
        ("README.md", False),
    ],
)
def test_changed_code_is_marked(package, file, marked):
    (package.parent / file).write_text("new\n")
    assert commit(package) == git(package, "rev-parse", "HEAD") + ("+changes" if marked else "")


def test_a_package_that_is_installed_inside_a_checkout_gives_its_version(package):
    installed = package.parent / "environment" / "forgetmimic_jax"
    installed.mkdir(parents=True)
    (installed / "__init__.py").touch()
    assert commit(installed) == version("forgetmimic-jax")


def test_without_git_the_version_is_given(package, monkeypatch):
    monkeypatch.setenv("PATH", "")
    assert commit(package) == version("forgetmimic-jax")


def test_a_repository_without_a_commit_gives_the_version(tmp_path):
    git(tmp_path, "init", "--quiet")
    package = tmp_path / "forgetmimic_jax"
    package.mkdir()
    (package / "__init__.py").touch()
    git(tmp_path, "add", "--all")
    assert commit(package) == version("forgetmimic-jax")


def test_the_code_is_the_content_of_its_python_files(package):
    before = code_hash(package)
    assert re.fullmatch("[0-9a-f]{8}", before)
    (package / "page.html").write_text("<p>")
    (package.parent / "experiments" / "a.py").write_text("new")
    git(package.parent, "commit", "--quiet", "--all", "--message", "other files")
    assert code_hash(package) == before
    found = {before}
    for name, text in (("__init__.py", "new\n"), ("inner/a.py", ""), ("inner/b.py", "")):
        (package / name).parent.mkdir(exist_ok=True)
        (package / name).write_text(text)
        found.add(code_hash(package))
    (package / "inner" / "b.py").rename(package / "inner" / "c.py")
    found.add(code_hash(package))
    assert len(found) == 5


def test_this_process(monkeypatch):
    found = provenance()
    assert (found.jax, found.mujoco) == (jax.__version__, mujoco.__version__)
    assert (found.python, found.code) == (platform.python_version(), code_hash(PACKAGE))
    assert found.processor
    assert 1 <= found.cores <= os.cpu_count()
    if hasattr(os, "sched_getaffinity"):
        monkeypatch.setattr(os, "sched_getaffinity", lambda process: {0, 3, 5})
        assert module.cores() == 3


def test_an_accelerator_stands_before_the_processor(monkeypatch):
    assert made_here() == provenance()
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(jax, "devices", lambda: [SimpleNamespace(device_kind="Abacus")])
    assert made_here() == dataclasses.replace(provenance(), processor=f"Abacus, {provenance().processor}")


@pytest.mark.parametrize(
    ("plugin", "environment", "expected"),
    [
        ("xla_cuda12", {}, ["0", "1"]),
        ("xla_cuda12", {"JAX_PLATFORMS": "cuda,cpu", "CUDA_VISIBLE_DEVICES": "3, GPU-7"}, ["3", "GPU-7"]),
        ("xla_cuda12", {"CUDA_VISIBLE_DEVICES": "3,-1,4"}, ["3"]),
        ("xla_cuda12", {"CUDA_VISIBLE_DEVICES": ""}, []),
        ("xla_cuda12", {"JAX_PLATFORMS": "cpu"}, []),
        ("xla_cuda12", {"PATH": ""}, []),  # no nvidia-smi
        ("another", {}, []),
    ],
)
def test_the_gpus_that_jax_would_take(tmp_path, monkeypatch, plugin, environment, expected):
    tool = tmp_path / "nvidia-smi"
    tool.write_text(
        "#!/bin/sh\necho 'GPU 0: A (UUID: GPU-1)'\necho '  MIG 1g Device 0: (UUID: MIG-2)'\necho 'GPU 1: A'\n"
    )
    tool.chmod(0o755)
    monkeypatch.setattr(module, "entry_points", lambda group: [SimpleNamespace(name=plugin)])
    for name in ("JAX_PLATFORMS", "CUDA_VISIBLE_DEVICES"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    assert module.gpus() == expected
