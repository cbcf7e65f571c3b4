import jax
import pytest

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.policy.policy import Policy, init_policy
from forgetmimic_jax.tracking.layouts import LAYOUTS
from forgetmimic_jax.viewing import offscreen
from forgetmimic_jax.viewing.takes import Episode, record


@pytest.fixture(scope="session")
def policy(robot, tiny_config) -> Policy:
    return init_policy(
        tiny_config.ppo, robot.num_joints, LAYOUTS["wbc132"].size(robot.num_joints), 623, jax.random.PRNGKey(0)
    )


@pytest.fixture(scope="session")
def episodes(tiny_setup, policy) -> list[Episode]:
    """`turn`, which is to be forgotten, then `sway`, by the zero action and by a random policy."""
    policies = {"zero_action": None, "random": policy}
    return record(tiny_setup, policies, ["turn", "sway"], ["turn"], seed=3)


@pytest.fixture(scope="session")
def rendering() -> None:
    """Skips where nothing can be drawn without a screen."""
    try:
        offscreen.check_rendering()
    except InputError as error:
        pytest.skip(str(error))
