"""The YAML of roles: every fault of it is found_message, and left and right follow from the pairs."""

import re

import pytest
import yaml

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.robot.model import ROBOTS_DIR, load_robot, robot_names


@pytest.fixture
def edited(tmp_path):
    """Load the G1 after one edit of its roles, and of its MJCF's text."""

    def load(edit, mjcf=lambda text: text):
        folder = tmp_path / "g1"
        folder.mkdir(exist_ok=True)
        (folder / "g1.xml").write_text(mjcf((ROBOTS_DIR / "g1/g1.xml").read_text()))
        roles = yaml.safe_load((ROBOTS_DIR / "g1/g1.yaml").read_text())
        edit(roles)
        (folder / "g1.yaml").write_text(yaml.safe_dump(roles))
        assert robot_names(tmp_path) == ["g1"]
        return load_robot("g1", robots_dir=tmp_path)

    return load


def lines(load, *arguments):
    """What is wrong, without the file's name."""
    with pytest.raises(InputError) as error:
        load(*arguments)
    found = str(error.value).split("\n")
    assert all("g1.yaml: " in line for line in found)
    return [line.split("g1.yaml: ")[1] for line in found]


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda roles: roles.pop("anchor"), "missing field 'anchor'"),
        (lambda roles: roles.update(ancor="torso_link"), "unknown field 'ancor'; did you mean 'anchor'?"),
        (lambda roles: roles.update(anchor="torso"), "anchor: no body 'torso' in g1.xml; did you mean 'torso_link'?"),
        (lambda roles: roles.update(anchor="head"), "anchor: no body 'head' in g1.xml"),
        (lambda roles: roles.update(anchor="waist_yaw_link"), "anchor: 'waist_yaw_link' must be among key_bodies"),
        (lambda roles: roles.update(anchor=3), "anchor: found 3; accepted: a name"),
        (lambda roles: roles["key_bodies"].append("left_foo_link"), "key_bodies: no body 'left_foo_link'"),
        (lambda roles: roles["key_bodies"].append("pelvis"), "key_bodies: 'pelvis' stands there twice"),
        (lambda roles: roles["key_bodies"].remove("pelvis"), "key_bodies: the floating base 'pelvis' must be among"),
        (
            lambda roles: roles["end_effectors"].append("waist_yaw_link"),
            "end_effectors: 'waist_yaw_link' must be among",
        ),
        (
            lambda roles: roles["pairs"].update(feet=["left_ankle_roll_link", "left_toe"]),
            "pairs: feet: no body 'left_toe'",
        ),
        (lambda roles: roles["pairs"].update(feet=["left_ankle_roll_link"]), "pairs: feet: found 1 names"),
        (lambda roles: roles["pairs"].pop("elbows"), "pairs: missing 'elbows'"),
        (lambda roles: roles.pop("head"), "missing field 'head'"),
        (lambda roles: roles.update(head="head"), "head: found 'head'; accepted: a list of names"),
        (
            lambda roles: roles.update(head=["haed"]),
            "head: no geom 'haed' in g1.xml touches the floor; did you mean 'head'?",
        ),
        (lambda roles: roles["pairs"].update(elbow=["a", "b"]), "pairs: unknown 'elbow'; did you mean 'elbows'?"),
        (lambda roles: roles["pairs"]["knees"].reverse(), "'right_hip_pitch_link' is on the left, but on the right by"),
        (
            lambda roles: roles["pairs"].update(knees=["left_knee_link", "left_hip_roll_link"]),
            "pairs: knees: 'left_knee_link' and 'left_hip_roll_link' are one body, or one carries the other",
        ),
        (
            lambda roles: roles["pairs"].update(hands=["left_wrist_yaw_link", "right_hip_roll_link"]),
            "pairs: hands: the left limb has 17 joints and the right one 6",
        ),
        (lambda roles: roles["default_pose"].update(left_kneee_joint=0.1), "did you mean 'left_knee_joint'"),
        (
            lambda roles: roles["default_pose"].update(left_knee_joint="bent"),
            "default_pose: left_knee_joint: found 'bent'",
        ),
        (lambda roles: roles["joint_motors"].pop(0), "no pattern matches joint 'left_hip_pitch_joint', 'left_hip_yaw"),
        (lambda roles: roles["joint_motors"].insert(0, [".*", "nuclear"]), "joint_motors: no motor 'nuclear'"),
        (lambda roles: roles["joint_motors"].insert(0, ["(", "arm"]), "joint_motors: '(' is no regular expression"),
        (lambda roles: roles.update(joint_motors={"a": "b"}), "joint_motors: found {'a': 'b'}; accepted: a list of"),
        (lambda roles: roles.update(ignored_motors=["wrist"]), "ignored_motors: no joint matches 'wrist'"),
        (lambda roles: roles["motors"]["arm"].pop("effort"), "motors: arm: missing 'effort'"),
        (lambda roles: roles["motors"]["arm"].update(effort=-5), "motors: arm: effort: found -5; accepted: above 0"),
        (
            lambda roles: roles.update(soft_limit_factor=1.5),
            "soft_limit_factor: found 1.5; accepted: above 0, at most 1",
        ),
        (
            lambda roles: roles.update(default_height=float("nan")),
            "default_height: found nan; accepted: a finite number",
        ),
        (lambda roles: roles.update(model="g2.xml"), "model: no file 'g2.xml'"),
    ],
)
def test_a_broken_field_is_one_clear_line(edited, edit, message):
    (found,) = lines(edited, edit)
    assert message in found


