import re
import xml.etree.ElementTree as ET
from pathlib import Path

import mujoco
import numpy as np
import pytest

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.robot.model import CONTACT_SENSOR, VISUAL_GROUP, load_robot, read_spec
from forgetmimic_jax.settings.config import PhysicsConfig

REFERENCES = Path(__file__).resolve().parents[3] / "shared/data/robots"

# Motor table of mjlab 1.6.0, asset_zoo/unitree_g1: joint pattern -> effort N m, armature kg m^2, kp, kd, action scale.
G1_MOTORS = {
    r".*_hip_(pitch|yaw)_joint|waist_yaw_joint": (88.0, 0.010178, 40.1792, 2.5579, 0.5475),
    r".*_(hip_roll|knee)_joint": (139.0, 0.025102, 99.0984, 6.3088, 0.3507),
    r".*_ankle_(pitch|roll)_joint|waist_(roll|pitch)_joint": (50.0, 0.007219, 28.5012, 1.8144, 0.4386),
    r".*_(shoulder_(pitch|roll|yaw)|elbow|wrist_roll)_joint": (25.0, 0.003610, 14.2506, 0.9072, 0.4386),
    r".*_wrist_(pitch|yaw)_joint": (5.0, 0.004250, 16.7783, 1.0681, 0.0745),
}
G1_RANGES = {  # rad
    "left_hip_pitch_joint": (-2.5307, 2.8798),
    "right_hip_roll_joint": (-2.9671, 0.5236),
    "left_knee_joint": (-0.0873, 2.8798),
    "waist_pitch_joint": (-0.5200, 0.5200),
    "left_shoulder_roll_joint": (-1.5882, 2.2515),
    "right_wrist_yaw_joint": (-1.6144, 1.6144),
}


@pytest.fixture(scope="module")
def g1():
    return load_robot("g1")


def unitrees(file):
    """Unitree's own robot without its meshes and shapes, which carry no mass."""
    if not (REFERENCES / file).is_file():
        pytest.skip(f"{file} is not beside this checkout (shared/data/robots)")
    root = ET.parse(REFERENCES / file).getroot()
    for parent in list(root.iter()):
        for child in list(parent):
            if child.tag in ("mesh", "visual", "collision") or (child.tag == "geom" and "mesh" in child.attrib):
                parent.remove(child)
    if root.tag == "robot":  # a URDF, whose base stands on nothing; fixed links become part of their parents
        root.remove(root.find("mujoco"))
        ET.SubElement(root, "link", name="world")
        joint = ET.SubElement(root, "joint", name="root", type="floating")
        ET.SubElement(joint, "parent", link="world")
        ET.SubElement(joint, "child", link="pelvis")
    return mujoco.MjModel.from_xml_string(ET.tostring(root, encoding="unicode"))


@pytest.fixture(scope="module")
def h2():
    return load_robot("h2")


@pytest.fixture(scope="module", params=[("g1", "g1_reference.xml"), ("h2", "H2.urdf")], ids=["g1", "h2"])
def both(request):
    """Our robot, and Unitree's model of it."""
    name, file = request.param
    return request.getfixturevalue(name), unitrees(file)


def at_zero(model):
    data = mujoco.MjData(model)
    data.qpos[:7] = [0, 0, 0, 1, 0, 0, 0]
    data.qpos[7:] = 0.0
    mujoco.mj_kinematics(model, data)
    return data


def world_inertia(model, data, body):
    rotation = data.body(body).ximat.reshape(3, 3)
    return rotation @ np.diag(model.body(body).inertia) @ rotation.T


def test_a_robot_is_unitrees_body_by_body(both):
    robot, reference = both
    ours, theirs = at_zero(robot.model), at_zero(reference)
    names = [reference.body(body).name for body in range(1, reference.nbody)]
    assert [robot.model.body(body).name for body in range(1, robot.model.nbody)] == names
    assert robot.model.body_subtreemass[1] == pytest.approx(reference.body_subtreemass[1], abs=1e-6)
    for name in names:
        assert robot.model.body(name).mass == pytest.approx(reference.body(name).mass), name
        np.testing.assert_allclose(ours.body(name).xpos, theirs.body(name).xpos, atol=2e-6, err_msg=name)
        np.testing.assert_allclose(ours.body(name).xmat, theirs.body(name).xmat, atol=2e-6, err_msg=name)
        np.testing.assert_allclose(ours.body(name).xipos, theirs.body(name).xipos, atol=2e-6, err_msg=name)
        inertias = world_inertia(robot.model, ours, name), world_inertia(reference, theirs, name)
        np.testing.assert_allclose(*inertias, atol=1e-8 + 2e-6 * np.trace(inertias[1]), err_msg=name)


