"""A policy of another project as a teacher of a student with another layout, order of joints and action."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from foreign_files import lab_folder, mjlab_file, wbc_folder
from loops import from_config_yaml, from_deploy_yaml, from_metadata, in_its_own_loop, in_the_environment
from orders import isaac_order

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.exchange import experts
from forgetmimic_jax.exchange.adopt import own_setup
from forgetmimic_jax.exchange.foreign import PolicyReading, read_policy
from forgetmimic_jax.exchange.imported import with_actor
from forgetmimic_jax.exchange.trial import Tracked
from forgetmimic_jax.robot.model import load_robot
from forgetmimic_jax.settings.config import ActionConfig, ObservationConfig
from forgetmimic_jax.tracking.env import make_assets
from forgetmimic_jax.tracking.setup import Setup
from forgetmimic_jax.training.distil import DistilState
from forgetmimic_jax.training.start import fresh_policy

STEPS = 12


# The expert, and layout, action mode and order of joints of its student.
@pytest.mark.parametrize(
    ("project", "layout", "mode", "isaac"),
    [
        ("mjlab", "wbc132", "residual", True),
        ("lab", "mjlab160", "offset", False),
        ("wbc", "mjlab154", "offset", False),
    ],
)
def test_it_moves_its_students_robot_as_its_own(project, layout, mode, isaac, robot, library, tiny_config, tmp_path):
    if project == "mjlab":
        file = mjlab_file(tmp_path / "kick.onnx", robot, library)
        deployment = from_metadata(file)
    elif project == "lab":
        file = lab_folder(tmp_path, robot)
        deployment = from_deploy_yaml(file, tmp_path / "params" / "deploy.yaml", robot)
    else:
        file = wbc_folder(tmp_path, robot)
        deployment = from_config_yaml(file, tmp_path / "config.yaml")
    foreign = read_policy(file, robot, 0.02, PolicyReading())
    theirs = foreign.config(tiny_config)
    theirs = Setup(theirs, load_robot("g1", theirs.physics, theirs.action), library, "")
    gains = {name: getattr(foreign.description.action, name) for name in ("stiffness", "damping")}
    action = ActionConfig(mode, isaac_order(robot) if isaac else (), **gains, scale={"left_knee_joint": 0.9})
    config = dataclasses.replace(tiny_config, observation=ObservationConfig(layout), action=action)
    student = Setup(config, load_robot("g1", config.physics, action), library, "")
    policy = with_actor(fresh_policy(theirs, make_assets(theirs)), foreign.actor, 0.4)
    expert = experts.expert(theirs, policy, student)

    expected = in_its_own_loop(deployment, robot, library, STEPS)
    found = in_the_environment(student, lambda assets, state, seen: expert.action(assets, state, seen, None), STEPS)
    np.testing.assert_allclose(found, expected, atol=2e-5)


def test_the_student_has_the_common_layout_the_robots_pose_and_the_experts_bounds(
    robot, tiny_config, library, tmp_path
):
    one = read_policy(mjlab_file(tmp_path / "a.onnx", robot, library), robot, 0.02, PolicyReading())
    config = experts.student_config(tiny_config, [one, one], robot, None, None)
    assert config.observation.layout == "mjlab160"
    assert config.action == ActionConfig("offset", stiffness=one.description.action.stiffness,
                                         damping=one.description.action.damping)  # fmt: skip
    assert config.termination.contact_force == 100.0
    other = experts.student_config(tiny_config, [one, one], robot, "wbc132", "residual")
    assert (other.observation.layout, other.action.mode) == ("wbc132", "residual")


def test_a_regression_whose_loss_is_no_number_ends_at_once(robot, library, tiny_config, tmp_path, monkeypatch):
    foreign = read_policy(mjlab_file(tmp_path / "a.onnx", robot, library), robot, 0.02, PolicyReading())
    setup = own_setup(foreign.config(tiny_config), [foreign.clip])
    monkeypatch.setattr(experts, "make_teaching", lambda assets, teachers: None)
    monkeypatch.setattr(experts, "begin", lambda *_: DistilState(None, None, None, None, None))
    losses = iter([{"action_error": 0.5}, {"action_error": float("nan")}])
    monkeypatch.setattr(
        experts, "make_round", lambda env, config: lambda assets, teaching, state: (state, next(losses))
    )
    with pytest.raises(InputError, match=r"^regression on the policies: action_error: found nan in round 2; accepted"):
        experts.merge(setup, [], lambda student: True)


def tracked(survival: float, reward: float) -> Tracked:
    return Tracked(1.0, 1.0, reward, 0.1, survival, reward, 0.1)


def test_what_a_student_lacks_is_said_clip_by_clip():
    known = {"kick": tracked(1.0, 0.9), "dance": tracked(0.95, 0.98)}
    assert experts.shortfalls(known, {"kick": tracked(0.98, 0.885), "dance": tracked(1.0, 0.99)}) == []
    assert experts.shortfalls(known, {"kick": tracked(0.95, 0.95), "dance": tracked(0.95, 0.95)}) == [
        "kick: survival 95%, the expert's is 100%.",
        "dance: reward 0.950, the expert's is 0.980.",
    ]


def test_own_clips_make_a_library_without_a_folder(robot, library, tiny_config, tmp_path):
    foreign = read_policy(mjlab_file(tmp_path / "a.onnx", robot, library), robot, 0.02, PolicyReading())
    setup = own_setup(foreign.config(tiny_config), [foreign.clip])
    assert setup.library.names == ("a",)
    assert float(setup.robot.arrays.action_scale[0]) == jnp.float32(
        foreign.description.action.scale[robot.joint_names[0]]
    )
