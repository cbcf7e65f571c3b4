import dataclasses
import json
import re
from pathlib import Path

import numpy as np
import onnx
import pytest
import yaml
from foreign_files import lab_folder, mjlab_file
from miniature import TINY, finished, started
from trees import assert_same

from forgetmimic_jax import evaluate, export, import_policy, unlearn
from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.evaluation.document import read_evaluation
from forgetmimic_jax.exchange import adopt, experts, imported
from forgetmimic_jax.exchange.onnx_actor import to_onnx
from forgetmimic_jax.motion.library import read_library, read_manifest
from forgetmimic_jax.policy.policy import Policy
from forgetmimic_jax.robot.model import load_robot
from forgetmimic_jax.settings.options import override, parse
from forgetmimic_jax.tracking.setup import make_setup
from forgetmimic_jax.training import checkpoint
from forgetmimic_jax.training.distil import DistilConfig
from forgetmimic_jax.training.unlearning_run import config_of_new_run

RSL_RL = Path(__file__).parents[1] / "exchange" / "rsl_rl" / "rsl_rl_5.5.1.pt"


@pytest.fixture(scope="module")
def imported_run(library_folder, tmp_path_factory):
    """A .pt that nothing describes, on a library."""
    output = tmp_path_factory.mktemp("runs") / "imported"
    options = import_policy.Options(
        files=(RSL_RL,), activation="elu", layout="wbc132", library=library_folder, episodes=2, output=output
    )
    return finished(import_policy.main, options)


@pytest.fixture(scope="module")
def with_clip(robot, library, tmp_path_factory):
    """A policy of layout mjlab160 that brings its clip."""
    folder = tmp_path_factory.mktemp("runs")
    file = mjlab_file(folder / "kick.onnx", robot, library)
    return finished(import_policy.main, import_policy.Options(files=(file,), episodes=2, output=folder / "kick"))


def test_the_checkpoint_acts_as_rsl_rl_did(imported_run):
    info = checkpoint.read_info(imported_run.folder / "base")
    assert (info.iteration, info.environment_steps, info.config.ppo.actor_layers) == (1500, 0, (8, 6))
    policy = load_policy(imported_run.folder / "base")
    original = np.load(RSL_RL.with_suffix(".npz"))
    inside = imported.within_limit(policy, original["observations"])
    found = np.asarray(policy.mean_action(original["observations"]))
    assert inside.sum() >= 15
    np.testing.assert_allclose(found[inside], original["actions"][inside], rtol=1e-5, atol=1e-5)


def test_how_long_to_retrain_it_has_to_be_said(imported_run):
    wanted = {"base": imported_run.folder / "base", "targets": "turn", "method": "retrain"}
    with pytest.raises(InputError, match=r"--iterations: .* does not say how long it was trained"):
        config_of_new_run(unlearn.Options(**wanted))
    assert config_of_new_run(unlearn.Options(**wanted, iterations=3)).unlearn.method == "retrain"


def test_unlearning_starts_from_it(imported_run):
    config = config_of_new_run(unlearn.Options(base=imported_run.folder / "base", targets="turn"))
    small = [setting for setting in TINY if "layers" not in setting and "bin_seconds" not in setting]
    setup = make_setup(override(config, small))
    start = started(setup)
    assert_same(start.policy, load_policy(imported_run.folder / "base"))
    assert setup.config.unlearn.targets == ("turn",)


def test_it_says_what_was_taken_from_where_and_how_it_did(imported_run):
    lines = imported_run.printed.splitlines()
    assert lines[0] == str(RSL_RL)
    table = {line[2:16].strip(): line for line in lines[2:14]}
    assert table["layout"].split() == ["layout", "wbc132", "observation_names,", "the", "flags"]
    assert table["scale"].endswith("assumed: no action_scale; the robot's own")
    rows = [line.split() for line in lines if " noise " in line]
    assert [row[:3] for row in rows[:2]] == [["sway", "no", "noise"], ["sway", "reset", "noise"]]
    assert len(rows) == 2 * 3
    assert any(line.startswith("Actions equal the original's to ") for line in lines)
    assert f"base policy  {imported_run.folder / 'base'}" in lines
    assert lines[-1] == f"Next: make evaluate ROBOT=g1 CHECKPOINT={imported_run.folder / 'base'}"
    assert not (imported_run.folder / "library").exists()


