import dataclasses
from pathlib import Path

import numpy as np
import onnx
import pytest
from miniature import TINY, finished, started
from trees import assert_same

from forgetmimic_jax import import_policy, unlearn
from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.exchange import imported
from forgetmimic_jax.exchange.onnx_actor import to_onnx
from forgetmimic_jax.policy.policy import Policy
from forgetmimic_jax.robot.model import load_robot
from forgetmimic_jax.settings.options import override
from forgetmimic_jax.tracking.setup import make_setup
from forgetmimic_jax.training import checkpoint
from forgetmimic_jax.training.unlearning_run import config_of_new_run

RSL_RL = Path(__file__).parents[1] / "exchange" / "rsl_rl" / "rsl_rl_5.5.1.pt"


@pytest.fixture(scope="module")
def imported_run(library_folder, tmp_path_factory):
    output = tmp_path_factory.mktemp("runs") / "imported"
    return finished(
        import_policy.main,
        import_policy.Options(policy=RSL_RL, activation="elu", library=library_folder, output=output),
    )


def test_the_checkpoint_acts_as_rsl_rl_did(imported_run):
    info = checkpoint.read_info(imported_run.folder)
    assert (info.iteration, info.environment_steps, info.config.ppo.actor_layers) == (1500, 0, (8, 6))
    policy = load_policy(imported_run.folder)
    original = np.load(RSL_RL.with_suffix(".npz"))
    inside = imported.within_limit(policy, original["observations"])
    found = np.asarray(policy.mean_action(original["observations"]))
    assert inside.sum() >= 15
    np.testing.assert_allclose(found[inside], original["actions"][inside], rtol=1e-5, atol=1e-5)


def test_how_long_to_retrain_it_has_to_be_said(imported_run):
    wanted = {"base": imported_run.folder, "targets": "turn", "method": "retrain"}
    with pytest.raises(InputError, match=r"--iterations: .* does not say how long it was trained"):
        config_of_new_run(unlearn.Options(**wanted))
    assert config_of_new_run(unlearn.Options(**wanted, iterations=3)).unlearn.method == "retrain"


def test_unlearning_starts_from_it(imported_run):
    config = config_of_new_run(unlearn.Options(base=imported_run.folder, targets="turn"))
    small = [setting for setting in TINY if "layers" not in setting and "bin_seconds" not in setting]
    setup = make_setup(override(config, small))
    start = started(setup)
    assert_same(start.policy, load_policy(imported_run.folder))
    assert setup.config.unlearn.targets == ("turn",)


def test_it_tells_what_was_compared_and_assumed(imported_run):
    message, where, following = imported_run.printed.strip().split("\n\n")
    lines = message.splitlines()
    assert lines[0].startswith("Actions equal the original's to ")
    assert lines[-2].startswith("The critic starts fresh")
    assert lines[-1].startswith("A .pt does not name its observations and joints: ")
    assert where == f"base policy  {imported_run.folder}"
    assert following.startswith("Next: make evaluate ROBOT=g1 LIBRARY=")


def load_policy(path: Path) -> Policy:
    return checkpoint.load_policy(checkpoint.read_info(path), load_robot("g1"))


def test_what_was_exported_comes_back_as_it_went(base_run, library_folder, robot, tmp_path):
    file, output = tmp_path / "policy.onnx", tmp_path / "back"
    there = load_policy(base_run.checkpoint(4))
    onnx.save(to_onnx(there, robot, checkpoint.read_info(base_run.checkpoint(4)).config, run_path=""), file)
    message = finished(
        import_policy.main, import_policy.Options(policy=file, library=library_folder, std=0.7, output=output)
    )
    assert "The file has no exploration noise; fine-tuning starts from a standard deviation of 0.7." in message.printed
    assert "A .pt does not name" not in message.printed
    back = load_policy(output)
    assert_same(back.actor["params"]["MLP_0"], there.actor["params"]["MLP_0"])
    np.testing.assert_allclose(back.actor_normalizer.mean, there.actor_normalizer.mean, atol=1e-6)


@pytest.fixture
def options(library_folder):
    def options(**given) -> import_policy.Options:
        known = {"policy": RSL_RL, "activation": "elu", "library": library_folder, "output": Path("out")}
        return import_policy.Options(**known | given)

    return options


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"policy": Path("nowhere.pt")}, "nowhere.pt: no such file"),
        ({"policy": Path("nowhere.onnx")}, "nowhere.onnx: no such file"),
        ({"policy": Path("model.h5")}, "model.h5: suffix: found '.h5'; accepted: .pt, .pth, .onnx"),
        ({"activation": "relu"}, f"{RSL_RL}: activation: found 'relu'; accepted: elu"),
        ({"robot": "gg1"}, "robot 'gg1': no robots/gg1/gg1.yaml; did you mean 'g1'?"),
        ({"library": Path("nowhere")}, "nowhere/manifest.json: not found; a library is a folder with manifest.json"),
        ({"std": 0.0}, "--std: found 0; accepted: 0.05 to 2"),
        ({"std": float("nan")}, "--std: found nan; accepted: 0.05 to 2"),
        ({"seed": -1}, "--seed: found -1; accepted: 0 or more"),
        ({"output": RSL_RL.parent}, f"{RSL_RL.parent}: exists already; choose another --output, or remove it"),
    ],
)
def test_what_cannot_be_is_told_in_one_line(refused, options, given, message):
    assert refused(import_policy.main, options(**given)) == message


def test_a_policy_that_comes_out_different_is_refused(refused, options, monkeypatch):
    with_actor = imported.with_actor

    def wrong(policy, actor, std):
        return with_actor(policy, dataclasses.replace(actor, mean=actor.mean + 0.01), std)

    monkeypatch.setattr(imported, "with_actor", wrong)
    assert refused(import_policy.main, options()).startswith(f"{RSL_RL}: actions differ from the original's by ")


def test_observations_far_from_what_the_policy_knew_are_told(refused, options, tmp_path):
    model = onnx.load(RSL_RL.with_suffix(".onnx"))
    mean = next(tensor for tensor in model.graph.initializer if tensor.name.endswith("_mean"))
    shifted = onnx.numpy_helper.to_array(mean) + 1e6
    mean.CopyFrom(onnx.numpy_helper.from_array(shifted.astype(np.float32), mean.name))
    onnx.save(model, tmp_path / "far.onnx")
    message = refused(import_policy.main, options(policy=tmp_path / "far.onnx", activation=None))
    assert message.endswith("standard deviations of its normaliser; is its observation layout another?")
