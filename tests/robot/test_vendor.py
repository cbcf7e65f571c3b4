"""A vendor's MJCF: what is mended, what is demanded, and the roles that follow from names and geometry."""

import re
import sys
import warnings
import xml.etree.ElementTree as ET
from pathlib import Path

import mujoco
import numpy as np
import pytest
import yaml

from forgetmimic_jax import robots
from forgetmimic_jax.basics.errors import InputError, run_command
from forgetmimic_jax.robot import model as robot_model
from forgetmimic_jax.robot.holding import hold
from forgetmimic_jax.robot.model import ROBOTS_DIR, load_robot
from forgetmimic_jax.robot.proposal import propose
from forgetmimic_jax.robot.vendor import Additions, Unreadable, read_mjcf
from forgetmimic_jax.settings.options import parse

H1 = Path(__file__).resolve().parents[3] / "shared/data/robots/unitree_h1_raw.xml"

# A humanoid as a vendor might publish it: another name for the ground, actuators called as joints, a cylinder, an
# ellipsoid, a body of scenery, no free joint, feet without a shape, and a keyframe of standing.
LEG = """
<body name="{side}_thigh" pos="0 {y} -0.05">
  <inertial pos="0 0 -0.2" mass="3" diaginertia="0.04 0.04 0.005"/>
  <joint name="{side}_hip_roll" axis="1 0 0" range="-0.5 0.5"/>
  <geom type="cylinder" size="0.05 0.15" pos="0 0 -0.2"/>
  <body name="{side}_upper" pos="0 0 0">
    <inertial pos="0 0 -0.2" mass="1" diaginertia="0.01 0.01 0.002"/>
    <joint name="{side}_hip_pitch" axis="0 1 0" range="-2 2"/>
    <body name="{side}_shin" pos="0 0 -0.4">
      <inertial pos="0 0 -0.2" mass="2" diaginertia="0.03 0.03 0.002"/>
      <joint name="{side}_knee" axis="0 -1 0" range="-2.5 0"/>
      <body name="{side}_foot" pos="0 0 -0.4">
        <inertial pos="0.05 0 -0.03" mass="0.6" diaginertia="0.0005 0.0029 0.0032"/>
        <joint name="{side}_ankle" axis="0 1 0" range="-0.9 0.6"/>
      </body>
    </body>
  </body>
</body>
"""
ARM = """
<body name="{side}_shoulder" pos="0 {y} 0.4">
  <inertial pos="0 0 -0.05" mass="1" diaginertia="0.003 0.003 0.001"/>
  <joint name="{side}_shoulder_pitch" axis="0 1 0" range="-2 2"/>
  <body name="{side}_upper_arm" pos="0 0 0">
    <inertial pos="0 0 -0.12" mass="1" diaginertia="0.006 0.006 0.001"/>
    <joint name="{side}_shoulder_roll" axis="1 0 0" range="-2 2"/>
    <geom type="ellipsoid" size="0.04 0.04 0.13" pos="0 0 -0.12"/>
    <body name="{side}_forearm" pos="0 0 -0.25">
      <inertial pos="0 0 -0.1" mass="0.6" diaginertia="0.003 0.003 0.0005"/>
      <joint name="{side}_elbow" axis="0 1 0" range="-2 0.1"/>
      <body name="{side}_hand" pos="0 0 -0.22">
        <inertial pos="0 0 -0.03" mass="0.3" diaginertia="0.0003 0.0003 0.0003"/>
        <joint name="{side}_wrist" axis="0 0 1" range="-1 1"/>
        <geom type="sphere" size="0.04"/>
      </body>
    </body>
  </body>
</body>
"""
JOINTS = ["hip_roll", "hip_pitch", "knee", "ankle", "shoulder_pitch", "shoulder_roll", "elbow", "wrist"]
TORQUES = {"hip_roll": 100, "hip_pitch": 100, "knee": 150, "ankle": 50, "shoulder_pitch": 30}
SIDES = (("left", 1), ("right", -1))