def test_every_fault_is_named_at_once(edited):
    """Of the YAML's fields, and of its names in the MJCF."""

    def edit(roles):
        del roles["anchor"], roles["motors"]["wrist"]["velocity"]
        roles["soft_limit_factor"] = 0
        roles["default_pose"]["tail"] = 0.1
        roles["key_bodies"].append("wing")

    assert [line.split(";")[0] for line in lines(edited, edit)] == [
        "missing field 'anchor'",
        "soft_limit_factor: found 0",
        "motors: wrist: missing 'velocity'",
        "key_bodies: no body 'wing' in g1.xml",
        "default_pose: no joint 'tail'",
    ]


@pytest.mark.parametrize(
    ("mjcf", "message"),
    [
        (lambda text: re.sub("<body.*</body>", "", text, flags=re.S), "model: no body; a robot is a tree of bodies"),
        (
            lambda text: text.replace('<joint name="waist_roll_joint"', '<joint type="slide" name="waist_roll_joint"'),
            "model: joint 'waist_roll_joint' is no hinge; mend: hinges in its place, or weld it (fixed: [its name])",
        ),
        (lambda text: text.replace(' range="-0.52 0.52"', ""), "model: no range of joint 'waist_roll_joint', 'waist_p"),
        (lambda text: text.replace("</mujoco>", ""), "model: g1.xml is no MJCF that MuJoCo reads: XML"),
    ],
)
def test_an_mjcf_that_does_not_fit_is_one_clear_line(edited, mjcf, message):
    (found,) = lines(edited, lambda roles: None, mjcf)
    assert message in found


@pytest.mark.parametrize("text", ["name: [g1\n", "- g1\n", "\xff"])
def test_a_yaml_that_is_no_table_is_one_clear_line(tmp_path, text):
    (tmp_path / "g1").mkdir()
    (tmp_path / "g1/g1.yaml").write_bytes(text.encode("latin-1"))
    with pytest.raises(InputError, match=r"g1\.yaml: (not YAML|found .*; accepted: a table)") as error:
        load_robot("g1", robots_dir=tmp_path)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", ["g1", "h2"])
def test_unitrees_names_agree_with_the_sides(name):
    robot = load_robot(name)
    for body, side in enumerate(robot.body_sides):
        called = robot.model.body(body).name
        assert side == next((side for side in ("left", "right") if called.startswith(f"{side}_")), ""), called
    swap = str.maketrans({"<": ">", ">": "<"})
    for joint, other in zip(robot.joint_names, robot.counterpart, strict=True):
        mirrored = joint.replace("left", "<").replace("right", ">").translate(swap)
        assert robot.joint_names[other] == mirrored.replace("<", "left").replace(">", "right")
    assert [joint for joint, counts in zip(robot.joint_names, robot.motor_counts, strict=True) if not counts] == [
        f"{side}_wrist_{axis}_joint" for side in ("left", "right") for axis in ("roll", "pitch", "yaw")
    ]
