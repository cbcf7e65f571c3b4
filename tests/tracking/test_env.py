import dataclasses
from dataclasses import dataclass, field, replace
from operator import attrgetter

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from forgetmimic_jax.motion.library import load_library
from forgetmimic_jax.physics import BodyState, PhysicsParameters, PhysicsState
from forgetmimic_jax.robot.bodies import Bodies
from forgetmimic_jax.settings.config import Config
from forgetmimic_jax.tracking import env as tracking
from forgetmimic_jax.tracking.env import Environment, EnvState, StartTable, make_assets, make_environment
from forgetmimic_jax.tracking.reference import lookup
from forgetmimic_jax.tracking.rsi import Start
from forgetmimic_jax.tracking.setup import Setup

ENVS = 4
KEY = jax.random.PRNGKey(0)


@dataclass
class Puppet:
    """An engine whose robot goes where the test says, and that keeps what it was message to do."""

    next_physics: PhysicsState | None = None
    next_bodies: BodyState | None = None
    target: jax.Array | None = None
    wrench: jax.Array | None = None
    wrenches: list[jax.Array] = field(default_factory=list)
    route: list[BodyState] = field(default_factory=list)  # where the next physics steps take it, before next_bodies
    physics: PhysicsState | None = None

    def step(self, state: PhysicsState, parameters: PhysicsParameters, target, wrench):
        self.physics, self.target, self.wrench = state, target, wrench
        self.wrenches.append(wrench)
        return self.next_physics or state, self.route.pop(0) if self.route else self.next_bodies

    def forward(self, state: PhysicsState, parameters: PhysicsParameters, mask, bodies: BodyState) -> BodyState:
        return bodies


@pytest.fixture(scope="module")
def assets(robot, library, tiny_config):
    return make_assets(Setup(tiny_config, robot, library, ""))


@pytest.fixture
def puppet_env(robot, tiny_config):
    """An environment without noise whose engine is a puppet."""
    return Environment(tiny_config, robot, Puppet(), ENVS, noisy=False)


def with_config(env: Environment, **sections) -> Environment:
    return replace(env, config=dataclasses.replace(env.config, **sections))


def start(env: Environment, assets, clip: list[int], frame: list[int], gain: float = 0.0) -> EnvState:
    """Episodes at the frames given, exactly on the reference."""
    clip_, frame_ = jnp.asarray(clip, jnp.int32), jnp.asarray(frame, jnp.int32)
    gains = jnp.full(ENVS, gain, jnp.float32)
    state = tracking.start_episodes(env, assets, KEY, Start(clip_, jnp.zeros_like(clip_), frame_), gains)
    physics, bodies = on_frame(env, assets, clip_, frame_)
    return dataclasses.replace(state, physics=physics, bodies=bodies)


def on_frame(env: Environment, assets, clip, frame) -> tuple[PhysicsState, BodyState]:
    reference = lookup(assets.library, clip, frame)
    root = env.robot.root
    qpos = jnp.concatenate(
        [reference.bodies.pos[:, root], reference.bodies.quat[:, root], reference.joint_pos], axis=-1
    )
    qvel = jnp.concatenate([reference.bodies.lin_vel[:, root], jnp.zeros((ENVS, 3)), reference.joint_vel], axis=-1)
    bodies = BodyState(**vars(reference.bodies), contact_force=jnp.zeros_like(reference.bodies.pos))
    return PhysicsState(qpos, qvel, jnp.zeros_like(qvel)), bodies


def follow(env: Environment, assets, state: EnvState, action=None):
    """A step in which the robot arrives exactly at the next frame."""
    env.engine.next_physics, env.engine.next_bodies = on_frame(env, assets, state.clip, state.frame + 1)
    action = jnp.zeros((ENVS, 29)) if action is None else action
    return tracking.step(env, assets, state, action, KEY)


def rows(library, clip: list[int], frame: list[int], field: str) -> np.ndarray:
    return np.asarray(attrgetter(field)(library.at(np.array(clip), np.array(frame))))