def test_a_policys_clip_becomes_a_library_beside_it(with_clip, robot, library):
    folder = with_clip.folder / "library"
    manifest = read_manifest(folder)
    assert manifest["clips"]["kick"]["source"] == "kick.onnx"
    (clip,) = read_library(robot, folder)
    np.testing.assert_allclose(clip.joint_pos, library.clip(0).joint_pos, atol=2e-5)
    info = checkpoint.read_info(with_clip.folder / "base")
    assert (info.clips, info.config.library) == (("kick",), str(folder))
    assert info.config.observation.layout == "mjlab160"
    assert info.config.action.mode == "offset"
    assert set(info.config.action.stiffness) == set(robot.joint_names)


def test_the_commands_take_what_was_written(with_clip, tmp_path):
    base = with_clip.folder / "base"
    finished(evaluate.main, evaluate.Options(checkpoint=base, episodes=1, output=tmp_path / "evaluation"))
    found = read_evaluation(tmp_path / "evaluation" / "evaluation.json").policies["base"].clips["kick"]
    row = next(line.split() for line in with_clip.printed.splitlines() if line.split()[:2] == ["kick", "no"])
    assert found.tracking_reward.mean == pytest.approx(float(row[-3]), abs=0.1)  # with reset noise, without
    finished(export.main, export.Options(checkpoint=base, episodes=1, output=tmp_path / "policy.onnx"))


def test_a_reference_must_be_met(with_clip, robot, library, tmp_path, refused):
    row = next(line.split() for line in with_clip.printed.splitlines() if line.split()[:2] == ["kick", "no"])
    reward, error = float(row[-3]), float(row[-2])
    file = mjlab_file(tmp_path / "kick.onnx", robot, library)
    reference = tmp_path / "reference.json"
    options = import_policy.Options(files=(file,), episodes=1, reference=reference, output=Path("out"))
    reference.write_text(json.dumps({"joint_error": error + 0.02, "reward": reward}))
    assert refused(import_policy.main, options) == (
        f"{reference}: kick: joint_error: found {error:.3f}, the reference has {error + 0.02:.3f}; accepted: within "
        "0.01; nothing was written"
    )
    reference.write_text(yaml.safe_dump({"kick": {"reward": reward - 0.005, "joint_error": error + 0.005}}))
    finished(import_policy.main, options)
    for content, message in (
        ("[", "neither JSON nor YAML: "),
        ("{}", "found {}; accepted: a table of reward, joint_error, survival"),
        ("3", "found 3; accepted: a table of reward, joint_error, survival"),
        ("{speed: 1}", "speed: found 1; accepted: numbers of reward, joint_error, survival"),
    ):
        reference.write_text(content)
        with pytest.raises(InputError) as error_:
            adopt.read_reference(reference)
        assert str(error_.value).startswith(f"{reference}: {message}")
    with pytest.raises(InputError, match=r"no clip 'spin' in the roll-out; found kick"):
        adopt.check_reference(reference, {"spin": {}}, {"kick": None})


def load_policy(path: Path) -> Policy:
    return checkpoint.load_policy(checkpoint.read_info(path), load_robot("g1"))


def test_what_was_exported_comes_back_as_it_went(base_run, library_folder, robot, tmp_path):
    file, output = tmp_path / "policy.onnx", tmp_path / "back"
    there = load_policy(base_run.checkpoint(4))
    onnx.save(to_onnx(there, robot, checkpoint.read_info(base_run.checkpoint(4)).config, run_path=""), file)
    (tmp_path / "notes.csv").write_text("no,motion")  # which --library replaces
    message = finished(
        import_policy.main,
        import_policy.Options(files=(file,), library=library_folder, std=0.7, episodes=1, output=output),
    )
    assert "The file has no exploration noise; fine-tuning starts from a standard deviation of 0.7." in message.printed
    assert "action_mode, the metadata" in message.printed
    back = load_policy(output / "base")
    assert_same(back.actor["params"]["MLP_0"], there.actor["params"]["MLP_0"])
    np.testing.assert_allclose(back.actor_normalizer.mean, there.actor_normalizer.mean, atol=1e-6)