def vendors(replace=()):
    """The MJCF's text, after replacements."""
    legs = "".join(LEG.format(side=side, y=0.1 * sign) for side, sign in SIDES)
    arms = "".join(ARM.format(side=side, y=0.2 * sign) for side, sign in SIDES)
    motors = "".join(
        f'<motor name="{side}_{joint}" joint="{side}_{joint}" ctrlrange="-{TORQUES.get(joint, 20)} '
        f'{TORQUES.get(joint, 20)}"/>'
        for joint in JOINTS
        for side, _ in SIDES[::-1]
    )
    text = f"""<mujoco model="vendor"><compiler angle="radian"/><worldbody>
    <geom name="ground" type="plane" size="5 5 0.1" pos="0 0 -0.2"/>
    <body name="base" pos="0 0 0">
      <inertial pos="0 0 0" mass="8" diaginertia="0.1 0.1 0.1"/>
      <geom type="box" size="0.1 0.1 0.05"/>
      {legs}
      <body name="chest" pos="0 0 0.1">
        <inertial pos="0 0 0.2" mass="12" diaginertia="0.2 0.2 0.1"/>
        <joint name="waist" axis="0 0 1" range="-1 1"/>
        <geom type="capsule" size="0.1 0.15" pos="0 0 0.2"/>
        {arms}
      </body>
    </body>
    <body name="crate" pos="2 0 0.2"><geom type="box" size="0.2 0.2 0.2"/><joint name="crate" type="hinge"/></body>
    </worldbody>
    <actuator>{motors}<motor name="waist" joint="waist" ctrlrange="-60 60"/></actuator>
    <sensor><jointpos joint="waist"/></sensor></mujoco>"""
    for old, new in replace:
        assert old in text
        text = text.replace(old, new)
    return text


@pytest.fixture
def written(tmp_path):
    """written(replacements) -> the MJCF's file."""

    def write(*replace):
        (tmp_path / "vendor.xml").write_text(vendors(replace))
        return tmp_path / "vendor.xml"

    return write


@pytest.fixture
def made(tmp_path):
    """made(file, changes) -> the robot of the proposed roles."""

    def make(file, **changes):
        proposal = propose(file)
        folder = tmp_path / "robots" / "vendor"
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "vendor.yaml").write_text(yaml.safe_dump({**proposal.roles, "model": str(file), **changes}))
        return load_robot("vendor", robots_dir=folder.parent), proposal

    return make


def test_a_vendor_s_file_becomes_a_robot_and_stays_as_it_is(written, made):
    file = written()
    before = file.read_bytes()
    robot, proposal = made(file)
    assert file.read_bytes() == before
    assert proposal.missing == []
    model = robot.model
    assert model.nq == 7 + 17
    assert list(robot.joint_names) == [model.joint(joint).name for joint in range(1, model.njnt)]
    assert [model.actuator(joint).id for joint in robot.joint_names] == list(range(17))
    assert float(robot.arrays.mass) == pytest.approx(8 + 12 + 2 * (3 + 1 + 2 + 0.6) + 2 * (1 + 1 + 0.6 + 0.3), rel=1e-6)
    effort = dict(zip(robot.joint_names, robot.arrays.effort.tolist(), strict=True))
    assert (effort["left_knee"], effort["right_ankle"], effort["waist"], effort["left_wrist"]) == (150, 50, 60, 20)
    floor = model.geom("floor")
    assert (floor.pos[2], int(floor.contype[0]), int(floor.conaffinity[0])) == (0.0, 1, 0)
    kinds = {int(model.geom_type[geom]) for geom in range(1, model.ngeom)}
    assert kinds <= {
        int(mujoco.mjtGeom.mjGEOM_SPHERE),
        int(mujoco.mjtGeom.mjGEOM_CAPSULE),
        int(mujoco.mjtGeom.mjGEOM_BOX),
    }
    assert not any(model.geom_contype[1:])
    notes = "\n".join(proposal.notes)
    for said in ("crate", "17 actuators", "a free joint is added to base", "ground is replaced", "cylinder, ellipsoid"):
        assert said in notes


def test_a_cylinder_and_an_ellipsoid_become_capsules_of_their_length(written):
    """Cylinder of radius 5 cm and length 30 cm; ellipsoid of 26 cm, 4 cm across: capsules as long, and as thick."""
    model = read_mjcf(written())[0].compile()
    sizes = {}
    for geom in range(model.ngeom):
        if model.geom_conaffinity[geom]:
            sizes.setdefault(model.body(model.geom_bodyid[geom]).name, []).append(model.geom_size[geom])
    np.testing.assert_allclose(sizes["left_thigh"][0][:2], [0.05, 0.10])
    np.testing.assert_allclose(sizes["left_upper_arm"][0][:2], [0.04, 0.09])