def test_a_step_moves_to_the_next_frame_and_remembers_the_action(puppet_env, assets):
    state = start(puppet_env, assets, [0, 0, 1, 1], [0, 5, 9, 39])
    action = jnp.full((ENVS, 29), 0.25)
    after, _ = follow(puppet_env, assets, state, action)
    np.testing.assert_array_equal(after.frame, [1, 6, 10, 40])
    np.testing.assert_array_equal(after.step, [1, 1, 1, 1])
    np.testing.assert_array_equal(after.last_action, action)
    np.testing.assert_array_equal(after.clip, state.clip)


def test_the_zero_action_asks_for_the_next_frames_joints(puppet_env, assets, library):
    follow(puppet_env, assets, start(puppet_env, assets, [0, 0, 1, 1], [0, 5, 9, 39]))
    expected = rows(library, [0, 0, 1, 1], [1, 6, 10, 40], "joint_pos")
    np.testing.assert_allclose(puppet_env.engine.target, expected, atol=1e-6)


def test_an_action_moves_the_target_by_a_quarter_of_effort_over_stiffness(robot, puppet_env, assets, library):
    action = jnp.zeros((ENVS, 29)).at[:, robot.joint_names.index("left_knee_joint")].set(2.0)
    follow(puppet_env, assets, start(puppet_env, assets, [0, 0, 1, 1], [0, 5, 9, 39]), action)
    moved = np.asarray(puppet_env.engine.target) - rows(library, [0, 0, 1, 1], [1, 6, 10, 40], "joint_pos")
    np.testing.assert_allclose(moved[:, robot.joint_names.index("left_knee_joint")], 2 * 0.3507, atol=1e-3)
    assert np.count_nonzero(np.abs(moved[0]) > 1e-6) == 1


def test_encoder_bias_moves_the_reading_one_way_and_the_robot_the_other(puppet_env, assets):
    state = start(puppet_env, assets, [0] * ENVS, [3] * ENVS)
    biased = dataclasses.replace(state, encoder_bias=jnp.full((ENVS, 29), 0.01))
    follow(puppet_env, assets, state)
    plain = np.asarray(puppet_env.engine.target)
    follow(puppet_env, assets, biased)
    np.testing.assert_allclose(np.asarray(puppet_env.engine.target) - plain, -0.01, atol=1e-6)
    noiseless = dataclasses.replace(puppet_env.config.noise, **{
        name: (0.0, 0.0, 0.0) if isinstance(value, tuple) else 0.0
        for name, value in vars(puppet_env.config.noise).items() if name.startswith("observation")
    })  # fmt: skip
    env = with_config(puppet_env, noise=noiseless)
    difference = tracking.observe(env, assets, biased, KEY)[0] - tracking.observe(env, assets, state, KEY)[0]
    np.testing.assert_allclose(difference[:, 45:74], 0.01, atol=1e-6)
    assert not np.delete(np.asarray(difference), np.s_[45:74], axis=1).any()


def test_a_robot_that_follows_exactly_gets_the_whole_reward(puppet_env, assets):
    state = start(puppet_env, assets, [0, 0, 1, 1], [0, 5, 9, 39])
    after, result = follow(puppet_env, assets, state)
    np.testing.assert_allclose(result.reward.tracking, 8.0, atol=1e-4)
    np.testing.assert_allclose(result.reward.normalized_tracking, 1.0, atol=1e-5)
    np.testing.assert_allclose(after.tracking_sum, 1.0, atol=1e-5)
    np.testing.assert_allclose(after.terms, 1.0, atol=1e-5)
    assert not np.asarray(result.terminated).any()


