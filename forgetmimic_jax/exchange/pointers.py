"""Git LFS pointers: small texts that stand for large files until these are fetched."""

from __future__ import annotations

from pathlib import Path

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.motion.readers import LFS


def check_no_pointer(path: Path) -> None:
    """InputError if a file is a pointer; one that does not exist is none."""
    if path.is_file():
        with path.open("rb") as file:
            if file.read(len(LFS)) == LFS:
                raise InputError(f"{path}: this is a Git LFS pointer, not the file: run git lfs pull")