def test_roles_follow_from_names_and_geometry(written):
    roles = propose(written()).roles
    assert roles["anchor"] == "chest"
    assert {role: pair[0] for role, pair in roles["pairs"].items()} == {
        "hips": "left_upper",
        "knees": "left_shin",
        "feet": "left_foot",
        "shoulders": "left_upper_arm",
        "elbows": "left_forearm",
        "hands": "left_hand",
    }
    assert all(right == left.replace("left", "right") for left, right in roles["pairs"].values())
    assert roles["key_bodies"][0] == "base"
    assert roles["ignored_motors"] == ["left_wrist", "right_wrist"]


def test_roles_without_telling_names(written):
    """Bodies and joints called b0, b1, ... and j0, j1, ...: the sides and the bends follow from the geometry."""
    file = written()
    tree = ET.parse(file)
    called = {}
    for tag, letter in (("body", "b"), ("joint", "j")):
        for number, element in enumerate(tree.getroot().find("worldbody").iter(tag)):
            called[element.attrib["name"]] = f"{letter}{number}"
            element.attrib["name"] = f"{letter}{number}"
    for motor in tree.getroot().find("actuator"):
        motor.attrib["joint"] = called[motor.attrib["joint"]]
    for sensor in tree.getroot().find("sensor"):
        sensor.attrib["joint"] = called[sensor.attrib["joint"]]
    named = propose(file).roles
    tree.write(file)
    found = propose(file).roles
    bodies = {element: called[element] for pair in named["pairs"].values() for element in pair}
    for role in ("hips", "knees", "feet", "shoulders", "elbows", "hands"):
        assert found["pairs"][role] == [bodies[body] for body in named["pairs"][role]], role
    assert found["anchor"] == called["chest"]


def test_the_g1_s_own_roles_are_proposed():
    """What was chosen by hand for the G1 and the H2 follows from their MJCF."""
    for name in ("g1", "h2"):
        roles = yaml.safe_load((ROBOTS_DIR / name / f"{name}.yaml").read_text())
        found = propose(ROBOTS_DIR / name / f"{name}.xml").roles
        for field in ("anchor", "pairs", "end_effectors"):
            assert found[field] == roles[field], (name, field)
        assert set(found["key_bodies"]) == set(roles["key_bodies"])


def test_a_foot_without_a_shape_gets_a_sole_from_its_inertia(written):
    """A box of 0.6 kg with these moments is 23.65 x 9.0 x 4.0 cm: edges from m (b^2 + c^2) / 12."""
    spheres = [sphere for sphere in propose(written()).roles["spheres"] if "foot" in sphere[0]]
    assert [sphere[0] for sphere in spheres] == ["left_foot"] * 4 + ["right_foot"] * 4
    places = np.array([sphere[1:4] for sphere in spheres[:4]])
    moments = np.array([0.0005, 0.0029, 0.0032])
    edges = np.sqrt(6 / 0.6 * (moments.sum() - 2 * moments))
    assert edges == pytest.approx([0.2366, 0.0894, 0.0447], abs=1e-3)
    np.testing.assert_allclose(np.ptp(places, axis=0)[:2], edges[:2] - 0.02, atol=2e-4)
    np.testing.assert_allclose(places[:, 2], -0.03 - edges[2] / 2 + 0.01, atol=1e-4)


def test_key_bodies_without_a_shape_get_a_ball(written, made):
    robot, proposal = made(written())
    balls = [sphere for sphere in proposal.roles["spheres"] if "foot" not in sphere[0]]
    expected = ["left_upper", "left_shin", "right_upper", "right_shin", "left_forearm", "right_forearm"]
    assert sorted(balls) == sorted([body, 0.0, 0.0, 0.0, 0.05] for body in expected)
    touching = {robot.model.body(body).name for body in robot.model.geom_bodyid[robot.model.geom_conaffinity > 0]}
    assert touching >= set(robot.key_bodies)


def test_the_head_is_found_with_a_shape_or_without(written, made):
    chest = '<geom type="capsule" size="0.1 0.15" pos="0 0 0.2"/>'
    inertial = '<inertial pos="0 0 0.1" mass="1" diaginertia="0.01 0.01 0.01"/>'
    for shape, name in (("", "head_link_sphere"), ('<geom size="0.1"/>', "head_link_shape0")):
        head = f'{chest}<body name="head_link" pos="0 0 0.5">{inertial}{shape}</body>'
        robot, proposal = made(written((chest, head)))
        (found,) = proposal.roles["head"]
        assert found.startswith(name)
        assert [robot.model.geom(geom).name for geom in robot.head_geom_ids] == [found]