def test_the_critic_sees_the_kernel_of_a_term_with_weight_0(puppet_env, assets):
    """Joint velocities all 2 rad/s off are one σ: exp(−1/4). No reward is lost, as the term's weight is 0."""
    state = start(puppet_env, assets, [0, 0, 1, 1], [0, 5, 9, 39])
    physics, bodies = on_frame(puppet_env, assets, state.clip, state.frame + 1)
    puppet_env.engine.next_physics = dataclasses.replace(physics, qvel=physics.qvel.at[:, 6:].add(2.0))
    puppet_env.engine.next_bodies = bodies
    after, result = tracking.step(puppet_env, assets, state, jnp.zeros((ENVS, 29)), KEY)
    np.testing.assert_allclose(result.reward.tracking, 8.0, atol=1e-4)
    assert state.terms.shape == after.terms.shape == (ENVS, 10)
    np.testing.assert_allclose(after.terms[:, :-1], 1.0, atol=1e-5)
    np.testing.assert_allclose(after.terms[:, -1], np.exp(-0.25), rtol=1e-4)  # the last of the table
    critic = tracking.observe(puppet_env, assets, after, None)[1]
    np.testing.assert_array_equal(critic[:, -52:-42], after.terms)  # before 14 · 3 contact forces


def test_reward_compares_with_the_frame_that_the_step_reaches(puppet_env, assets):
    state = start(puppet_env, assets, [0] * ENVS, [10] * ENVS)
    puppet_env.engine.next_physics, puppet_env.engine.next_bodies = state.physics, state.bodies  # it does not move
    _, result = tracking.step(puppet_env, assets, state, jnp.zeros((ENVS, 29)), KEY)
    assert (np.asarray(result.reward.normalized_tracking) < 0.9999).all()
    np.testing.assert_array_equal(
        result.pair.reference.bodies.pos, rows(assets.library, [0] * ENVS, [11] * ENVS, "bodies.pos")
    )


def regularisation(env: Environment, assets, *, action=0.0, last_action=0.0, acc_before=0.0, acc=0.0) -> np.ndarray:
    """R_reg [env] of a step that ends at rest on the next frame; every joint has the values given."""
    state = start(env, assets, [0, 0, 1, 1], [0, 5, 9, 39])
    warmstart = jnp.full((ENVS, 35), acc_before).at[:, :6].set(1e6)  # the floating base is no joint
    state = dataclasses.replace(
        state,
        physics=dataclasses.replace(state.physics, warmstart=warmstart),
        last_action=jnp.full((ENVS, 29), last_action),
    )
    physics, bodies = on_frame(env, assets, state.clip, state.frame + 1)
    env.engine.next_physics = dataclasses.replace(
        physics, qvel=jnp.zeros((ENVS, 35)), warmstart=jnp.full((ENVS, 35), acc).at[:, :6].set(1e6)
    )
    env.engine.next_bodies = bodies
    _, result = tracking.step(env, assets, state, jnp.full((ENVS, 29), action), KEY)
    return np.asarray(result.reward.regularisation)


def test_a_step_that_ends_at_rest_on_the_reference_gets_the_survival_reward_alone(puppet_env, assets):
    np.testing.assert_allclose(regularisation(puppet_env, assets), 1.0, atol=1e-5)


def test_the_joint_acceleration_that_costs_is_this_steps(puppet_env, assets):
    found = regularisation(puppet_env, assets, acc_before=-5000.0, acc=-2000.0)
    np.testing.assert_allclose(found, 1.0 - 5e-6 * 29 * 2000.0, atol=1e-5)  # 0.71


def test_the_action_rate_is_against_the_action_of_the_step_before(puppet_env, assets):
    found = regularisation(puppet_env, assets, action=-0.25, last_action=0.5)
    np.testing.assert_allclose(found, 1.0 - 0.1 * 29 * 0.75, atol=1e-5)  # −1.175


def test_the_torque_that_costs_is_that_towards_the_pd_target(puppet_env, assets):
    """On the reference at rest, an action of 3.8 is 3.8 · 0.25 = 0.95 of each motor's limit: 0.05 above 0.9."""
    found = regularisation(puppet_env, assets, action=3.8, last_action=3.8)
    np.testing.assert_allclose(found, 1.0 - 0.1 * 29 * 0.05, atol=1e-4)  # 0.855


