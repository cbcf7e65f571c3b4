import dataclasses
import json
import shutil
from pathlib import Path

import pytest
from miniature import finished

from forgetmimic_jax import evaluate, unlearn
from forgetmimic_jax.evaluation.document import read_evaluation
from forgetmimic_jax.motion.library import add_clip, read_library
from forgetmimic_jax.physics.choose import resolve_engine
from forgetmimic_jax.settings.options import on_engine, parse
from forgetmimic_jax.training.checkpoint import policy_hash, read_info
from forgetmimic_jax.training.comparison import load_comparison
from forgetmimic_jax.training.unlearning_run import config_of_new_run


@pytest.fixture
def options(base_run):
    """Options that evaluate the base in the working folder."""

    def options(**given) -> evaluate.Options:
        return evaluate.Options(**{"checkpoint": base_run.checkpoint(4), "output": Path("out"), "episodes": 3} | given)

    return options


@pytest.fixture(scope="session")
def evaluated_again(unlearned_run, tmp_path_factory):
    """The unlearned policy, evaluated by the command of that name under the conditions of the unlearning run's own."""
    output = tmp_path_factory.mktemp("runs") / "evaluated"
    options = evaluate.Options(checkpoint=unlearned_run.checkpoint(2), episodes=3, output=output)
    return finished(evaluate.main, options)


def test_the_same_seed_gives_the_same_evaluation_twice(unlearned_run, evaluated_again):
    # The base it is compared with is the one it started from, which its checkpoint names.
    first, again = (
        json.loads((run.folder / "evaluation.json").read_text()) for run in (unlearned_run, evaluated_again)
    )
    assert again == first


def test_targets_are_played_once_more_without_terminations(evaluated_again, unlearned_run):
    document = json.loads((evaluated_again.folder / "evaluation.json").read_text())
    for policy in document["policies"].values():
        found = policy["clips"]["turn"]["unbounded"]
        assert (found["all_starts"]["upright_rate"]["n"], found["from_frame_0"]["upright_rate"]["n"]) == (3, 2)
        assert policy["target"]["unbounded"] == found  # the one target
        assert "unbounded" not in policy["clips"]["sway"]
        assert "unbounded" not in policy["kept"]
    printed = [line.split("  ")[0].strip() for line in evaluated_again.printed.splitlines()]
    for row in ("upright until the end", "impact above one body weight, from frame 0", "motion content"):
        assert row in printed


def test_it_ends_with_the_files_and_what_to_do_next(evaluated_again):
    assert sorted(path.name for path in evaluated_again.folder.iterdir()) == [
        f"evaluation.{kind}" for kind in ("json", "md", "png")
    ]
    printed = evaluated_again.printed.splitlines()
    assert printed[0] == "evaluate: 0/3"
    assert f"evaluation  {evaluated_again.folder}/evaluation.json" in printed
    assert printed[-1].startswith("Next: make play ROBOT=g1 CHECKPOINT=")


def test_with_noise_the_files_say_so_and_go_into_a_folder_of_their_own(unlearned_run):
    options = evaluate.Options(checkpoint=unlearned_run.checkpoint(2), episodes=2, noise=True)
    finished(evaluate.main, options)
    folder = unlearned_run.folder / "noise"
    document = read_evaluation(folder / "evaluation.json")
    assert document.noise
    assert all(policy.target.unbounded is None for policy in document.policies.values())
    text = (folder / "evaluation.md").read_text()
    assert "no wrench, randomisation, pushes and sensor noise as in training;" in text
    assert not read_evaluation(unlearned_run.folder / "evaluation.json").noise
    shutil.rmtree(folder)


