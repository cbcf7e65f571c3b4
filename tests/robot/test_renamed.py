"""A robot with the G1's shapes and none of its names: every tool finds its way by the roles."""

import dataclasses
import re
import xml.etree.ElementTree as ET

import numpy as np
import pytest
import yaml
from trees import assert_same

from forgetmimic_jax.evaluation.rollout import Evaluator
from forgetmimic_jax.motion import library, quality
from forgetmimic_jax.motion.contact import floor_points
from forgetmimic_jax.motion.draw import picture
from forgetmimic_jax.motion.fit import fit, on_floor
from forgetmimic_jax.motion.mirror import mirrored
from forgetmimic_jax.motion.readers import read_motion
from forgetmimic_jax.motion.recording import Reading
from forgetmimic_jax.retarget.contact import human_parts
from forgetmimic_jax.retarget.retarget import leg_scale
from forgetmimic_jax.robot.model import ROBOTS_DIR, load_robot
from forgetmimic_jax.tracking.setup import Setup

CLIPS = ("kick", "cartwheel")
PARTS = {"toe": 2, "heel": 2, "hand": 2, "knee": 1, "elbow": 1}  # floor points of one side: spheres, capsules' ends


@pytest.fixture(scope="module")
def renamed(robot, tmp_path_factory):
    """The G1 with bodies called part0, part1, ... and joints axle0, axle1, ..., neither of which names a side."""
    folder = tmp_path_factory.mktemp("robots") / "zog"
    folder.mkdir()
    tree = ET.parse(ROBOTS_DIR / "g1/g1.xml")
    called: dict[str, str] = {}
    for tag, word in (("body", "part"), ("joint", "axle")):
        for number, element in enumerate(tree.getroot().find("worldbody").iter(tag)):
            called[element.attrib["name"]] = f"{word}{number}"
            element.attrib["name"] = f"{word}{number}"
    for pair in tree.getroot().iter("exclude"):
        pair.attrib |= {end: called[pair.attrib[end]] for end in ("body1", "body2")}
    tree.write(folder / "zog.xml")

    roles = yaml.safe_load((ROBOTS_DIR / "g1/g1.yaml").read_text())
    for field in ("key_bodies", "end_effectors"):
        roles[field] = [called[name] for name in roles[field]]
    roles["pairs"] = {role: [called[name] for name in pair] for role, pair in roles["pairs"].items()}
    roles["default_pose"] = {called[joint]: angle for joint, angle in roles["default_pose"].items()}
    motor = {
        joint: next(motor for pattern, motor in roles["joint_motors"] if re.fullmatch(pattern, joint))
        for joint in robot.joint_names
    }
    roles["joint_motors"] = [[called[joint], name] for joint, name in motor.items()]
    roles["ignored_motors"] = [called[joint] for joint in robot.joint_names if "wrist" in joint]
    del roles["variants"]
    roles |= {"model": "zog.xml", "anchor": called[roles["anchor"]]}
    (folder / "zog.yaml").write_text(yaml.safe_dump(roles))
    found = load_robot("zog", robots_dir=folder.parent)
    every = [*found.joint_names, *(found.model.body(body).name for body in range(1, found.model.nbody))]
    assert not any(re.search("left|right|hip|knee|ankle|elbow|wrist|link|pelvis|torso", name) for name in every)
    return found


def as_its(renamed, clip):
    """A clip of the G1 with the other robot's joint names, in the same order."""
    return dataclasses.replace(clip, joint_names=renamed.joint_names)


@pytest.fixture(scope="module")
def clips(robot):
    return library.read_library(robot, None, CLIPS)


def test_its_clips_measure_the_same(robot, renamed, clips):
    for clip in clips:
        found, expected = quality.measure(renamed, as_its(renamed, clip)), quality.measure(robot, clip)
        assert dataclasses.replace(found, worst={}) == dataclasses.replace(expected, worst={})


def test_its_clips_are_mirrored_the_same(robot, renamed, clips):
    for clip in clips:
        ours, its = mirrored(robot, clip), mirrored(renamed, as_its(renamed, clip))
        np.testing.assert_array_equal(its.joint_pos, ours.joint_pos)
        assert np.abs(ours.joint_pos - clip.joint_pos).max() > 0.5  # a kick and a cartwheel have a side


def test_its_motions_are_imported_the_same(robot, renamed, clips, tmp_path):
    rows = np.concatenate([clips[0].root_pos, np.roll(clips[0].root_quat, -1, axis=-1), clips[0].joint_pos], axis=-1)
    np.savetxt(tmp_path / "kick.csv", rows, delimiter=",")
    for whose in (robot, renamed):
        found, raised = on_floor(
            whose, fit(whose, read_motion(whose, tmp_path / "kick.csv", Reading(fps=30.0)).clip, 50.0)
        )
        library.add_clip(tmp_path / whose.name, whose, found, {"raised": raised})
    ours, its = (library.load_library(whose, tmp_path / whose.name) for whose in (robot, renamed))
    assert_same(its.frames, ours.frames)
    raised = [library.read_manifest(tmp_path / name)["clips"]["kick"]["raised"] for name in ("g1", "zog")]
    assert raised[0] == raised[1]


def test_its_limbs_are_the_human_s(robot, renamed):
    parts = human_parts(robot, floor_points(robot))
    assert human_parts(renamed, floor_points(renamed)) == parts
    counts = {part: parts.count(part) for part in parts}
    both = {f"{side}_{part}": count for side in ("left", "right") for part, count in PARTS.items()}
    assert {part: count for part, count in counts.items() if part} == {**both, "pelvis": 1, "torso": 2, "head": 1}
    assert leg_scale(renamed) == leg_scale(robot)


def test_it_is_drawn_the_same(robot, renamed):
    qpos = np.concatenate([[0.0, 0.0, 0.76, 1.0, 0.0, 0.0, 0.0], np.asarray(robot.arrays.default_joint_pos)])
    np.testing.assert_array_equal(np.asarray(picture(renamed, qpos)), np.asarray(picture(robot, qpos)))


def test_it_is_evaluated_the_same(robot, renamed, tiny_config, clips):
    def rollout(whose):
        motions = library.build_library(whose, [as_its(whose, clips[0])])
        return Evaluator(Setup(tiny_config, whose, motions, ""), episodes=2, seed=0).rollout(None)

    ours, its = rollout(robot), rollout(renamed)
    np.testing.assert_array_equal(its.length, ours.length)
    np.testing.assert_array_equal(its.tracking_reward, ours.tracking_reward)
    for name in ours.errors:
        np.testing.assert_array_equal(its.errors[name], ours.errors[name], err_msg=name)