def test_a_clips_end_is_a_truncation_at_its_last_frame(puppet_env, assets):
    state = start(puppet_env, assets, [0, 0, 1, 1], [76, 77, 37, 38])  # 80 and 41 frames: 3, 2, 3, 2 steps left
    np.testing.assert_array_equal(state.horizon, [3, 2, 3, 2])
    ends = []
    for _ in range(3):
        state, result = follow(puppet_env, assets, state)
        assert not np.asarray(result.terminated).any()
        ends.append(np.asarray(result.truncated))
    np.testing.assert_array_equal(ends, [[False] * 4, [False, True, False, True], [True] * 4])
    np.testing.assert_array_equal(state.frame, [79, 80, 40, 41])


def test_the_time_limit_is_a_truncation_too(puppet_env, assets):
    env = with_config(puppet_env, max_episode_steps=2)
    state = start(env, assets, [0] * ENVS, [0] * ENVS)
    np.testing.assert_array_equal(state.horizon, 2)
    state, first = follow(env, assets, state)
    state, second = follow(env, assets, state)
    assert not np.asarray(first.truncated).any()
    assert np.asarray(second.truncated).all()


def test_a_fall_is_a_termination_even_in_the_last_step(puppet_env, assets):
    state = start(puppet_env, assets, [1] * ENVS, [39] * ENVS)
    _, bodies = on_frame(puppet_env, assets, state.clip, state.frame + 1)
    fallen = bodies.pos.at[1, :, 2].add(-0.5)
    puppet_env.engine.next_bodies = dataclasses.replace(bodies, pos=fallen)
    _, result = tracking.step(puppet_env, assets, state, jnp.zeros((ENVS, 29)), KEY)
    np.testing.assert_array_equal(result.terminated, [False, True, False, False])
    np.testing.assert_array_equal(result.truncated, [True, False, True, True])
    np.testing.assert_array_equal(result.causes["anchor_height"], [False, True, False, False])


def test_the_frame_shown_is_the_one_that_the_next_action_is_to_reach(puppet_env, assets):
    state = start(puppet_env, assets, [0, 0, 1, 1], [0, 5, 9, 38])
    shown = tracking.observe(puppet_env, assets, state, None)[0][:, 10:39]
    np.testing.assert_allclose(shown, rows(assets.library, [0, 0, 1, 1], [1, 6, 10, 39], "joint_pos"), atol=1e-6)


def test_after_a_clips_end_the_last_frame_is_shown(puppet_env, assets):
    state = start(puppet_env, assets, [1] * ENVS, [39] * ENVS)
    state, _ = follow(puppet_env, assets, state)
    shown = tracking.observe(puppet_env, assets, state, None)[0][:, 10:39]
    np.testing.assert_allclose(shown, rows(assets.library, [1] * ENVS, [40] * ENVS, "joint_pos"), atol=1e-6)


def test_no_wrench_where_its_gain_is_off(puppet_env, assets):
    follow(puppet_env, assets, start(puppet_env, assets, [0] * ENVS, [3] * ENVS, gain=0.5))
    assert not np.asarray(puppet_env.engine.wrench).any()


def wrench_env(puppet_env: Environment) -> Environment:
    return with_config(puppet_env, wrench=dataclasses.replace(puppet_env.config.wrench, max_gain=0.6))


def anchor_track(env: Environment, library, clip: list[int], frame: list[int]) -> list[dict[str, np.ndarray]]:
    """The library's anchor at the start of each physics step of a control step, by NumPy and SciPy."""
    anchor, substeps = env.robot.anchor, env.config.physics.substeps
    ends = np.array([frame, np.array(frame) + 1])
    bodies = ("bodies.pos", "bodies.lin_vel", "bodies.ang_vel")
    shown = jax.tree.map(lambda values: np.asarray(values, np.float64), library.at(np.array(clip), ends))
    both = {name: attrgetter(name)(shown)[:, :, anchor] for name in bodies}
    for name in ("anchor_lin_acc", "anchor_ang_acc"):
        both[name] = attrgetter(name)(shown)
    quat = shown.bodies.quat[:, :, anchor]
    track = []
    for part in np.arange(substeps) / substeps:
        now = {name: (1.0 - part) * values[0] + part * values[1] for name, values in both.items()}
        now["bodies.quat"] = np.stack(
            [
                Slerp([0.0, 1.0], Rotation.from_quat(pair, scalar_first=True))(part).as_quat(scalar_first=True)
                for pair in quat.swapaxes(0, 1)
            ]
        )
        track.append(now)
    return track