@pytest.fixture
def options(library_folder):
    def options(**given) -> import_policy.Options:
        known = {"files": (RSL_RL,), "activation": "elu", "layout": "wbc132", "library": library_folder}
        return import_policy.Options(**known | {"episodes": 1, "output": Path("out")} | given)

    return options


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"files": (Path("nowhere.pt"),)}, "nowhere.pt: no such file"),
        ({"files": (Path("nowhere.onnx"),)}, "nowhere.onnx: no such file"),
        ({"files": (Path("model.h5"),)}, "model.h5: suffix: found '.h5'; accepted: .onnx, .pt, .pth"),
        ({"files": ()}, "FILE: no policy named; accepted: ONNX files and checkpoints of rsl_rl"),
        ({"activation": "relu"}, f"{RSL_RL}: activation: found 'relu'; accepted: elu"),
        ({"layout": "mjlab155"}, "observation.layout: no layout 'mjlab155'; did you mean 'mjlab154'?"),
        ({"robot": "gg1"}, "robot 'gg1': no robots/gg1/gg1.yaml; did you mean 'g1'?"),
        ({"library": Path("nowhere")}, "nowhere/manifest.json: not found; a library is a folder with manifest.json"),
        ({"std": 0.0}, "--std: found 0; accepted: 0.05 to 2"),
        ({"std": float("nan")}, "--std: found nan; accepted: 0.05 to 2"),
        ({"seed": -1}, "--seed: found -1; accepted: 0 or more"),
        ({"episodes": 0}, "--episodes: found 0; accepted: 1 or more"),
        ({"reference": Path("nowhere.json")}, "nowhere.json: no such file"),
        ({"output": RSL_RL.parent}, f"{RSL_RL.parent}: exists already; choose another --output, or remove it"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(refused, options, given, message):
    assert refused(import_policy.main, options(**given)) == message


def test_a_policy_that_falls_is_warned_about_with_what_was_assumed_of_it(options, tmp_path, capfd, monkeypatch):
    monkeypatch.setattr(adopt, "LEAST_SURVIVAL", 1.1)  # so that it falls, whatever it does
    finished(import_policy.main, options(output=tmp_path / "out"))
    (warning,) = [line for line in capfd.readouterr().err.splitlines() if line.startswith("warning: ")]
    assert re.match(rf"warning: {RSL_RL}: the policy falls: survival: sway \d+%, turn \d+%, nod \d+%; ", warning)
    assert "scale (no action_scale), stiffness (no joint_stiffness), " in warning
    assert "layout" not in warning  # which the flags said


def test_files_are_named_without_a_flag():
    given = parse(import_policy.Options, "import-policy", ["a.onnx", "b.pt", "--layout", "mjlab154"])
    assert given.files == (Path("a.onnx"), Path("b.pt"))


def test_a_policy_that_comes_out_different_is_refused(refused, options, monkeypatch):
    with_actor = imported.with_actor

    def wrong(policy, actor, std):
        return with_actor(policy, dataclasses.replace(actor, mean=actor.mean + 0.01), std)

    monkeypatch.setattr(adopt, "with_actor", wrong)
    assert refused(import_policy.main, options()).startswith(f"{RSL_RL}: actions differ from the original's by ")


def test_observations_far_from_what_the_policy_knew_are_refused(refused, options, tmp_path):
    model = onnx.load(RSL_RL.with_suffix(".onnx"))
    mean = next(tensor for tensor in model.graph.initializer if tensor.name.endswith("_mean"))
    shifted = onnx.numpy_helper.to_array(mean) + 1e6
    mean.CopyFrom(onnx.numpy_helper.from_array(shifted.astype(np.float32), mean.name))
    onnx.save(model, tmp_path / "far.onnx")
    message = refused(import_policy.main, options(files=(tmp_path / "far.onnx",), activation=None))
    assert message.endswith("standard deviations of its normaliser; is its observation layout another?")


def test_nothing_is_left_of_an_import_that_could_not_be_saved(options, monkeypatch, tmp_path, robot, library):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(checkpoint, "save_policy", full)
    monkeypatch.chdir(tmp_path)
    file = mjlab_file(tmp_path / "kick.onnx", robot, library)
    with pytest.raises(OSError, match="No space"):
        finished(import_policy.main, import_policy.Options(files=(file,), episodes=1, output=Path("out")))
    assert [path.name for path in tmp_path.iterdir()] == ["kick.onnx"]


@pytest.fixture(scope="module")
def two_files(robot, library, tmp_path_factory) -> tuple[Path, Path]:
    """Policies of two layouts, orders of joints, poses and gains' digits, each with a clip."""
    folder = tmp_path_factory.mktemp("experts")
    gains = {f"joint_{name}": ",".join(f"{x:.3f}" for x in np.asarray(getattr(robot.arrays, name)))
             for name in ("stiffness", "damping")}  # fmt: skip
    kick = mjlab_file(folder / "kick.onnx", robot, library, **gains)
    return kick, mjlab_file(folder / "turn.onnx", robot, library, layout="mjlab154", **gains)


@pytest.fixture(scope="module")
def merged(two_files, tmp_path_factory):
    """Two rounds of regression on a handful of robots."""
    output = tmp_path_factory.mktemp("runs") / "merged"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(experts, "MERGING", DistilConfig(rounds=2, steps=4, epochs=1, minibatches=2))
        patch.setattr(experts, "MORE", DistilConfig(rounds=3, steps=4, expert_share=(0.0,), epochs=1, minibatches=2))
        patch.setattr(experts, "REPEATS", 4)
        behind = iter([["kick: survival 90%, the expert's is 100%."]] * 2 + [[]] * 2)  # twice, then no longer
        patch.setattr(experts, "shortfalls", lambda known, found: next(behind))
        patch.setattr(experts, "ROBOTS", 8)
        patch.setattr(experts, "STUDENT_LAYERS", (16,))
        patch.setattr(adopt, "LEAST_SURVIVAL", 0.0)  # the invented policies fall
        options = import_policy.Options(files=two_files, layout="mjlab154", episodes=1, output=output)
        yield finished(import_policy.main, options)


def test_several_policies_become_one_base_with_all_clips(merged, robot):
    info = checkpoint.read_info(merged.folder / "base")
    assert info.clips == ("kick", "turn")
    assert [clip.name for clip in read_library(robot, merged.folder / "library")] == ["kick", "turn"]
    assert info.config.observation.layout == "mjlab154"
    assert info.config.action.mode == "offset"
    assert info.config.action.stiffness == {}  # the gains are the robot's own, in three digits
    assert info.config.action.default_pose == {}
    assert info.environment_steps == (2 + 2 * 3) * 8 * 4  # it learns on twice, until it is not behind
    assert "The new policy is within 2 points of survival" in merged.printed
    assert "kick (experts)" in merged.printed
    assert "turn (new policy)" in merged.printed
    load_policy(merged.folder / "base")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({}, "--layout: the policies have mjlab154 and mjlab160; name that of the new policy"),
        ({"library": Path("data")}, "--library: found with several policies; accepted with one: each of several needs"),
    ],
)
def test_policies_that_cannot_become_one_are_refused(refused, two_files, change, message):
    options = import_policy.Options(files=two_files, output=Path("out"), **change)
    assert refused(import_policy.main, options).startswith(message)


