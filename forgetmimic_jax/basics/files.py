"""Files that appear whole or not at all, and files of one JSON object a line, such as metrics.jsonl."""

from __future__ import annotations

import contextlib
import json
import os
import sys
import tempfile
import warnings
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from forgetmimic_jax.basics.errors import InputError

POINTER = b"version https://git-lfs"  # how a Git LFS pointer begins


def check_no_pointer(path: Path) -> None:
    """InputError if a file is a Git LFS pointer, a small text in its place; one that is not there is none."""
    if path.is_file():
        with path.open("rb") as file:
            if file.read(len(POINTER)) == POINTER:
                raise InputError(f"{path}: this is a Git LFS pointer, not the file: run git lfs pull")


@contextlib.contextmanager
def readable(path: Path, kind: str) -> Iterator[None]:
    """Inside, whatever the readers of archives, arrays and pickles raise becomes InputError: no readable `kind`.

    They raise almost anything for a damaged file: zlib.error and LZMAError, RuntimeError for an encrypted member,
    NotImplementedError for an unknown compression, tokenize.TokenError and IndexError for an array's header. What they
    warn of is not shown.
    """
    try:
        with warnings.catch_warnings(action="ignore"):
            yield
    except (InputError, FileNotFoundError):
        raise
    except Exception as error:
        raise InputError(f"{path}: not a readable {kind} ({type(error).__name__}: {error})") from None


def check_characters(texts: Iterable[str]) -> None:
    """ValueError for text with a code that no character has, which NumPy reads from a damaged file."""
    for text in texts:
        if any(ord(character) > sys.maxunicode for character in text):
            raise ValueError("text with codes that no character has")


def read_rows(path: Path) -> list[dict[str, Any]]:
    """The rows of a file, if there is one. Half a row, as a killed run may leave at the end, is none."""
    rows = []
    for line in path.read_text().splitlines() if path.exists() else ():
        with contextlib.suppress(ValueError):
            rows.append(json.loads(line))
    return rows


def drop_rows_after(path: Path, iteration: int) -> list[dict[str, Any]]:
    """Leave and return the rows up to the checkpoint that is resumed from; the run makes the others again."""
    rows = [row for row in read_rows(path) if row["iteration"] <= iteration]
    if path.exists():
        write_atomically(path, "".join(json.dumps(row) + "\n" for row in rows).encode())
    return rows


def write_json(path: Path, content: object, **options: Any) -> None:
    """Write a value as a JSON file, whole or not at all; `options` are those of `json.dumps`."""
    write_atomically(path, (json.dumps(content, indent=2, **options) + "\n").encode())


def write_atomically(path: Path, content: bytes) -> None:
    """Write a file so that a reader, or a crash, sees the old content or the new, never a part."""
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise
