"""Every term of every layout, from its definition in MuJoCo and NumPy: wbc-mjlab's, mjlab's and BeyondMimic's."""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from orders import isaac_order
from scene import as_reference, body_velocity, key_bodies, moved, physics_state, posed
from scipy.spatial.transform import Rotation

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.robot.model import load_robot
from forgetmimic_jax.settings.config import ActionConfig, ObservationConfig
from forgetmimic_jax.tracking import env as tracking
from forgetmimic_jax.tracking.env import Environment, make_assets
from forgetmimic_jax.tracking.layouts import LAYOUTS, Moment, find_layout
from forgetmimic_jax.tracking.observation import actor_observation, critic_size, sensor_noise
from forgetmimic_jax.tracking.rsi import Start
from forgetmimic_jax.tracking.setup import Setup, make_setup

# Terms with their sizes and half-widths of noise.
WBC = [
    ("joint_pos", 29, 0.01),
    ("joint_vel", 29, 1.5),
    ("actions", 29, 0.0),
]
LAYOUT = {
    "wbc132": [
        ("ref_base_height", 1, 0.01),
        ("ref_base_lin_vel_b", 3, (0.1, 0.1, 0.05)),
        ("ref_base_ang_vel_b", 3, (0.2, 0.2, 0.3)),
        ("ref_gravity_b", 3, 0.02),
        ("ref_joint_pos", 29, 0.05),
        ("base_ang_vel", 3, 0.2),
        ("projected_gravity", 3, 0.05),
        *WBC,
    ],
    "root132": [
        ("ref_root_height", 1, 0.01),
        ("ref_root_lin_vel_b", 3, (0.1, 0.1, 0.05)),
        ("ref_root_ang_vel_b", 3, (0.2, 0.2, 0.3)),
        ("ref_root_gravity_b", 3, 0.02),
        ("ref_joint_pos", 29, 0.05),
        ("base_ang_vel", 3, 0.2),
        ("projected_gravity", 3, 0.05),
        *WBC,
    ],
    "mjlab160": [
        ("command", 58, 0.0),
        ("motion_anchor_pos_b", 3, 0.25),
        ("motion_anchor_ori_b", 6, 0.05),
        ("base_lin_vel", 3, 0.5),
        ("base_ang_vel", 3, 0.2),
        ("joint_pos", 29, 0.01),
        ("joint_vel", 29, 0.5),
        ("actions", 29, 0.0),
    ],
    "mjlab154": [
        ("command", 58, 0.0),
        ("motion_anchor_ori_b", 6, 0.05),
        ("base_ang_vel", 3, 0.2),
        ("joint_pos", 29, 0.01),
        ("joint_vel", 29, 0.5),
        ("actions", 29, 0.0),
    ],
}
# Of the whole, for 29, 23 and 31 joints.
SIZES = {
    "wbc132": (132, 108, 140),
    "root132": (132, 108, 140),
    "mjlab160": (160, 130, 170),
    "mjlab154": (154, 124, 164),
}


def place(layout: str, name: str) -> slice:
    sizes = {term: size for term, size, _ in LAYOUT[layout]}
    begin = sum(list(sizes.values())[: list(sizes).index(name)])
    return slice(begin, begin + sizes[name])


class Body:
    """A body of MuJoCo's data: pose and velocity in the world, and a world vector in its frame."""

    def __init__(self, robot, data: mujoco.MjData, name: str):
        body = robot.model.body(name).id
        self.pos, self.matrix = data.xpos[body].copy(), data.xmat[body].reshape(3, 3).copy()
        self.linear, self.angular = body_velocity(robot, data, body)

    def sees(self, vector) -> np.ndarray:
        return self.matrix.T @ np.asarray(vector)


def with_bent_waist(robot, seed: int, bend: float) -> mujoco.MjData:
    """A random pose and velocity whose waist is bent (rad) and turns (rad/s) as far as `bend` says."""
    data = posed(robot, seed)
    for joint, angle, speed in (("waist_yaw", 1.2, 3.0), ("waist_roll", 0.4, -2.0), ("waist_pitch", 0.5, 2.0)):
        place = robot.model.joint(f"{joint}_joint")
        data.qpos[place.qposadr[0]], data.qvel[place.dofadr[0]] = bend * angle, bend * speed
    mujoco.mj_forward(robot.model, data)
    return data


