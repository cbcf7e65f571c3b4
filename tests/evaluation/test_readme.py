from pathlib import Path

import pytest

from forgetmimic_jax.evaluation.tables import BLOCK, fill

README = Path(__file__).resolve().parents[2] / "README.md"


def test_the_readmes_tables_are_those_of_the_files_they_name():
    text = README.read_text()
    missing = [block["path"] for block in BLOCK.finditer(text) if not (README.parent / block["path"]).is_file()]
    if missing:
        pytest.skip(f"no evaluation stored yet: {', '.join(missing)}")
    assert fill(text, README.parent) == text, "run `make tables`"