def test_a_robot_is_unitrees_joint_by_joint(both):
    robot, reference = both
    ours, theirs = at_zero(robot.model), at_zero(reference)
    names = [reference.joint(j).name for j in range(reference.njnt) if reference.jnt_type[j] != 0]
    assert list(robot.joint_names) == names
    for name in names:
        np.testing.assert_allclose(ours.joint(name).xaxis, theirs.joint(name).xaxis, atol=1e-6, err_msg=name)
        np.testing.assert_allclose(ours.joint(name).xanchor, theirs.joint(name).xanchor, atol=2e-6, err_msg=name)
        np.testing.assert_allclose(robot.model.joint(name).range, reference.joint(name).range, atol=1e-5, err_msg=name)


def test_h2_weighs_76_kg_with_its_pelvis_and_hands(h2):
    assert float(h2.arrays.mass) == pytest.approx(75.587, abs=1e-3)
    assert h2.num_joints == 31
    assert len(h2.key_bodies) == 14
    # The link that carries the sole is the ankle's last one, which for the H2 is the pitch.
    assert [h2.key_bodies[foot] for foot in h2.feet] == ["left_ankle_pitch_link", "right_ankle_pitch_link"]
    assert [h2.joint_names.index(f"left_ankle_{axis}_joint") for axis in ("roll", "pitch")] == [4, 5]
    assert [h2.joint_names.index(name) for name in ("head_pitch_joint", "left_shoulder_pitch_joint")] == [15, 17]


def test_h2_motors_are_unitrees_and_its_gains_are_near_those_of_others(h2):
    file = REFERENCES / "H2.urdf"
    if not file.is_file():
        pytest.skip("H2.urdf is not beside this checkout (shared/data/robots)")
    limits = {joint.get("name"): joint.find("limit") for joint in ET.parse(file).getroot().findall("joint")}
    for index, joint in enumerate(h2.joint_names):
        assert float(h2.arrays.effort[index]) == pytest.approx(float(limits[joint].get("effort"))), joint
        assert h2.joint_velocity_limit[index] == pytest.approx(float(limits[joint].get("velocity"))), joint
    kp = dict(zip(h2.joint_names, h2.arrays.stiffness.tolist(), strict=True))
    # unitree_rl_mjlab holds legs with 200, waist with 150, ankles and arms with 40, wrists with 20.
    others = {"left_knee": 200.0, "waist_roll": 150.0, "left_ankle_pitch": 40.0, "left_elbow": 40.0}
    for joint, theirs in others.items():
        assert 0.5 < kp[f"{joint}_joint"] / theirs < 2.0, joint


def test_g1_weighs_33_kg(g1):
    assert float(g1.arrays.mass) == pytest.approx(33.341, abs=5e-4)
    assert g1.num_joints == 29
    assert len(g1.key_bodies) == 14
    assert g1.key_bodies[g1.anchor] == "torso_link"
    assert g1.key_bodies[g1.root] == "pelvis"


def test_g1_gains_and_action_scale(g1):
    matched = []
    for index, joint in enumerate(g1.joint_names):
        rows = [row for pattern, row in G1_MOTORS.items() if re.fullmatch(pattern, joint)]
        assert len(rows) == 1, joint
        effort, armature, kp, kd, scale = rows[0]
        actuator = g1.model.actuator(joint)
        assert actuator.gainprm[0] == pytest.approx(kp, rel=1e-4), joint
        assert actuator.biasprm[1] == pytest.approx(-kp, rel=1e-4), joint
        assert actuator.biasprm[2] == pytest.approx(-kd, rel=1e-4), joint
        np.testing.assert_allclose(actuator.forcerange, [-effort, effort])
        assert actuator.id == index, "actuators stand in the order of the joints"
        assert g1.model.dof_armature[g1.model.joint(joint).dofadr[0]] == pytest.approx(armature, abs=1e-6)
        assert float(g1.arrays.action_scale[index]) == pytest.approx(scale, abs=1e-4), joint
        matched.append(joint)
    assert len(matched) == 29


