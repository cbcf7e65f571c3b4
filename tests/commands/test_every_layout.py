"""The whole path in miniature with the layouts that are not the default: train, unlearn, evaluate, export, show."""

import numpy as np
import onnx
import pytest
from miniature import TINY, finished
from orders import isaac_order

from forgetmimic_jax import export, train, unlearn
from forgetmimic_jax.evaluation.document import read_evaluation
from forgetmimic_jax.training import checkpoint
from forgetmimic_jax.training.comparison import load_comparison
from forgetmimic_jax.viewing.takes import record

# Layout, action mode, and whether the policy has Isaac Lab's order of joints.
CASES = [("root132", "residual", False), ("mjlab160", "residual", True), ("mjlab154", "offset", True)]


@pytest.fixture(scope="module", params=CASES, ids=lambda case: case[0])
def case(request):
    return request.param


@pytest.fixture(scope="module")
def base(case, robot, library_folder, tmp_path_factory):
    layout, mode, isaac = case
    given = [f"observation.layout={layout}", f"action.mode={mode}", "action.stiffness.left_knee_joint=90"]
    given += [f"action.joint_order=[{','.join(isaac_order(robot))}]"] if isaac else []
    options = train.Options(
        library=library_folder,
        output=tmp_path_factory.mktemp("runs") / "base",
        iterations=1,
        set=[TINY, given, ["noise.enabled=true", "wrench.max_gain=0.0"]],
    )
    return finished(train.main, options)


@pytest.fixture(scope="module")
def unlearned(base):
    options = unlearn.Options(
        base=base.checkpoint(1),
        targets="turn",
        method="poisoning",
        iterations=1,
        episodes=2,
        output=base.folder.parent / "unlearned",
    )
    return finished(unlearn.main, options)


def test_unlearning_evaluation_and_viewers_go_by_the_bases_layout(case, base, unlearned):
    info = checkpoint.read_info(unlearned.checkpoint(1))
    assert (info.config.observation, info.config.action) == (
        checkpoint.read_info(base.checkpoint(1)).config.observation,
        checkpoint.read_info(base.checkpoint(1)).config.action,
    )
    assert info.config.observation.layout == case[0]
    document = read_evaluation(unlearned.folder / "evaluation.json")
    assert document.action_mode == case[1]
    assert set(document.policies) == {"base", "unlearned", "zero_action"}
    compared = load_comparison(unlearned.checkpoint(1), robot="g1")
    assert float(compared.setup.robot.arrays.stiffness[compared.setup.robot.joint_names.index("left_knee_joint")]) == 90
    (episode,) = record(compared.setup, compared.policies, ["turn"])
    assert set(episode.takes) == {"base", "unlearned"}
    assert all(np.isfinite(take.qpos).all() for take in episode.takes.values())


def test_what_the_zero_action_does_is_said_by_its_mode(case, unlearned):
    does = {"residual": "replay the clip", "offset": "hold the default pose"}
    message, other = does[case[1]], does["offset" if case[1] == "residual" else "residual"]
    for text in (unlearned.printed, (unlearned.folder / "evaluation.md").read_text()):
        text = " ".join(text.split())
        assert f"the joint controllers {message} without a policy" in text
        assert other not in text


def test_an_export_leads_the_robot_as_the_evaluation_does(base, case, tmp_path):
    file = tmp_path / "policy.onnx"
    options = export.Options(checkpoint=base.checkpoint(1), episodes=1, output=file)
    assert "actions equal the policy's" in finished(export.main, options).printed  # or it would have been refused
    metadata = {entry.key: entry.value for entry in onnx.load(file).metadata_props}
    assert metadata["anchor_body_name"] == ("pelvis" if case[0] == "root132" else "torso_link")


def test_training_goes_on_from_it_without_naming_its_layout(base, case, tmp_path):
    options = train.Options(
        library=checkpoint.read_info(base.checkpoint(1)).config.library,
        base=base.checkpoint(1),
        output=tmp_path / "further",
        iterations=1,
        set=[TINY, ["noise.enabled=true", "wrench.max_gain=0.0"]],
    )
    further = checkpoint.read_info(finished(train.main, options).checkpoint(1))
    assert further.config.observation.layout == case[0]
    assert further.config.action == checkpoint.read_info(base.checkpoint(1)).config.action


def test_another_layout_than_the_bases_is_refused(base, refused, case, library_folder):
    set_ = [TINY, ["observation.layout=wbc132"]]
    options = train.Options(library=library_folder, base=base.checkpoint(1), set=set_)
    message = refused(train.main, options)
    assert message == f"{base.checkpoint(1)}: observation.layout: the checkpoint's is {case[0]}, this run's wbc132"