def test_knees_bend_the_right_way_and_the_robot_stands(written, made):
    """The knee's axis is -y and its range -2.5 to 0: it bends to -0.6. The centre of mass is over the soles' middle."""
    robot, proposal = made(written())
    pose = proposal.roles["default_pose"]
    assert pose["left_knee"] == pose["right_knee"] == -0.6
    assert pose["left_hip_pitch"] + pose["left_ankle"] == pytest.approx(-0.6, abs=1e-3)
    data = mujoco.MjData(robot.model)
    data.qpos[:7] = [0, 0, robot.default_height, 1, 0, 0, 0]
    data.qpos[7:] = robot.arrays.default_joint_pos
    mujoco.mj_kinematics(robot.model, data)
    mujoco.mj_comPos(robot.model, data)
    soles = data.geom_xpos[robot.foot_geom_ids]
    assert np.abs(soles[:, 2] - 0.01).max() < 2e-3
    middle = 0.5 * (soles[:, 0].min() + soles[:, 0].max())
    assert data.subtree_com[1, 0] == pytest.approx(middle, abs=3e-3)
    held = hold(robot)
    assert held.stands, str(held)


def test_a_keyframe_of_standing_is_the_default_pose(written):
    angles = "0 0 0.9  1 0 0 0 " + " ".join(["0 -0.2 -0.5 -0.3"] * 2) + " 0.1" + " 0.4 0 -0.2 0" * 2
    lying = angles.replace("1 0 0 0", "0 1 0 0")
    keys = f'<keyframe><key name="fallen" qpos="{lying} 0"/><key name="home" qpos="{angles} 0"/>'
    with_root = ('<body name="base" pos="0 0 0">', '<body name="base" pos="0 0 1"><freejoint/>')
    pose = propose(written(with_root, ("</mujoco>", f"{keys}</keyframe></mujoco>"))).roles["default_pose"]
    assert (pose["waist"], pose["left_elbow"], pose["left_knee"]) == (0.1, -0.2, -0.5)


@pytest.mark.parametrize(
    ("replace", "missing"),
    [
        ([('joint="waist" ctrlrange="-60 60"', 'joint="waist"')], "torque limits of the joints waist; mend"),
        (
            [('<joint name="waist" axis="0 0 1" range="-1 1"/>', '<joint name="waist" axis="0 0 1"/>')],
            "limits of the joints waist",
        ),
        (
            [('<joint name="left_wrist" axis="0 0 1"', '<joint type="slide" name="left_wrist" axis="0 0 1"')],
            "no hinges",
        ),
        (
            [('name="right_wrist" axis="0 0 1"', 'name="right_wrist" axis="0 0 1" type="slide"')],
            "welded by `fixed`: right_wrist",
        ),
    ],
)
def test_what_is_missing_is_said_with_its_mend(written, replace, missing):
    lines = propose(written(*replace)).missing
    assert any(missing in line for line in lines), lines


