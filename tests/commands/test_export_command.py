import shutil
from pathlib import Path

import numpy as np
import onnx
import pytest
from miniature import finished

from forgetmimic_jax import export
from forgetmimic_jax.evaluation.metrics import Rollout
from forgetmimic_jax.exchange import onnx_actor
from forgetmimic_jax.training.checkpoint import policy_hash, read_info


@pytest.fixture
def options(base_run):
    """Options that export the base into the working folder."""

    def options(**given) -> export.Options:
        return export.Options(**{"checkpoint": base_run.checkpoint(4), "output": Path("policy.onnx")} | given)

    return options


def test_it_checks_writes_and_reports(unlearned_run, tmp_path):
    run = Path(shutil.copytree(unlearned_run.folder, tmp_path / "run"))
    path = run / "checkpoints" / "00000002"
    default = finished(export.main, export.Options(checkpoint=path, output=None))
    file = run / "export" / "policy.onnx"
    message = {entry.key: entry.value for entry in onnx.load(file).metadata_props}
    assert message["run_path"] == f"g1/{policy_hash(read_info(path))}"
    assert not any(clip in file.read_bytes() for clip in (b"sway", b"turn", b"nod"))
    added = {each.name for each in run.iterdir()} - {each.name for each in unlearned_run.folder.iterdir()}
    assert added == {"export"}
    assert {each.name for each in file.parent.iterdir()} == {"policy.onnx", "config.yaml"}  # wbc-g1-deploy's
    printed = default.printed
    assert "Evaluation → ONNX in plain MuJoCo" in printed
    assert " sway " in printed
    assert ["policy", str(file)] in [line.split() for line in printed.splitlines()]
    assert printed.splitlines()[-1] == f"Next: make evaluate ROBOT=g1 CHECKPOINT={path} EPISODES=100"


def rollout(tracking_reward: np.ndarray) -> Rollout:
    episodes, steps = tracking_reward.shape
    whole = np.full(episodes, steps)
    return Rollout(np.zeros(episodes, int), np.zeros(episodes, int), whole, whole, tracking_reward)


def test_rounding_that_a_contact_makes_large_in_one_episode_of_ten_is_no_difference():
    expected = np.full((10, 10), 0.9)  # [episode, step]
    found = expected + 1e-7
    found[3, 2:] -= 0.013
    assert export.early_agreement(rollout(expected), rollout(found)) == 0.92 >= export.EARLY_SHARE
    wrong = expected - np.geomspace(1e-6, 1e-3, 10)  # a little more every step, in every episode
    assert export.early_agreement(rollout(expected), rollout(wrong)) < export.EARLY_SHARE


def test_an_onnx_that_leads_the_robot_elsewhere_is_refused(options, monkeypatch, capfd, tmp_path):
    monkeypatch.chdir(tmp_path)
    metadata = onnx_actor.metadata

    def wrong(robot, config, **known):
        scales = metadata(robot, config, **known)["action_scale"].split(",")
        scales[0] = str(1.05 * float(scales[0]))
        return metadata(robot, config, **known) | {"action_scale": ",".join(scales)}

    monkeypatch.setattr(onnx_actor, "metadata", wrong)
    with pytest.raises(SystemExit):
        export.run_command(lambda: export.main(options()))
    assert "in MuJoCo the ONNX's tracking reward equals the evaluation's in " in capfd.readouterr().err
    assert not any(tmp_path.iterdir())


def test_an_onnx_with_other_actions_is_refused(options, monkeypatch, capfd, tmp_path):
    monkeypatch.chdir(tmp_path)
    layers = onnx_actor.dense_layers
    monkeypatch.setattr(
        onnx_actor,
        "dense_layers",
        lambda policy: [(kernel + np.float32(1e-3), bias) for kernel, bias in layers(policy)],
    )
    with pytest.raises(SystemExit):
        export.run_command(lambda: export.main(options()))
    assert "the ONNX's actions differ from the policy's by " in capfd.readouterr().err
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"robot": "gg1", "checkpoint": None}, "robot 'gg1': no robots/gg1/gg1.yaml; did you mean 'g1'?"),
        ({"checkpoint": Path("nowhere")}, "nowhere: no such checkpoint folder"),
        ({"episodes": 0}, "--episodes: found 0; accepted: 1 or more"),
        ({"seed": -1}, "--seed: found -1; accepted: 0 or more"),
        ({"library": Path("nowhere")}, "nowhere/manifest.json: not found; a library is a folder with manifest.json"),
        ({"output": Path(__file__).parent}, f"{Path(__file__).parent}: a folder; --output is a file"),
        ({"output": Path(__file__) / "x.onnx"}, f"{__file__}: {__file__} is a file; choose another --output"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(refused, options, given, message):
    assert refused(export.main, options(**given)) == message