def carried(env: Environment, assets, state: EnvState, track: list[dict[str, np.ndarray]]) -> list[np.ndarray]:
    """The wrench [env, 6] of every physics step of a robot whose anchor goes along `track`."""
    env.engine.route = [
        dataclasses.replace(
            state.bodies,
            **{
                name: getattr(state.bodies, name).at[:, env.robot.anchor].set(jnp.asarray(now[f"bodies.{name}"]))
                for name in ("pos", "quat", "lin_vel", "ang_vel")
            },
        )
        for now in track
    ]
    state = dataclasses.replace(state, bodies=env.engine.route.pop(0))
    env.engine.next_bodies = state.bodies  # after the last physics step; no wrench follows it
    with jax.disable_jit():  # the physics steps of a control step are a scan, which would hide what each is given
        tracking.step(env, assets, state, jnp.zeros((ENVS, 29)), KEY)
    return [np.asarray(wrench) for wrench in env.engine.wrenches]


@pytest.fixture(scope="module")
def shipped(robot, tiny_config):
    return make_assets(Setup(tiny_config, robot, load_library(robot, clips=["run", "backflip"]), ""))


def test_a_robot_on_the_reference_at_every_physics_step_feels_no_pull(robot, puppet_env, shipped):
    """The run and the backflip, between frames too: F = M (a_ref − g), τ = I_w α_ref + ω × I_w ω."""
    env = wrench_env(puppet_env)
    clip, frame = [0, 0, 1, 1], [10, 25, 30, 45]
    gain = np.array([0.6, 0.2, 0.4, 0.6])
    state = dataclasses.replace(start(env, shipped, clip, frame), wrench_gain=jnp.asarray(gain, jnp.float32))
    track = anchor_track(env, shipped.library, clip, frame)
    speeds = np.linalg.norm(rows(shipped.library, clip, frame, "bodies.lin_vel")[:, robot.anchor], axis=-1)
    assert speeds.min() > 1.0  # m/s: 15 mm in the last three quarters of a control step
    mass, inertia = robot.model.body_mass.sum(), np.asarray(robot.arrays.inertia, np.float64)
    wrenches = carried(env, shipped, state, track)
    assert len(wrenches) == env.config.physics.substeps == 4
    for now, wrench in zip(track, wrenches, strict=True):
        turn = Rotation.from_quat(now["bodies.quat"], scalar_first=True).as_matrix()
        world_inertia = turn @ inertia @ turn.swapaxes(-1, -2)
        spin = now["bodies.ang_vel"]
        force = mass * (now["anchor_lin_acc"] - [0.0, 0.0, -9.81])
        torque = np.einsum("eij,ej->ei", world_inertia, now["anchor_ang_acc"])
        torque += np.cross(spin, np.einsum("eij,ej->ei", world_inertia, spin))
        np.testing.assert_allclose(wrench[:, :3], gain[:, None] * force, rtol=1e-5, atol=0.02)
        np.testing.assert_allclose(wrench[:, 3:], gain[:, None] * torque, rtol=1e-4, atol=0.02)


