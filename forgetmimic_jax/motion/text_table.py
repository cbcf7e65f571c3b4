"""Tables of numbers in text files: any usual separator, decimal point or comma, with a header or without."""

from __future__ import annotations

import codecs
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from forgetmimic_jax.basics.errors import InputError

# UTF-32 before UTF-16, whose mark begins it.
MARKS = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
DECIMAL_COMMA = re.compile(r"[-+]?\d+,\d+([eE][-+]?\d+)?")


@dataclass(frozen=True)
class Table:
    """The numbers of a text file [row, column], and the names of the columns where it has a header."""

    values: np.ndarray
    names: tuple[str, ...] | None


def read_table(path: Path) -> Table:
    """Read a table.

    Raises:
        InputError: a cell that is no number, or rows of different length; with the line and the column.
    """
    lines = [(number, line) for number, line in enumerate(_text(path).splitlines(), start=1) if line.strip()]
    if not lines:
        raise InputError(f"{path}: found no row of numbers; the file is empty")
    separator = _separator(lines[-1][1])
    first = _cells(lines[0][1].lstrip("# "), separator)
    words = sum(not _is_number(cell) for cell in first if cell)
    names = tuple(first) if words > len(first) / 2 else None
    if names is not None:
        lines = lines[1:]
    if not lines:
        raise InputError(f"{path}: found a header and no row of numbers")
    lines = [(number, line.replace('"', "")) for number, line in lines]
    rows = [line.strip(" \r") if separator != "\t" else line for _, line in lines]
    if separator and rows[0].endswith(separator):  # a separator after the last cell
        rows = [row.removesuffix(separator) for row in rows]
        names = names[:-1] if names and not names[-1] else names
    if separator != ",":
        rows = [row.replace(",", ".") for row in rows]
    try:
        values = np.loadtxt(rows, delimiter=separator, comments=None, ndmin=2)
    except ValueError:
        raise InputError(f"{path}: {_fault(rows, [number for number, _ in lines], separator)}") from None
    if names is not None and len(names) != values.shape[1]:
        raise InputError(f"{path}: line 1: {len(names)} names for {values.shape[1]} columns; one a column is needed")
    return Table(values, names)


def _text(path: Path) -> str:
    raw = path.read_bytes()
    encoding = next((encoding for mark, encoding in MARKS if raw.startswith(mark)), "utf-8")
    return raw.decode(encoding, errors="replace")


def _separator(line: str) -> str | None:
    """What stands between the cells of a row of numbers; None for spaces."""
    for separator in ("\t", ";", "|"):
        if separator in line:
            return separator
    decimal_commas = all(DECIMAL_COMMA.fullmatch(cell) or _is_number(cell) for cell in line.split())
    return "," if "," in line and not (decimal_commas and len(line.split()) > 1) else None


def _cells(line: str, separator: str | None) -> list[str]:
    return [cell.strip().strip("\"'").strip() for cell in line.strip(" \r").split(separator)]


def _is_number(cell: str) -> bool:
    try:
        float(cell.replace(",", "."))
    except ValueError:
        return False
    return True


def _fault(rows: list[str], numbers: list[int], separator: str | None) -> str:
    """The first cell that is no number, or the first row of another length."""
    width = len(_cells(rows[0], separator))
    for number, row in zip(numbers, rows, strict=True):
        cells = _cells(row, separator)
        for column, cell in enumerate(cells, start=1):
            if not _is_number(cell):
                found = f"'{cell[:40]}'" if cell else "nothing"
                return f"line {number}, column {column}: found {found}; a number is needed"
        if len(cells) != width:
            return f"line {number}: found {len(cells)} columns; {width} are needed, as in the first row"
    return "not a table of numbers"