def test_everything_that_is_missing_is_said_at_once_and_can_be_given_in_the_yaml(written, made):
    file = written(
        ('joint="waist" ctrlrange="-60 60"', 'joint="waist"'),
        ('<joint name="waist" axis="0 0 1" range="-1 1"/>', '<joint name="waist" axis="0 0 1"/>'),
    )
    with pytest.raises(InputError) as caught:
        made(file)
    assert "no range of joint 'waist'; mend: ranges: {waist: [lower, upper]}" in str(caught.value)
    assert "motors: unknown: effort: found None" in str(caught.value)
    motors = propose(file).roles["motors"]
    motors["unknown"] |= {"effort": 60.0, "armature": 0.01}
    robot, _ = made(file, motors=motors, ranges={"waist": [-1.5, 1.0]})
    waist = robot.joint_names.index("waist")
    assert (robot.joint_lower[waist], robot.joint_upper[waist]) == (-1.5, 1.0)
    # In a file of degrees, too, the YAML's ranges are in rad.
    spec, _ = read_mjcf(written(('angle="radian"', 'angle="degree"')), Additions(ranges={"waist": (-1.5, 1.0)}))
    np.testing.assert_allclose(spec.compile().joint("waist").range, [-1.5, 1.0])
    with pytest.raises(InputError, match=r"ranges: waist: found \[1, -1\]; accepted: the lower limit first"):
        made(file, motors=motors, ranges={"waist": [1, -1]})


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<mujoco/>", "no body; a robot is a tree"),
        ("<mujoco><worldbody><body><geom size='1'/></body></worldbody></mujoco>", "no joint; a robot is a tree"),
        (
            "<mujoco><worldbody><body name='arm'><joint/><geom size='1'/></body></worldbody></mujoco>",
            "arm hangs on the world by a hinge; mend: put <freejoint/> in its place",
        ),
        (
            "<mujoco><worldbody><body name='base'><body name='arm'><joint/><geom size='1'/></body></body></worldbody>"
            "</mujoco>",
            "base floats and has no mass; mend: give it one (<inertial>)",
        ),
        ("<mujoco><worldbody><body>", "no MJCF that MuJoCo reads"),
        ("no xml", "no MJCF that MuJoCo reads"),
    ],
)
def test_what_is_no_robot(tmp_path, text, message):
    (tmp_path / "a.xml").write_text(text)
    with pytest.raises(Unreadable, match=re.escape(message)):
        propose(tmp_path / "a.xml")


def test_a_root_of_slides_and_hinges_is_a_free_joint(written):
    joints = "".join(f'<joint type="slide" axis="{axis}"/>' for axis in ("1 0 0", "0 1 0", "0 0 1"))
    spec, notes = read_mjcf(written(('<body name="base" pos="0 0 0">', f'<body name="base" pos="0 0 1">{joints}')))
    model = spec.compile()
    assert model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE
    assert model.nq == 7 + 17
    assert "3 joints of base are replaced by a free joint" in notes


@pytest.mark.parametrize("name", ["floor", "left_thigh_shape0", "left_foot_sphere0"])
def test_a_shape_whose_name_the_project_needs_is_called_otherwise(written, made, name):
    box = '<geom type="box" size="0.1 0.1 0.05"/>'
    model = made(written((box, box.replace("<geom", f'<geom name="{name}"'))))[0].model
    assert model.body(model.geom(f"{name}_0").bodyid[0]).name == "base"
    assert model.body(model.geom(name).bodyid[0]).name != "base"


def test_a_joint_without_a_name_gets_one_that_is_free(written):
    file = written(
        ('<joint name="left_wrist" axis', "<joint axis"), ('name="waist" axis', 'name="left_hand_joint0" axis')
    )
    without = re.sub("<(actuator|sensor)>.*</(actuator|sensor)>", "", file.read_text(), flags=re.DOTALL)
    file.write_text(without)
    spec, _ = read_mjcf(file)
    assert [joint.name for joint in spec.body("left_hand").joints] == ["left_hand_joint1"]


def test_bodies_without_a_joint_may_be_fused(written, made):
    """A URDF fuses them, into the world too."""
    cover = '<body name="cover"><geom type="box" size="0.1 0.1 0.1" mass="3"/></body><body name="chest"'
    robot, _ = made(written(('angle="radian"', 'angle="radian" fusestatic="true"'), ('<body name="chest"', cover)))
    assert float(robot.arrays.mass) == pytest.approx(42.0)


@pytest.mark.parametrize("place", ['pos="0 0 -0.2"', 'euler="0.3 0 0"', 'type="box"'])
def test_a_floor_of_the_vendor_s_is_replaced_where_it_is_not_level_ground(written, place):
    plane = '<geom name="ground" type="plane" size="5 5 0.1" pos="0 0 -0.2"/>'
    kind = "" if "type" in place else 'type="plane"'
    spec, notes = read_mjcf(written((plane, f'<geom name="floor" {kind} {place} size="5 5 0.1"/>')))
    floor = spec.compile().geom("floor")
    assert (floor.type, floor.pos[2], floor.quat[0]) == (mujoco.mjtGeom.mjGEOM_PLANE, 0.0, 1.0)
    assert any(note.startswith("the ground is ") for note in notes)