@pytest.mark.parametrize("joint", G1_RANGES)
def test_g1_ranges(g1, joint):
    index = g1.joint_names.index(joint)
    lower, upper = G1_RANGES[joint]
    assert (g1.joint_lower[index], g1.joint_upper[index]) == pytest.approx((lower, upper), abs=1e-4)
    # Soft limits keep the middle 90 %.
    margin = 0.05 * (upper - lower)
    assert float(g1.arrays.soft_lower[index]) == pytest.approx(lower + margin, abs=1e-4)
    assert float(g1.arrays.soft_upper[index]) == pytest.approx(upper - margin, abs=1e-4)


@pytest.mark.parametrize("name", ["g1", "h2"])
def test_a_robot_stands_on_its_soles_in_the_default_pose(name, request):
    robot = request.getfixturevalue(name)
    data = mujoco.MjData(robot.model)
    data.qpos[:7] = [0, 0, robot.default_height, 1, 0, 0, 0]
    data.qpos[7:] = robot.arrays.default_joint_pos
    mujoco.mj_kinematics(robot.model, data)
    lowest = data.geom_xpos[robot.foot_geom_ids, 2] - robot.model.geom_size[robot.foot_geom_ids, 0]
    np.testing.assert_allclose(lowest, 0.0, atol=0.01)


@pytest.mark.parametrize("name", ["g1", "h2"])
def test_a_robot_touches_nothing_of_itself_in_the_default_pose(name):
    robot = load_robot(name, PhysicsConfig(self_collision=True))
    data = mujoco.MjData(robot.model)
    data.qpos[:7] = [0, 0, 2.0, 1, 0, 0, 0]
    data.qpos[7:] = robot.arrays.default_joint_pos
    mujoco.mj_forward(robot.model, data)
    assert data.ncon == 0


def test_whole_body_inertia_is_the_composite_one(g1):
    # The mass matrix's rotational block about the root, moved to the centre of mass by the parallel-axis theorem.
    data = mujoco.MjData(g1.model)
    data.qpos[:7] = [0, 0, 0, 1, 0, 0, 0]
    data.qpos[7:] = g1.arrays.default_joint_pos
    mujoco.mj_forward(g1.model, data)
    mass_matrix = np.zeros((g1.model.nv, g1.model.nv))
    mujoco.mj_fullM(g1.model, data, mass_matrix)
    com = data.subtree_com[1]
    shift = float(g1.arrays.mass) * (com @ com * np.eye(3) - np.outer(com, com))
    np.testing.assert_allclose(g1.arrays.inertia, mass_matrix[3:6, 3:6] - shift, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("name", ["g1", "h2"])
def test_shapes_to_be_seen_weigh_nothing_touch_nothing_and_are_not_simulated(name, request):
    robot = request.getfixturevalue(name)
    drawn = read_spec(name).compile()
    seen = drawn.geom_group == VISUAL_GROUP
    assert seen.sum() > 50
    assert not drawn.geom_contype[seen].any()
    assert not drawn.geom_conaffinity[seen].any()
    assert robot.model.ngeom == (~seen).sum()
    assert VISUAL_GROUP not in robot.model.geom_group
    for field in ("body_mass", "body_inertia", "body_ipos", "body_iquat"):
        np.testing.assert_array_equal(getattr(drawn, field), getattr(robot.model, field), err_msg=field)
    for side in ("left", "right"):
        bodies = [drawn.body(body).name for body in drawn.geom_bodyid[seen]]
        assert sum(body.startswith(side) for body in bodies) > 20


def test_only_the_floor_is_touched_unless_self_collision_is_on(g1):
    other = load_robot("g1", PhysicsConfig(self_collision=True))
    shapes = np.flatnonzero(g1.model.geom_bodyid > 0)
    assert not g1.model.geom_contype[shapes].any()
    assert other.model.geom_contype[shapes].any()


def test_every_key_body_has_a_contact_sensor(g1):
    assert [g1.model.sensor(index).name for index in range(g1.model.nsensor)] == [
        CONTACT_SENSOR + body for body in g1.key_bodies
    ]


def test_unknown_robot_suggests_the_nearest():
    with pytest.raises(InputError, match=r"robot 'g11': .*did you mean 'g1'\?"):
        load_robot("g11")
