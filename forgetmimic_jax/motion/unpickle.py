"""Pickles read without running what they say: numbers, strings, NumPy arrays and plain containers, nothing else."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import IO, Any

from forgetmimic_jax.basics.errors import InputError

ACCEPTED = "numbers, strings, numpy arrays and plain containers"


class Refused(Exception):
    """A pickle names something other than numpy's reconstruction."""


class NumbersOnly(pickle.Unpickler):
    """An unpickler that can build numpy arrays, scalars, strings and plain containers, and call nothing else."""

    ALLOWED = frozenset(
        [("numpy", "ndarray"), ("numpy", "dtype"), ("_codecs", "encode")]
        + [
            (f"numpy.{core}.{module}", name)
            for core in ("core", "_core")
            for module, name in (
                ("multiarray", "_reconstruct"),
                ("multiarray", "scalar"),
                ("numeric", "_frombuffer"),
            )
        ]
    )

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in self.ALLOWED:
            raise Refused(f"{module}.{name}")
        return super().find_class(module.replace("numpy.core", "numpy._core"), name)


def unpickled(file: IO[bytes], path: Path) -> Any:
    """What a pickle holds.

    Raises:
        InputError: it would call something, it is joblib's, or it is damaged.
    """
    try:
        return NumbersOnly(file).load()
    except Refused as error:
        if str(error).startswith("joblib."):
            raise InputError(
                f"{path}: this is joblib's file, not a plain pickle; mend: write it anew with "
                "pickle.dump(joblib.load(FILE), open(NEW, 'wb')), from a source that you trust"
            ) from None
        raise InputError(f"{path}: refused: the pickle would call {error}; accepted: {ACCEPTED}") from None
    except Exception as error:  # a damaged pickle raises almost anything
        raise InputError(f"{path}: not a readable pickle ({type(error).__name__}: {error})") from None