class Scene:
    """A robot in one random pose, a reference in another, by MuJoCo. The waists are bent and turn.

    Angles, speeds and actions are in the policy's order of joints.
    """

    def __init__(self, robot, order: tuple[str, ...]):
        self.robot, self.order = robot, order
        self.here, self.there = (with_bent_waist(robot, seed, bend) for seed, bend in ((1, 1.0), (2, -1.0)))
        self.last_action = np.linspace(-1.0, 1.0, robot.num_joints)
        self.torso, self.pelvis = (Body(robot, self.here, name) for name in ("torso_link", "pelvis"))
        self.ref_torso, self.ref_pelvis = (Body(robot, self.there, name) for name in ("torso_link", "pelvis"))
        self.default = [robot.arrays.default_joint_pos[robot.joint_names.index(name)] for name in order]

    def moment(self) -> Moment:
        by_name = dict(zip(self.order, self.last_action, strict=True))
        return Moment(
            robot=self.robot.arrays,
            reference=as_reference(self.robot, self.there),
            physics=physics_state(self.here),
            bodies=key_bodies(self.robot, self.here),
            last_action=jnp.asarray([[by_name[name] for name in self.robot.joint_names]], jnp.float32),
            anchor=self.robot.anchor,
            root=self.robot.root,
        )

    def angles(self, data: mujoco.MjData) -> np.ndarray:
        return np.array([data.qpos[self.robot.model.joint(name).qposadr[0]] for name in self.order])

    def speeds(self, data: mujoco.MjData) -> np.ndarray:
        return np.array([data.qvel[self.robot.model.joint(name).dofadr[0]] for name in self.order])


def gyro(scene: Scene) -> np.ndarray:
    velocity = np.zeros(6)
    pelvis = scene.robot.model.body("pelvis").id
    mujoco.mj_objectVelocity(scene.robot.model, scene.here, mujoco.mjtObj.mjOBJ_XBODY, pelvis, velocity, 1)
    return velocity[:3]


def row_by_row(scene: Scene) -> list[float]:
    relative = scene.torso.matrix.T @ scene.ref_torso.matrix
    return [relative[i, j] for i in range(3) for j in range(2)]


DOWN = [0.0, 0.0, -1.0]
DEFINITIONS: dict[str, Callable[[Scene], np.ndarray]] = {
    "ref_base_height": lambda s: s.ref_torso.pos[2:],
    "ref_base_lin_vel_b": lambda s: s.ref_torso.sees(s.ref_torso.linear),
    "ref_base_ang_vel_b": lambda s: s.ref_torso.sees(s.ref_torso.angular),
    "ref_gravity_b": lambda s: s.ref_torso.sees(DOWN),
    "ref_root_height": lambda s: s.ref_pelvis.pos[2:],
    "ref_root_lin_vel_b": lambda s: s.ref_pelvis.sees(s.ref_pelvis.linear),
    "ref_root_ang_vel_b": lambda s: s.ref_pelvis.sees(s.ref_pelvis.angular),
    "ref_root_gravity_b": lambda s: s.ref_pelvis.sees(DOWN),
    "ref_joint_pos": lambda s: s.angles(s.there),
    "command": lambda s: np.concatenate([s.angles(s.there), s.speeds(s.there)]),
    "motion_anchor_pos_b": lambda s: s.torso.sees(s.ref_torso.pos - s.torso.pos),
    "motion_anchor_ori_b": row_by_row,
    "base_lin_vel": lambda s: s.pelvis.sees(s.here.qvel[:3]),
    "base_ang_vel": gyro,
    "projected_gravity": lambda s: s.pelvis.sees(DOWN),
    "joint_pos": lambda s: s.angles(s.here) - s.default,
    "joint_vel": lambda s: s.speeds(s.here),
    "actions": lambda s: s.last_action,
}


@pytest.fixture(scope="module", params=["mjlab's order", "Isaac Lab's order"])
def scene(request, robot) -> Scene:
    if request.param == "mjlab's order":
        return Scene(robot, robot.joint_names)
    order = isaac_order(robot)
    return Scene(load_robot("g1", action=ActionConfig(joint_order=order)), order)


def observation(scene: Scene, layout: str, moment: Moment | None = None) -> np.ndarray:
    """[1, features] of the scene, or of another moment."""
    return np.asarray(actor_observation(LAYOUTS[layout], scene.robot.policy_joints, moment or scene.moment()))


@pytest.fixture(scope="module", params=LAYOUT)
def layout(request) -> str:
    return request.param


@pytest.fixture(scope="module")
def seen(scene, layout) -> np.ndarray:
    return observation(scene, layout)[0]