@pytest.mark.parametrize(
    ("option", "note"),
    [
        ('gravity="0 0 0"', "gravity: 0 0 0 is replaced by 0 0 -9.81"),
        ('density="1000" wind="9 0 0"', "wind: 9 0 0 is replaced by 0 0 0"),
        ('actuatorgroupdisable="0"', "disableactuator: 1 is replaced by 0"),
        ('solver="PGS" timestep="0.1"', "solver: pgs is replaced by newton"),
        ('><flag gravity="disable" contact="disable"/></option', "disableflags: contact gravity is replaced by none"),
        ('o_solref="0.5 1"><flag override="enable"/></option', "enableflags: override is replaced by none"),
    ],
)
def test_the_vendor_s_option_is_replaced_by_the_project_s(written, option, note):
    end = "" if "</" in option else "/"
    spec, notes = read_mjcf(written(("<worldbody>", f"<option {option}{end}><worldbody>")))
    assert f"<option> {note}" in notes
    assert not any("timestep" in note for note in notes)  # the project's settings say it, whatever the file does
    found, ours = spec.compile().opt, mujoco.MjSpec().compile().opt
    for field in ("gravity", "density", "wind", "disableactuator", "solver", "disableflags", "enableflags", "o_solref"):
        np.testing.assert_array_equal(getattr(found, field), getattr(ours, field), err_msg=field)


@pytest.mark.parametrize("gravity", ["option", "gravcomp"])
def test_a_robot_that_gravity_does_not_pull_is_held_by_its_motors_alone(written, made, gravity):
    """With motors of 1 N m it stands only where nothing weighs."""
    file = written()
    text = re.sub(r'ctrlrange="[^"]*"', 'ctrlrange="-1 1"', file.read_text())
    if gravity == "option":
        text = text.replace("<worldbody>", '<option gravity="0 0 0"/><worldbody>')
    else:
        text = re.sub("<body ", '<body gravcomp="1" ', text)
    file.write_text(text)
    assert not hold(made(file)[0]).stands


def test_a_robot_whose_simulation_diverges_does_not_stand(written, made):
    """Its foot is a hundred thousand kilometres away."""
    file = written(('left_foot" pos="0 0 -0.4"', 'left_foot" pos="0 99999999 -0.4"'))
    held = hold(made(file)[0])
    assert not held.stands
    assert str(held).startswith("the simulation diverges; ")


@pytest.mark.parametrize("name", ["vendor.xml", "shell.stl", "skin.png"])
def test_a_git_lfs_pointer(run, written, tmp_path, name):
    files = '<mesh name="shell" file="shell.stl"/><texture name="skin" type="2d" file="skin.png"/>'
    file = written(("<worldbody>", f"<asset>{files}</asset><worldbody>"))
    (tmp_path / name).write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n")
    message = f"error: {tmp_path / name}: this is a Git LFS pointer, not the file: run git lfs pull\n"
    assert run("check", file) == (2, "", message)


@pytest.mark.filterwarnings("error")
def test_a_total_mass_is_kept_and_no_warning_of_mujoco_is_printed(written, made):
    """Robot and crate weigh 39 + 64 kg, and by `settotalmass`, which MuJoCo calls deprecated, twice as much."""
    plain = read_mjcf(written())[0].compile()
    robot, _ = made(written(('angle="radian"', 'angle="radian" settotalmass="206"')))
    assert float(robot.arrays.mass) == pytest.approx(78.0)
    for body in ("base", "left_shin"):
        np.testing.assert_allclose(robot.model.body(body).inertia, 2.0 * plain.body(body).inertia, rtol=1e-6)


@pytest.mark.filterwarnings("error")
def test_what_mujoco_warns_of_is_said_once(written, made, monkeypatch):
    compile_spec = mujoco.MjSpec.compile

    def warns(spec):
        warnings.warn("two\nlines", stacklevel=1)
        return compile_spec(spec)

    monkeypatch.setattr(mujoco.MjSpec, "compile", warns)
    _, proposal = made(written())
    assert proposal.notes.count("MuJoCo says: two lines") == 1


def test_our_own_robots_need_no_mend():
    for name in ("g1", "h2"):
        file = ROBOTS_DIR / name / f"{name}.xml"
        spec, notes = read_mjcf(file)
        assert notes == []
        ours, plain = spec.compile(), mujoco.MjModel.from_xml_path(str(file))
        for field in (
            "body_mass",
            "body_inertia",
            "geom_size",
            "geom_pos",
            "geom_conaffinity",
            "geom_group",
            "geom_type",
        ):
            np.testing.assert_array_equal(getattr(ours, field), getattr(plain, field), err_msg=field)