def test_a_reference_of_constant_velocity_needs_the_weight_and_no_torque(robot, puppet_env, assets):
    """3 m/s ahead while spinning at 2 rad/s about a principal axis: the wrench is β (0, 0, M g, 0, 0, 0) throughout."""
    env, anchor = wrench_env(puppet_env), robot.anchor
    velocity, spin = np.array([3.0, -1.0, 0.5]), np.array([0.0, 0.0, 2.0])

    def at(time: np.ndarray) -> dict[str, np.ndarray]:
        """The anchor [..., 3 or 4] at times in frames."""
        seconds = 0.02 * np.asarray(time)[..., None]
        return {
            "bodies.pos": np.array([0.0, 0.0, 1.0]) + velocity * seconds,
            "bodies.quat": Rotation.from_rotvec((spin * seconds).reshape(-1, 3))
            .as_quat(scalar_first=True)
            .reshape(*seconds.shape[:-1], 4),
            "bodies.lin_vel": np.broadcast_to(velocity, (*seconds.shape[:-1], 3)),
            "bodies.ang_vel": np.broadcast_to(spin, (*seconds.shape[:-1], 3)),
        }

    library = assets.library
    frames = np.concatenate([np.arange(length) for length in library.length])
    bodies = library.frames.bodies
    moved = {name: getattr(bodies, name).at[:, anchor].set(at(frames)[f"bodies.{name}"]) for name in vars(bodies)}
    none = jnp.zeros_like(library.frames.anchor_lin_acc)
    still = {"anchor_lin_acc": none, "anchor_ang_acc": none}
    inertia = jnp.diag(jnp.array([1.0, 2.0, 3.0]))
    assets = dataclasses.replace(
        assets,
        library=dataclasses.replace(
            library, frames=dataclasses.replace(library.frames, bodies=Bodies(**moved), **still)
        ),
        robot=dataclasses.replace(assets.robot, inertia=inertia),
    )
    frame = np.array([0, 3, 10, 20])
    state = start(env, assets, [0] * ENVS, list(frame), gain=0.5)
    wrenches = carried(env, assets, state, [at(frame + part) for part in (0.0, 0.25, 0.5, 0.75)])
    expected = [0.0, 0.0, 0.5 * robot.model.body_mass.sum() * 9.81, 0.0, 0.0, 0.0]
    for wrench in wrenches:
        np.testing.assert_allclose(wrench, np.tile(expected, (ENVS, 1)), rtol=1e-5, atol=0.02)


def test_the_wrench_carries_the_robot_and_does_not_tear_it_apart(robot, tiny_config, library):
    """At its full gain an episode of the zero action is longer, although the torque of a whole robot's inertia acts on
    the torso: held for a control step it would shake it to pieces within a few steps."""
    envs, steps = 16, 40
    mean_steps = []
    for gain in (0.0, 0.6):
        config = dataclasses.replace(
            tiny_config,
            wrench=dataclasses.replace(tiny_config.wrench, max_gain=gain),
            ppo=dataclasses.replace(tiny_config.ppo, num_envs=envs),
        )
        setup = Setup(config, robot, library, "")
        env, assets = make_environment(setup, envs), make_assets(setup)
        zeros = jnp.zeros((envs,), jnp.int32)
        begin = Start(zeros, zeros, jnp.arange(envs))
        state = tracking.start_episodes(env, assets, KEY, begin, jnp.full(envs, gain))
        state = tracking.refresh_bodies(env, state, jnp.ones(envs, bool))
        advance = jax.jit(lambda assets, state, key, env=env: tracking.step(
            env, assets, state, jnp.zeros((envs, robot.num_joints)), key))  # fmt: skip
        alive, steps_alive = np.ones(envs, bool), 0
        for step in range(steps):
            state, result = advance(assets, state, jax.random.PRNGKey(step))
            assert not result.diverged.any()
            assert np.abs(result.reward.regularisation)[alive].max(initial=0.0) < 1.0
            alive &= ~np.asarray(result.terminated)
            steps_alive += alive.sum()
        mean_steps.append(steps_alive / envs)
    assert mean_steps[1] > 1.2 * mean_steps[0]


def test_pushes_come_when_the_countdown_is_over_and_then_after_the_drawn_interval(robot, tiny_config, assets):
    noise = dataclasses.replace(tiny_config.noise, push_interval=(0.06, 0.06))  # every third step
    env = Environment(dataclasses.replace(tiny_config, noise=noise), robot, Puppet(), ENVS, noisy=True)
    state = dataclasses.replace(start(env, assets, [0] * ENVS, [0] * ENVS), push_countdown=jnp.full(ENVS, 2, jnp.int32))
    pushed = []
    for _ in range(9):
        before = np.asarray(state.physics.qvel)
        state, _ = follow(env, assets, state)
        pushed.append(bool(np.any(np.asarray(env.engine.physics.qvel) != before)))
    assert pushed == [False, False, True, False, False, True, False, False, True]