def test_torso_and_pelvis_differ_strongly_in_the_scene(scene):
    for torso, pelvis in ((scene.torso, scene.pelvis), (scene.ref_torso, scene.ref_pelvis)):
        assert Rotation.from_matrix(torso.matrix.T @ pelvis.matrix).magnitude() > 0.5
        assert np.linalg.norm(torso.sees(torso.angular) - pelvis.sees(pelvis.angular)) > 1.0
        assert np.linalg.norm(torso.sees(DOWN) - pelvis.sees(DOWN)) > 0.3


def test_every_layout_is_tested():
    assert set(LAYOUTS) == set(LAYOUT)


def test_a_layout_has_its_terms_in_their_order(layout):
    places = LAYOUTS[layout].places(29)
    assert list(places) == [name for name, *_ in LAYOUT[layout]]
    assert places == {name: place(layout, name) for name in places}


def test_a_layout_has_the_size_that_its_family_has_for_any_number_of_joints(layout):
    assert tuple(LAYOUTS[layout].size(joints) for joints in (29, 23, 31)) == SIZES[layout]
    assert [LAYOUTS[layout].joints_of(size) for size in SIZES[layout]] == [29, 23, 31]


def test_every_term_is_what_its_definition_says(scene, layout, seen):
    assert seen.size == SIZES[layout][0]
    for name, *_ in LAYOUT[layout]:
        np.testing.assert_allclose(seen[place(layout, name)], DEFINITIONS[name](scene), atol=1e-5, err_msg=name)


@pytest.mark.parametrize("name", LAYOUT)
def test_who_knows_place_and_heading(scene, name):
    """Robot and reference both moved and turned as one leave every layout as it was; each alone only those of wbc."""
    moment, before = scene.moment(), observation(scene, name)
    turn, shift = 1.3, (4.0, -2.0)
    everything, reference_alone = (moved(moment, turn, shift, robot=together) for together in (True, False))
    np.testing.assert_allclose(observation(scene, name, everything), before, atol=1e-5)
    difference = np.abs(observation(scene, name, reference_alone) - before)[0]
    terms = [term for term, *_ in LAYOUT[name]]
    changed = {term for term in terms if difference[place(name, term)].max() > 1e-4}
    expected = {"motion_anchor_pos_b", "motion_anchor_ori_b"} & set(terms)
    assert changed == expected


def test_gravity_points_down_for_an_upright_robot(scene):
    moment = scene.moment()
    qpos = moment.physics.qpos.at[0, 3:7].set(jnp.array([1.0, 0.0, 0.0, 0.0]))
    upright = dataclasses.replace(moment, physics=dataclasses.replace(moment.physics, qpos=qpos))
    seen = observation(scene, "wbc132", upright)[0]
    np.testing.assert_allclose(seen[place("wbc132", "projected_gravity")], DOWN, atol=1e-6)


# What sensors add.


@pytest.fixture(scope="module")
def noise(layout) -> np.ndarray:
    return np.asarray(sensor_noise(LAYOUTS[layout], 1.0, jax.random.PRNGKey(0), jnp.zeros((4000, 29))))


def test_noise_is_uniform_in_the_half_width_of_its_term(layout, noise):
    for name, size, width in LAYOUT[layout]:
        found, half_width = noise[:, place(layout, name)], np.broadcast_to(width, size)
        assert (np.abs(found) <= half_width).all(), name
        assert (np.abs(found).max(0) >= 0.99 * half_width).all(), name
        np.testing.assert_allclose(found.mean(0), 0.0, atol=0.05 * half_width.max() + 1e-9, err_msg=name)
        np.testing.assert_allclose(found.std(0), half_width / np.sqrt(3.0), rtol=0.06, err_msg=name)


def test_the_noise_of_sensors_has_one_factor(layout, noise):
    half = sensor_noise(LAYOUTS[layout], 0.5, jax.random.PRNGKey(0), jnp.zeros((4000, 29)))
    np.testing.assert_allclose(half, 0.5 * noise, rtol=1e-6)


def test_the_bias_of_the_encoders_shifts_the_joints_angles_alone(layout):
    bias = np.linspace(-0.01, 0.01, 58).reshape(2, 29)
    shift = np.asarray(sensor_noise(LAYOUTS[layout], 0.0, jax.random.PRNGKey(0), jnp.asarray(bias)))
    joint_pos = place(layout, "joint_pos")
    np.testing.assert_allclose(shift[:, joint_pos], bias, rtol=1e-6)
    assert not np.delete(shift, joint_pos, axis=1).any()


# In the environment.


