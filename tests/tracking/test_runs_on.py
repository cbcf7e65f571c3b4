"""Episodes of a target that run on after the clip's end, until a fall."""

import dataclasses
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scene import on_reference
from scipy.spatial.transform import Rotation

from forgetmimic_jax.settings.config import UnlearnConfig
from forgetmimic_jax.tracking import env as tracking
from forgetmimic_jax.tracking.env import Environment, make_assets, make_environment
from forgetmimic_jax.tracking.reference import lookup
from forgetmimic_jax.tracking.rsi import Start
from forgetmimic_jax.tracking.setup import Setup

KEY = jax.random.PRNGKey(0)
SWAY, TURN = 0, 1  # 80 frames, kept; 41 frames, to be forgotten


@pytest.fixture(scope="module")
def setup(robot, library, tiny_config) -> Setup:
    config = dataclasses.replace(tiny_config, unlearn=UnlearnConfig(("turn",)))
    return Setup(config, robot, library, "")


def begin(env: Environment, assets, frame: int):
    clips, frames = jnp.array([SWAY, TURN]), jnp.full(2, frame)
    return tracking.start_episodes(env, assets, KEY, Start(clips, jnp.zeros(2, jnp.int32), frames), jnp.zeros(2))


def test_a_target_s_episode_lasts_3_s_longer_than_the_clip(setup):
    assets = make_assets(setup)
    plain, longer = (make_environment(setup, 2, noisy=False, runs_on=seconds) for seconds in (0.0, 3.0))
    np.testing.assert_array_equal(begin(plain, assets, 10).horizon, [69, 30])
    np.testing.assert_array_equal(begin(longer, assets, 10).horizon, [69, 180])


def stepped(setup: Setup, change, *, frame: int = 10, runs_on: int = 150, before=None):
    """A step of both clips after which the robots are on the reference but for `change(bodies)`."""
    assets = make_assets(setup)
    after = on_reference(lookup(assets.library, jnp.array([SWAY, TURN]), jnp.full(2, frame + 1)))
    engine = SimpleNamespace(step=lambda state, parameters, target, wrench: (state, change(after)))
    env = Environment(setup.config, setup.robot, engine, 2, noisy=False, runs_on=runs_on)
    state = begin(env, assets, frame)
    if before is not None:
        state = dataclasses.replace(state, bodies=before(state.bodies))
    return tracking.step(env, assets, state, jnp.zeros((2, 29)), KEY)[1]


def low(body: int, height: float):
    return lambda bodies: dataclasses.replace(bodies, pos=bodies.pos.at[:, body, 2].set(height))


def tilted(body: int, degrees: float):
    quat = Rotation.from_euler("y", degrees, degrees=True).as_quat(scalar_first=True)
    return lambda bodies: dataclasses.replace(bodies, quat=bodies.quat.at[:, body].set(jnp.asarray(quat, jnp.float32)))


def test_off_the_reference_but_upright_only_the_kept_clip_ends(setup):
    hand = int(setup.robot.end_effectors[2])
    result = stepped(setup, low(hand, 0.2))
    np.testing.assert_array_equal(result.terminated, [True, False])
    np.testing.assert_array_equal(result.causes["end_effector_height"], [True, False])
    np.testing.assert_array_equal(stepped(setup, low(hand, 0.2), runs_on=0).terminated, [True, True])


def test_a_root_below_half_of_its_height_ends_a_target_s_episode(setup):
    result = stepped(setup, low(setup.robot.root, 0.37))
    np.testing.assert_array_equal(result.terminated, [False, True])  # no bound is on the root of the kept clip
    np.testing.assert_array_equal(result.causes["fall"], [False, True])
    assert not stepped(setup, low(setup.robot.root, 0.39)).terminated.any()


def test_a_tilt_of_the_anchor_beyond_60_degrees_ends_a_target_s_episode(setup):
    result = stepped(setup, tilted(setup.robot.anchor, 62.0))
    np.testing.assert_array_equal(result.causes["fall"], [False, True])
    assert bool(result.terminated[1])
    assert not stepped(setup, tilted(setup.robot.anchor, 58.0)).terminated[1]


def test_a_robot_that_lies_already_does_not_fall(setup):
    lying = low(setup.robot.root, 0.1)
    assert not stepped(setup, lying, before=lying).terminated.any()


def test_a_robot_that_leans_already_falls_when_it_is_low(setup):
    leaning = tilted(setup.robot.anchor, 70.0)
    assert not stepped(setup, leaning, before=leaning).terminated[1]

    def both(bodies):
        return low(setup.robot.root, 0.1)(leaning(bodies))

    np.testing.assert_array_equal(stepped(setup, both, before=leaning).causes["fall"], [False, True])


@pytest.fixture
def leaning_clip(setup) -> Setup:
    """The clip `turn` leans by 70 degrees in its frames 10 and 11."""
    frames, start = setup.library.frames, int(setup.library.start[TURN])
    leaning = tilted(setup.robot.anchor, 70.0)(frames.bodies)
    there = jnp.zeros(len(frames.joint_pos), bool).at[jnp.array([start + 10, start + 11])].set(True)
    quat = jnp.where(there[:, None, None], leaning.quat, frames.bodies.quat)
    bodies = dataclasses.replace(frames.bodies, quat=quat)
    library = dataclasses.replace(setup.library, frames=dataclasses.replace(frames, bodies=bodies))
    return dataclasses.replace(setup, library=library)


def test_a_robot_that_leans_with_the_clip_falls_when_the_clip_leans_no_longer(leaning_clip):
    def falls(frame: int, degrees: float) -> bool:
        leaning = tilted(leaning_clip.robot.anchor, degrees)
        before = leaning if frame > 9 else None  # upright, as the clip is
        return bool(stepped(leaning_clip, leaning, frame=frame, before=before).causes["fall"][TURN])

    assert [falls(9, 70.0), falls(10, 70.0), falls(11, 70.0), falls(11, 58.0)] == [False, False, True, False]


def test_a_robot_that_lies_does_not_fall_when_the_clip_gets_up(leaning_clip):
    def lying(bodies):
        return low(leaning_clip.robot.root, 0.1)(tilted(leaning_clip.robot.anchor, 70.0)(bodies))

    assert not stepped(leaning_clip, lying, frame=11, before=lying).causes["fall"][TURN]


def test_a_robot_that_comes_apart_is_still_terminated(setup):
    result = stepped(setup, low(setup.robot.root, np.nan))
    np.testing.assert_array_equal(result.diverged, [True, True])
    assert result.terminated.all()


def test_after_the_clip_s_end_the_last_frame_is_held(setup, library):
    """Frame 60 of `turn`, which has 41; the kept clip is at frame 60 of 80."""
    result = stepped(setup, lambda bodies: bodies, frame=60)
    np.testing.assert_array_equal(result.pair.reference.joint_pos[TURN], library.clip(TURN).joint_pos[40])
    np.testing.assert_array_equal(result.pair.reference.joint_pos[SWAY], library.clip(SWAY).joint_pos[61])
    assert not result.terminated.any()