def test_meshes_that_are_not_there_are_left_out(written):
    mesh = ("<worldbody>", '<asset><mesh name="shell" file="shell.stl"/></asset><worldbody>')
    geom = ('<geom type="box" size="0.1 0.1 0.05"/>', '<geom type="mesh" mesh="shell"/>')
    spec, notes = read_mjcf(written(mesh, geom))
    spec.compile()
    assert any("mesh files are not in" in note and "shell" in note for note in notes)


def test_textures_that_are_not_there_are_left_out(written):
    assets = '<asset><texture name="t" type="2d" file="t.png"/><material name="m" texture="t" rgba="1 0 0 1"/></asset>'
    geom = ('<geom type="box" size="0.1 0.1 0.05"/>', '<geom type="box" size="0.1 0.1 0.05" material="m"/>')
    spec, notes = read_mjcf(written(("<worldbody>", f"{assets}<worldbody>"), geom))
    model = spec.compile()
    np.testing.assert_array_equal(model.geom("base_shape0").rgba, [1, 0, 0, 1])
    assert "texture files are not there: materials are left out" in notes


def test_a_mesh_becomes_the_capsule_that_fits_it(written, tmp_path):
    """A box of 20 x 6 x 6 cm as a mesh: a capsule about x, as long as it within a few cm."""
    corners = [(x, y, z) for x in (-0.1, 0.1) for y in (-0.03, 0.03) for z in (-0.03, 0.03)]
    vertices = " ".join(str(part) for corner in corners for part in corner)
    mesh = ("<worldbody>", f'<asset><mesh name="shell" vertex="{vertices}"/></asset><worldbody>')
    geom = ('<geom type="sphere" size="0.04"/>', '<geom type="mesh" mesh="shell"/>')
    model = read_mjcf(written(mesh, geom))[0].compile()
    hand = model.body("left_hand").id
    (geom_id,) = [g for g in range(model.ngeom) if model.geom_bodyid[g] == hand and model.geom_conaffinity[g]]
    assert model.geom_type[geom_id] == mujoco.mjtGeom.mjGEOM_CAPSULE
    radius, half = model.geom_size[geom_id][:2]
    assert 0.16 < 2 * (radius + half) < 0.26
    axis = np.zeros(3)
    mujoco.mju_rotVecQuat(axis, np.array([0.0, 0.0, 1.0]), model.geom_quat[geom_id])
    assert abs(axis[0]) > 0.99


def test_spheres_take_the_place_of_a_body_s_shapes(written):
    spheres = [("left_hand", 0.0, 0.0, -0.05, 0.02)]
    model = read_mjcf(written(), Additions(spheres=spheres))[0].compile()
    hand = model.body("left_hand").id
    touching = [g for g in range(model.ngeom) if model.geom_bodyid[g] == hand and model.geom_conaffinity[g]]
    assert [float(model.geom_size[g, 0]) for g in touching] == [0.02]


@pytest.fixture
def run(monkeypatch, capsys, tmp_path):
    """run(arguments) -> (exit code, standard output, standard error), in an empty working directory."""
    monkeypatch.chdir(tmp_path)

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["robot", *map(str, arguments)])
        code = 0
        try:
            run_command(lambda: robots.main(parse(robots.Options, "robot")))
        except SystemExit as ending:
            code = ending.code
        shown = capsys.readouterr()
        return code, shown.out, shown.err

    return call


def test_check_then_add(run, written, monkeypatch, tmp_path):
    file = written()
    code, out, _ = run("check", file)
    assert code == 0
    assert "vendor: 17 joints, 39.0 kg; holds its default pose for 1 s" in out
    assert (tmp_path / "runs/robots/vendor/vendor.png").is_file()
    assert "--force replaces it" in run("check", file)[2]
    monkeypatch.setattr(robot_model, "ROBOTS_DIR", tmp_path / "added")
    code, out, _ = run("add", "runs/robots/vendor/vendor.yaml")
    assert code == 0
    assert out.endswith("Next: make motions ARGS='import MOTION.csv --fps 30' ROBOT=vendor\n")
    assert load_robot("vendor", robots_dir=tmp_path / "added").num_joints == 17
    assert "a robot of this name is there" in run("add", "runs/robots/vendor/vendor.yaml")[2]


