import pytest
from invented import invented_policy

from forgetmimic_jax.policy.policy import Policy


@pytest.fixture(scope="session")
def policy(tiny_config) -> Policy:
    """An invented policy of layout wbc132."""
    return invented_policy(tiny_config)
