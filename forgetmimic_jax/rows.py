"""Files of one JSON object a line, such as metrics.jsonl, to which a run adds."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path
from typing import Any

from forgetmimic_jax.motion.clip import write_atomically


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
