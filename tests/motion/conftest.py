"""Sample files of other projects: read where a checkout has them beside it, else the tests that need them skip."""

from pathlib import Path

import pytest

SHARED = Path(__file__).resolve().parents[3] / "shared" / "data"


@pytest.fixture(scope="session")
def samples() -> Path:
    """Folder with G1 clips in the three formats."""
    folder = SHARED / "motions"
    if not folder.is_dir():
        pytest.skip("sample motions are not committed: no ../shared/data/motions beside this checkout")
    return folder


@pytest.fixture(scope="session")
def deepmimic() -> Path:
    """Folder with DeepMimic's human clips."""
    folder = SHARED / "deepmimic"
    if not folder.is_dir():
        pytest.skip("DeepMimic's clips are not committed: no ../shared/data/deepmimic beside this checkout")
    return folder