@pytest.fixture(scope="module")
def observed(robot, library, tiny_config, layout):
    """Observation of robots exactly on frames 0, 7 and 39 of the second clip: actor's, with noise, and critic's."""
    config = dataclasses.replace(tiny_config, observation=ObservationConfig(layout))
    assets = make_assets(Setup(config, robot, library, ""))
    env = Environment(config, robot, None, 3, noisy=False)  # nothing moves, so no engine is needed
    clip, frame = jnp.full(3, 1), jnp.array([0, 7, 39])
    state = tracking.start_episodes(env, assets, jax.random.PRNGKey(0), Start(clip, clip, frame), jnp.zeros(3))
    state = dataclasses.replace(state, encoder_bias=jnp.full((3, 29), 0.01))
    clean, critic = tracking.observe(env, assets, state, None)
    noisy, _ = tracking.observe(env, assets, state, jax.random.PRNGKey(1))
    return env, np.asarray(clean), np.asarray(noisy), np.asarray(critic)


def test_the_reference_shown_is_the_next_frame(library, layout, observed):
    rows, (_, clean, *_) = [1, 8, 40], observed
    frames = library.at(1, np.array(rows))
    pelvis, torso = 0, 7
    shown = {
        "ref_base_height": frames.bodies.pos[:, torso, 2:],
        "ref_root_height": frames.bodies.pos[:, pelvis, 2:],
        "ref_joint_pos": frames.joint_pos,
        "command": np.concatenate([frames.joint_pos, frames.joint_vel], axis=-1),
    }
    checked = [name for name, *_ in LAYOUT[layout] if name in shown]
    assert checked
    for name in checked:
        np.testing.assert_allclose(clean[:, place(layout, name)], shown[name], atol=1e-6, err_msg=name)


def test_the_anchors_terms_compare_the_robot_with_the_next_frame(library, layout, observed):
    """A robot that stands on frame t sees the way to frame t + 1, which is not nothing."""
    _, clean, *_ = observed
    if "motion_anchor_ori_b" not in LAYOUTS[layout].places(29):
        return
    quat, pos = (getattr(library.clip(1).bodies, name)[:, 7] for name in ("quat", "pos"))
    for row, frame in enumerate((0, 7, 39)):
        here, there = (Rotation.from_quat(quat[frame + ahead], scalar_first=True) for ahead in (0, 1))
        np.testing.assert_allclose(
            clean[row, place(layout, "motion_anchor_ori_b")],
            (here.inv() * there).as_matrix()[:, :2].ravel(),
            atol=1e-5,
        )
        if layout == "mjlab160":
            expected = here.inv().apply(pos[frame + 1] - pos[frame])
            np.testing.assert_allclose(clean[row, place(layout, "motion_anchor_pos_b")], expected, atol=1e-5)
            assert np.linalg.norm(expected) > 1e-3


def test_the_actor_meets_noise_and_the_critic_sees_the_actors_terms_without_it(layout, observed):
    env, clean, noisy, critic = observed
    size = SIZES[layout][0]
    np.testing.assert_array_equal(critic[:, :size], clean)
    widths = np.concatenate([np.broadcast_to(width, size) for _, size, width in LAYOUT[layout]])
    bias = np.zeros(size)
    bias[place(layout, "joint_pos")] = 0.01
    assert (np.abs(noisy - clean - bias) <= widths + 1e-5).all()
    assert (np.abs(noisy - clean - bias)[:, widths > 0] > 1e-7).mean() > 0.95
    assert critic.shape[1] == critic_size(LAYOUTS[layout], env.robot) == size + 492


# Names.


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("wbc123", "observation.layout: no layout 'wbc123'; did you mean 'wbc132'?"),
        ("HumanoidVerse380", "observation.layout: 'HumanoidVerse380' is not supported: it needs a history of four "
         "observations, the phase of the clip, and a scale for each term; accepted: wbc132, mjlab160, mjlab154, "
         "root132"),
        ("asap380", "it needs a history of four observations, the phase"),
        ("wbc132_history5", "it needs a history of earlier observations; accepted: "),
        ("holosoma154", "it needs its terms in the order of their names; accepted: "),
    ],
)  # fmt: skip
def test_a_layout_that_is_not_there_is_refused_by_name_with_what_is_missing(tiny_config, name, message):
    with pytest.raises(InputError) as error:
        find_layout(name)
    assert message in str(error.value)
    with pytest.raises(InputError, match=r"^observation\.layout: "):
        make_setup(dataclasses.replace(tiny_config, observation=ObservationConfig(name)))