def test_check_ends_with_2_where_something_is_missing(run, written, tmp_path):
    code, out, err = run("check", written(('joint="waist" ctrlrange="-60 60"', 'joint="waist"')))
    assert code == 2
    assert "missing: torque limits of the joints waist" in out
    assert "1 thing(s) are missing" in err
    assert out.endswith("Next: make robot ARGS='check runs/robots/vendor/vendor.yaml'\n")
    for command in ("check", "add"):
        assert "motors: unknown: effort" in run(command, "runs/robots/vendor/vendor.yaml")[2]
    for arguments, message in (
        (("check", "none.xml"), "not found"),
        (("check", tmp_path / "vendor.xml", "--name", "a b"), "small letters"),
        (("add", "none.yaml"), "not found"),
    ):
        code, out, err = run(*arguments)
        assert (code, out, message in err) == (2, "", True)


def test_a_yaml_that_was_completed_is_checked(run, written, tmp_path):
    run("check", written(('joint="waist" ctrlrange="-60 60"', 'joint="waist"')))
    file = Path("runs/robots/vendor/vendor.yaml")
    file.write_text(file.read_text().replace("armature: null, effort: null", "armature: 0.01, effort: 60.0"))
    code, out, err = run("check", file)
    assert (code, err) == (0, "")
    assert "holds its default pose for 1 s" in out
    assert out.endswith(f"Next: make robot ARGS='add {file}'\n")


def test_radians_that_are_read_as_degrees_are_found_by_check_and_by_add(run, written):
    """A leg's ranges are 1, 4, 2.5 and 1.5; 2 degrees are 0.035 rad."""
    line = "ranges of the legs' joints: found a median of 0.035 rad; are they radians? Mend, in the MJCF: "
    code, out, _ = run("check", written(('angle="radian"', 'angle="degree"')))
    assert (code, f"missing: {line}" in out) == (2, True)
    code, _, err = run("add", "runs/robots/vendor/vendor.yaml")
    assert (code, line in err) == (2, True)


def test_names_that_say_the_other_side_are_doubted(run, written, tmp_path):
    """A robot that faces -x has its left at negative y."""
    file = written()
    swapped = re.sub("left_|right_", lambda side: {"left_": "right_", "right_": "left_"}[side[0]], file.read_text())
    file.write_text(swapped)
    code, _, err = run("check", file)
    line = "pairs: left is 'right_upper' and right is 'left_upper': the names say the other side: does it face -x?"
    assert (code, err) == (0, f"warning: {line}\n")
    assert f"# - {line}" in (tmp_path / "runs/robots/vendor/vendor.yaml").read_text().splitlines()
    assert propose(written()).doubts == []


def test_limbs_that_are_not_alike_are_found_by_check(run, written, tmp_path):
    wrist = '<joint name="right_wrist" axis="0 0 1" range="-1 1"/>'
    motor = '<motor name="right_wrist" joint="right_wrist" ctrlrange="-20 20"/>'
    code, out, err = run("check", written((wrist, ""), (motor, "")))
    assert code == 2
    line = "pairs: hands: the left limb has 4 joints and the right one 3; accepted: as many"
    assert f"missing: {line}" in out.splitlines()
    assert f"# - {line}" in (tmp_path / "runs/robots/vendor/vendor.yaml").read_text().splitlines()
    assert out.endswith("Next: make robot ARGS='check runs/robots/vendor/vendor.yaml'\n")
    assert err.startswith(f"error: {tmp_path}/vendor.xml: 3 thing(s) are missing; complete ")


def test_the_h1_unchanged(made):
    """Unitree's own file: 19 joints, its keyframe's knees, torque limits of its motors, and it holds its pose."""
    if not H1.is_file():
        pytest.skip("the H1 is not committed: no ../shared/data/robots beside this checkout")
    robot, proposal = made(H1)
    assert proposal.missing == []
    assert robot.num_joints == 19
    assert float(robot.arrays.mass) == pytest.approx(51.65, abs=0.01)
    effort = dict(zip(robot.joint_names, robot.arrays.effort.tolist(), strict=True))
    assert (effort["left_knee_joint"], effort["right_ankle_joint"], effort["left_elbow_joint"]) == (300, 40, 18)
    assert robot.key_bodies[robot.anchor] == "torso_link"
    assert proposal.roles["default_pose"]["left_knee_joint"] == 0.8
    assert robot.default_height == pytest.approx(0.98, abs=0.01)  # as its keyframe
    held = hold(robot)
    assert held.stands, str(held)
    assert held.tilt < 20.0