def test_without_noise_nothing_is_pushed_or_randomised(puppet_env, assets):
    state = dataclasses.replace(start(puppet_env, assets, [0] * ENVS, [0] * ENVS), push_countdown=jnp.zeros(ENVS, int))
    follow(puppet_env, assets, state)
    np.testing.assert_array_equal(puppet_env.engine.physics.qvel, state.physics.qvel)
    np.testing.assert_allclose(state.parameters.foot_friction, puppet_env.nominal_friction)
    assert not np.asarray(state.encoder_bias).any()
    assert not np.asarray(state.parameters.torso_com).any()


def test_noise_is_on_the_actors_observation_alone(puppet_env, assets):
    state = start(puppet_env, assets, [0] * ENVS, [0] * ENVS)
    clean_actor, clean_critic = tracking.observe(puppet_env, assets, state, None)
    noisy_actor, noisy_critic = tracking.observe(puppet_env, assets, state, KEY)
    assert np.asarray(noisy_actor[:, :103] != clean_actor[:, :103]).mean() > 0.99
    np.testing.assert_array_equal(noisy_actor[:, 103:], clean_actor[:, 103:])
    np.testing.assert_array_equal(noisy_critic, clean_critic)


def test_resets_start_new_episodes_in_the_mask_and_only_there(puppet_env, assets):
    state = start(puppet_env, assets, [0, 0, 1, 1], [10, 20, 5, 6])
    state, _ = follow(puppet_env, assets, state, jnp.ones((ENVS, 29)))
    mask = jnp.array([True, False, True, False])
    one_bin = jnp.zeros(assets.bins.valid.shape).at[1, 1].set(1.0)
    gains = jnp.zeros(assets.bins.valid.shape).at[1, 1].set(0.4)
    after = tracking.reset_where(puppet_env, assets, state, mask, KEY, StartTable(one_bin, gains))
    for old, new in zip(jax.tree.leaves(state), jax.tree.leaves(after), strict=True):
        np.testing.assert_array_equal(np.asarray(old)[1::2], np.asarray(new)[1::2])
    np.testing.assert_array_equal(after.clip[::2], 1)
    np.testing.assert_array_equal(after.start_bin[::2], 1)
    assert ((after.frame[::2] >= assets.bins.start[1, 1]) & (after.frame[::2] < assets.bins.end[1, 1])).all()
    np.testing.assert_allclose(after.wrench_gain[::2], 0.4)
    for name in ("step", "tracking_sum", "last_action"):
        assert not np.asarray(getattr(after, name))[::2].any()
    np.testing.assert_array_equal(after.horizon[::2], 40 - after.frame[::2])


def poisoned(state: EnvState, kind: str) -> EnvState:
    """The state of a robot whose simulation is about to blow up: environment 1."""
    qpos, qvel = state.physics.qpos, state.physics.qvel
    if kind == "nan":
        qpos = qpos.at[1, 9].set(jnp.nan)
    elif kind == "inf":
        qvel = qvel.at[1, 9].set(jnp.inf)
    else:
        qvel = qvel.at[1, 9].set(1e20)
    return dataclasses.replace(state, physics=dataclasses.replace(state.physics, qpos=qpos, qvel=qvel))


@pytest.fixture(scope="module")
def native(tiny_setup, assets):
    """A real environment on the C engine, with its step and reset compiled."""
    env = make_environment(tiny_setup, ENVS)
    return env, jax.jit(lambda state, action: tracking.step(env, assets, state, action, KEY))


@pytest.mark.parametrize("kind", ["nan", "inf", "huge"])
def test_a_diverged_robot_is_seen_and_its_reward_is_zero(native, assets, kind):
    env, step = native
    state = poisoned(start(env, assets, [0] * ENVS, [0] * ENVS), kind)
    after, result = step(state, jnp.zeros((ENVS, 29)))
    np.testing.assert_array_equal(result.diverged, [False, True, False, False])
    np.testing.assert_array_equal(result.terminated, [False, True, False, False])
    assert not np.asarray(result.truncated).any()
    for leaf in jax.tree.leaves(result.reward):
        assert np.isfinite(leaf).all()
        assert leaf[1] == 0.0
        assert (np.asarray(leaf)[[0, 2, 3]] != 0.0).all()
    assert np.isfinite(after.tracking_sum).all()
    assert np.isfinite(after.terms).all()


