import pytest


@pytest.fixture(scope="module", autouse=True)
def _fast_compile(fast_compile):
    """Every test here compiles much and runs it little."""