def test_a_policy_that_falls_becomes_no_part_of_a_base(two_files, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(adopt, "LEAST_SURVIVAL", 0.5)
    options = import_policy.Options(files=two_files, layout="mjlab154", episodes=1, output=Path("out"))
    with pytest.raises(InputError, match=rf"^{two_files[0]}: the policy falls: survival: kick 0%; 50% or more is exp"):
        import_policy.main(options)
    assert not any(tmp_path.iterdir())


def test_policies_of_other_gains_without_clips_or_of_one_clip_are_refused(refused, two_files, robot, library, tmp_path):
    kick, _ = two_files

    def message_of(*others: Path) -> str:
        return refused(import_policy.main, import_policy.Options(files=(kick, *others), output=Path("out")))

    other = mjlab_file(tmp_path / "other.onnx", robot, library)
    message = message_of(other)
    assert message.startswith(f"{other}: stiffness: left_hip_pitch_joint: ")
    assert message.endswith(f"but {kick} has 40.18; policies of one base need the same gains")
    bare = lab_folder(tmp_path / "bare", robot)
    assert message_of(bare).startswith(f"{bare}: no clip in it, and not one .csv or .npz beside it; ")
    assert message_of(kick).startswith(f"{kick}: its clip is called kick, as that of {kick}; rename")