def test_a_diverged_robot_stays_where_it_was(puppet_env, assets):
    state = start(puppet_env, assets, [0] * ENVS, [5] * ENVS)
    physics, bodies = on_frame(puppet_env, assets, state.clip, state.frame + 1)
    puppet_env.engine.next_physics = dataclasses.replace(physics, qvel=physics.qvel.at[1, 0].set(jnp.nan))
    puppet_env.engine.next_bodies = bodies
    after, _ = tracking.step(puppet_env, assets, state, jnp.zeros((ENVS, 29)), KEY)
    for old, new in zip(
        jax.tree.leaves((state.physics, state.bodies)), jax.tree.leaves((after.physics, after.bodies)), strict=True
    ):
        np.testing.assert_array_equal(old[1], new[1])
    np.testing.assert_array_equal(after.physics.qpos[0], physics.qpos[0])


def test_a_diverged_robot_is_whole_again_after_its_reset(native, assets):
    env, step = native
    state = poisoned(start(env, assets, [0] * ENVS, [0] * ENVS), "nan")
    after, result = step(state, jnp.zeros((ENVS, 29)))
    uniform = assets.bins.valid / assets.bins.valid.sum()
    fresh = tracking.reset_where(env, assets, after, result.terminated, KEY, StartTable(uniform, 0.0 * uniform))
    for leaf in jax.tree.leaves((fresh, tracking.observe(env, assets, fresh, KEY))):
        assert np.isfinite(leaf).all()


def test_one_diverged_robot_changes_nothing_for_the_others(native, assets):
    env, step = native
    state = start(env, assets, [0, 1, 0, 1], [0, 4, 8, 9])
    healthy, _ = step(state, jnp.zeros((ENVS, 29)))
    sick, _ = step(poisoned(state, "nan"), jnp.zeros((ENVS, 29)))
    for ours, theirs in zip(jax.tree.leaves(healthy), jax.tree.leaves(sick), strict=True):
        np.testing.assert_array_equal(np.asarray(ours)[[0, 2, 3]], np.asarray(theirs)[[0, 2, 3]])


def test_the_same_step_twice_is_the_same(native, assets):
    env, step = native
    state = start(env, assets, [0, 1, 0, 1], [0, 4, 8, 9])
    first, second = (step(state, 0.1 * jnp.ones((ENVS, 29))) for _ in range(2))
    for one, two in zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True):
        np.testing.assert_array_equal(one, two)


def test_in_physics_the_zero_action_tracks_for_a_few_steps(native, assets):
    env, step = native
    state = start(env, assets, [0] * ENVS, [0, 10, 20, 30])
    for _ in range(3):
        state, result = step(state, jnp.zeros((ENVS, 29)))
    assert (np.asarray(result.reward.normalized_tracking) > 0.9).all()
    assert not np.asarray(result.terminated).any()


def test_targets_are_marked_by_name(robot, library, tiny_config: Config):
    unlearn = dataclasses.replace(tiny_config.unlearn, targets=("turn",))
    marked = make_assets(Setup(dataclasses.replace(tiny_config, unlearn=unlearn), robot, library, "")).is_target
    np.testing.assert_array_equal(marked, [False, True])


def test_no_episode_starts_from_a_target_where_only_kept_clips_are_sampled(robot, library, tiny_config: Config):
    unlearn = dataclasses.replace(tiny_config.unlearn, targets=("turn",))
    config = dataclasses.replace(tiny_config, unlearn=unlearn)
    kept = dataclasses.replace(config, sampling=dataclasses.replace(config.sampling, clips="kept"))
    np.testing.assert_array_equal(make_assets(Setup(config, robot, library, "")).bins.valid.any(-1), [True, True])
    np.testing.assert_array_equal(make_assets(Setup(kept, robot, library, "")).bins.valid.any(-1), [True, False])