def test_a_base_that_was_replaced_since_is_refused_unless_it_was_named(refused, unlearned_run, base_run, tmp_path):
    copy = Path(shutil.copytree(unlearned_run.checkpoint(2), tmp_path / "copy"))
    meta = json.loads((copy / "meta.json").read_text())
    found = policy_hash(read_info(base_run.checkpoint(4)))
    assert meta["base"] == found
    (copy / "meta.json").write_text(json.dumps(meta | {"base": "0123456789abcdef"}))
    assert refused(evaluate.main, evaluate.Options(checkpoint=copy, output=Path("out"))) == (
        f"{copy}: unlearned from the policy 0123456789abcdef, but {base_run.checkpoint(4)} is now {found}; name the "
        f"base it started from with --base"
    )
    assert load_comparison(copy, robot="g1", base=base_run.checkpoint(4)).info["base"].base is None


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"robot": "gg1", "checkpoint": None}, "robot 'gg1': no robots/gg1/gg1.yaml; did you mean 'g1'?"),
        ({"robot": "gg1"}, "robot 'gg1': no robots/gg1/gg1.yaml; did you mean 'g1'?"),
        ({"checkpoint": Path("nowhere")}, "nowhere: no such checkpoint folder"),
        ({"episodes": 0}, "--episodes: found 0; accepted: 1 or more"),
        ({"seed": -1}, "--seed: found -1; accepted: 0 or more"),
        ({"targets": "trun"}, "targets: no clip 'trun' in the library; did you mean 'turn'?"),
        ({"targets": "nod,turn,sway"}, "targets: all 3 clips of the library; leave at least one to keep"),
        ({"library": Path("nowhere")}, "nowhere/manifest.json: not found; a library is a folder with manifest.json"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(refused, options, given, message):
    assert refused(evaluate.main, options(**given)) == message


def test_a_run_stands_for_its_newest_checkpoint(base_run, tmp_path):
    options = evaluate.Options(checkpoint=base_run.folder, output=tmp_path, episodes=1)
    printed = finished(evaluate.main, options).printed
    assert read_evaluation(tmp_path / "evaluation.json").checkpoint == str(base_run.checkpoint(4))
    # Its library proposes a target, so that the next command needs none.
    assert printed.splitlines()[-1] == f"Next: make unlearn ROBOT=g1 BASE={base_run.folder}"
    config = config_of_new_run(unlearn.Options(base=base_run.folder))
    assert (config.unlearn.targets, config.base) == (("turn",), str(base_run.checkpoint(4)))


@pytest.fixture(scope="module")
def other_library(robot, library_folder, tmp_path_factory):
    """`nod`, and `sway` by the name of `bow`, in a folder that proposes no target."""
    folder = tmp_path_factory.mktemp("other")
    for clip, name in zip(read_library(robot, library_folder, ["nod", "sway"]), ("nod", "bow"), strict=True):
        add_clip(folder, robot, dataclasses.replace(clip, name=name), {})
    return folder


def test_another_library_is_evaluated(unlearned_run, base_run, other_library, tmp_path):
    for checkpoint in (base_run.folder, unlearned_run.folder):
        output = tmp_path / checkpoint.name
        options = evaluate.Options(checkpoint=checkpoint, library=other_library, output=output, episodes=1)
        printed = finished(evaluate.main, options).printed
        document = read_evaluation(output / "evaluation.json")
        assert document.targets == []  # `turn` is not there
        assert set(document.policies["base"].clips) == {"nod", "bow"}
        assert printed.splitlines()[-1] == (f"Next: make play ROBOT=g1 CHECKPOINT={checkpoint} LIBRARY={other_library}")
    assert set(document.policies) == {"base", "unlearned", "zero_action"}


def test_the_bounds_that_end_episodes_are_counted(base_run, tmp_path):
    finished(evaluate.main, evaluate.Options(checkpoint=base_run.folder, output=tmp_path, episodes=2))
    policies = read_evaluation(tmp_path / "evaluation.json").policies
    for name, policy in policies.items():
        failed = sum(round((1 - clip.success_rate.mean) * clip.success_rate.n) for clip in policy.clips.values())
        assert failed > 0
        assert set(policy.ended_by) == {"anchor_height", "orientation", "end_effector_height", "contact_force"}
        assert max(policy.ended_by.values()) <= failed <= sum(policy.ended_by.values())
        assert f"episodes of {name.replace('_', ' ')} that a bound ended: " in (tmp_path / "evaluation.md").read_text()


def test_an_output_that_cannot_be_is_refused_before_the_rollouts(refused, options, tmp_path):
    (tmp_path / "file").write_text("mine")
    for output in (tmp_path / "file", tmp_path / "file" / "out"):
        message = f"{output}: {tmp_path}/file is a file; choose another --output"
        assert refused(evaluate.main, options(output=output)) == message


def test_a_damaged_policy_is_refused(refused, options, base_run, tmp_path):
    copy = Path(shutil.copytree(base_run.checkpoint(4), tmp_path / "copy"))
    (copy / "policy.safetensors").unlink()
    message = f"{copy}/policy.safetensors: missing; the checkpoint cannot be used"
    assert refused(evaluate.main, options(checkpoint=copy)) == message


def test_mjx_is_accepted(base_run):
    from forgetmimic_jax.training.checkpoint import read_info

    options = parse(evaluate.Options, "evaluate", ["--physics", "mjx"])
    config = on_engine(read_info(base_run.checkpoint(4)).config, options.physics)
    assert resolve_engine(config.physics.engine) == "mjx"
