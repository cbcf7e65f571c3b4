import dataclasses
import json
import re
import shutil
from pathlib import Path

import jax
import numpy as np
import pytest
from miniature import TINY, finished, load_state, started
from trees import assert_same

from forgetmimic_jax import train, unlearn
from forgetmimic_jax.basics.errors import InputError, Interrupted, run_command
from forgetmimic_jax.basics.files import read_rows
from forgetmimic_jax.basics.provenance import provenance
from forgetmimic_jax.evaluation import evaluate as evaluation
from forgetmimic_jax.evaluation import metrics
from forgetmimic_jax.evaluation.metrics import Rollout
from forgetmimic_jax.motion.library import DATA_DIR, read_manifest
from forgetmimic_jax.settings.config import load_config, validate
from forgetmimic_jax.tracking.setup import make_setup
from forgetmimic_jax.training import checkpoint, comparison, run, start, stopping
from forgetmimic_jax.training.unlearning_run import config_of_new_run
from forgetmimic_jax.unlearning.stand import PACE


@pytest.fixture
def options(base_run):
    """Options that forget `turn` in the working folder."""

    def options(**given) -> unlearn.Options:
        return unlearn.Options(**{"base": base_run.checkpoint(4), "targets": "turn", "output": Path("run")} | given)

    return options


def test_it_starts_from_the_base_s_policy_with_adam_reset(base_run, unlearned_run):
    start, base = load_state(unlearned_run.checkpoint(0)), load_state(base_run.checkpoint(4))
    assert_same(start.policy, base.policy)  # networks and normalisers
    assert all((leaf == 0).all() for leaf in map(np.asarray, jax.tree.leaves(start.optimizer)))
    assert any((leaf != 0).any() for leaf in map(np.asarray, jax.tree.leaves(base.optimizer)))


def test_the_sampler_is_uniform_and_the_wrench_off(base_run, unlearned_run):
    # The base had neither: failed bins were drawn more often, and every episode was assisted.
    base, forgetting = base_run.rows[-1], unlearned_run.rows[-1]
    # Uniform beside the target's share.
    of_base, found = ({name: of["probability"] for name, of in row["clips"].items()} for row in (base, forgetting))
    assert found == pytest.approx({"nod": 0.25, "sway": 0.25, "turn": 0.5}, abs=1e-5)
    assert of_base != pytest.approx(found, abs=0.01)
    assert (base["wrench_gain"], forgetting["wrench_gain"]) == (pytest.approx(0.5, abs=0.05), 0.0)
    assert (np.asarray(load_state(unlearned_run.checkpoint(0)).env.wrench_gain) == 0.0).all()


def test_its_settings_are_the_base_s_but_for_what_unlearning_changes(base_run, unlearned_run):
    base = load_config(base_run.folder / "config.yaml")
    found = load_config(unlearned_run.folder / "config.yaml")
    assert (found.unlearn.targets, found.unlearn.settings) == (
        ("turn",),
        {"penalty": 16.0},
    )  # it was wanted for " turn, turn ,"
    assert found == dataclasses.replace(
        base,
        base=str(base_run.checkpoint(4)),
        iterations=2,
        evaluate_every=found.evaluate_every,
        unlearn=found.unlearn,
        sampling=dataclasses.replace(base.sampling, rule="uniform_clips", target_share=0.5),
        wrench=dataclasses.replace(base.wrench, max_gain=0.0),
        ppo=dataclasses.replace(
            base.ppo,
            num_steps=12,
            minibatches=4,
            epochs=2,
            schedule="trapezoid",
            learning_rate=3e-4,
            clip_value=False,
            equal_clips=True,
            base_kl=0.1,
        ),
    )


def test_the_metrics_tell_targets_and_kept_clips_apart(unlearned_run):
    row = unlearned_run.rows[0]
    for group in ("target", "kept"):
        for name in ("step_share", "R_track", "R_reg", "R_anti", "tracking_reward", "lambda_crit"):
            assert np.isfinite(row[f"{group}/{name}"]), name
        assert 0.0 < row[f"{group}/tracking_reward"] < 1.0
        assert row[f"{group}/R_track"] > 0.0 > row[f"{group}/R_reg"]
    assert row["target/step_share"] + row["kept/step_share"] == pytest.approx(1.0)
    assert row["target/R_anti"] == pytest.approx(-16.0 * row["target/tracking_reward"], rel=1e-5)
    assert row["kept/R_anti"] == 0.0


def test_the_evaluation_has_the_documented_form(base_run, unlearned_run):
    document = json.loads((unlearned_run.folder / "evaluation.json").read_text())
    policies = document.pop("policies")
    assert document == {
        "schema": 1,
        "robot": "g1",
        "checkpoint": str(unlearned_run.checkpoint(2)),
        "config_hash": document["config_hash"],
        "library_hash": checkpoint.read_info(base_run.checkpoint(4)).library_hash,
        "seed": 0,
        "episodes": 3,
        "targets": ["turn"],
        "budget": {
            "base": {"environment_steps": 128},
            "unlearned": {"environment_steps": 192},
        },
        "made": dataclasses.asdict(provenance()),
        "policy_hashes": {
            "base": checkpoint.policy_hash(checkpoint.read_info(base_run.checkpoint(4))),
            "unlearned": checkpoint.policy_hash(checkpoint.read_info(unlearned_run.checkpoint(2))),
        },
    }
    assert policies.keys() == {"base", "unlearned", "zero_action"}
    for policy in policies.values():
        assert {name: clip["target"] for name, clip in policy["clips"].items()} == {
            "sway": False, "turn": True, "nod": False,
        }  # fmt: skip
        assert (policy["target"]["success_rate"]["n"], policy["kept"]["success_rate"]["n"]) == (3, 6)
        assert policy["degradation_ratio"]["mean"] > 0.0
        for numbers in (policy["target"], policy["kept"], *policy["clips"].values()):
            for name in ("tracking_reward", "survival_weighted_tracking", "success_rate", "episode_length", "mpkpe"):
                number = numbers[name]
                assert number.keys() == {"mean", "low", "high", "std", "n"}, name
                assert number["low"] - 1e-9 <= number["mean"] <= number["high"] + 1e-9
    assert "retention" in policies["unlearned"]["kept"]


def test_it_ends_with_the_table_the_files_and_what_to_do_next(unlearned_run):
    assert {path.name for path in unlearned_run.folder.iterdir()} == {
        *("checkpoints", "config.yaml", "events", "metrics.jsonl"),
        *("evaluation.json", "evaluation.md", "evaluation.png"),
    }
    assert (unlearned_run.folder / "evaluation.png").read_bytes().startswith(b"\x89PNG")
    assert (unlearned_run.folder / "evaluation.md").read_text().startswith("# Evaluation: g1, targets: turn\n")
    printed = unlearned_run.printed.splitlines()
    assert printed[0] == "forget turn by arft: 0/2"
    assert "Clip by clip" in [line.strip() for line in printed]
    path = unlearned_run.checkpoint(2)
    assert printed[-1] == f"Next: make evaluate ROBOT=g1 CHECKPOINT={path} EPISODES=100"


@pytest.fixture
def evaluated(monkeypatch) -> dict:
    """What would have been evaluated."""
    seen = {}

    def evaluate(_setup, subjects, **conditions):
        seen.update(policies={name: subject.policy for name, subject in subjects.items()}, **conditions)
        raise KeyboardInterrupt

    monkeypatch.setattr(evaluation, "evaluate", evaluate)
    return seen


def test_resumed_it_compares_with_the_base_it_started_from(base_run, unlearned_run, evaluated):
    with pytest.raises(Interrupted):
        unlearn.main(unlearn.Options(output=unlearned_run.folder, resume=True, episodes=5))
    assert_same(evaluated["policies"]["base"], load_state(base_run.checkpoint(4)).policy)
    assert_same(evaluated["policies"]["unlearned"], load_state(unlearned_run.checkpoint(2)).policy)
    assert (evaluated["targets"], evaluated["episodes"]) == (("turn",), 5)


def test_a_stop_during_the_evaluation_says_how_to_go_on(unlearned_run, evaluated, capfd):
    with pytest.raises(SystemExit) as exit_:
        run_command(lambda: unlearn.main(unlearn.Options(output=unlearned_run.folder, resume=True)))
    assert exit_.value.code == 130
    assert capfd.readouterr().err == (
        f"stopped; saved {unlearned_run.checkpoint(2)}; "
        f"continue with: make unlearn ROBOT=g1 RESUME=1 OUTPUT={unlearned_run.folder}\n"
    )


def test_targets_are_the_library_s_own_unless_named(options):
    assert config_of_new_run(options(targets=None)).unlearn.targets == ("turn",)
    assert config_of_new_run(options(targets="nod,sway")).unlearn.targets == ("nod", "sway")


def test_a_preset_brings_its_settings_but_keeps_the_base_s_network(options, base_run):
    config = config_of_new_run(options(preset="paper", seed=3))
    base = load_config(base_run.folder / "config.yaml")
    assert (config.preset, config.iterations, config.seed, config.library) == ("paper", 1000, 3, base.library)
    assert (config.ppo.num_envs, config.ppo.actor_layers, config.ppo.critic_layers) == (4096, (16,), (16,))


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"targets": "trun"}, "targets: no clip 'trun' in the library; did you mean 'turn'?"),
        ({"targets": "turn,punch"}, "targets: no clip 'punch' in the library; known: sway, turn, nod"),
        ({"targets": "sway,turn,nod"}, "targets: all 3 clips of the library; leave at least one to keep"),
        ({"targets": " , "}, "--targets: no clip named; name at least one to forget, such as --targets punch,kick"),
        (
            {"set": [["unlearn.targets=[]"]]},
            "--targets: no clip named; name at least one to forget, such as --targets punch,kick",
        ),
        ({"penalty": 0.0}, "unlearn.settings.penalty: found 0.0; accepted: a number above 0"),
        ({"penalty": -16.0}, "unlearn.settings.penalty: found -16.0; accepted: a number above 0"),
        ({"penalty": float("nan")}, "unlearn.settings.penalty: found nan; accepted: a number above 0"),
        ({"penalty": float("inf")}, "unlearn.settings.penalty: found inf; accepted: a number above 0"),
        (
            {"set": [["unlearn.settings.penalt=3"]]},
            "unlearn.settings: arft has no setting 'penalt'; did you mean 'penalty'?",
        ),
        (
            {"method": "stand", "set": [["unlearn.instead=sawy"]]},
            "unlearn.instead: no clip 'sawy' in the library; did you mean 'sway'?",
        ),
        (
            {"method": "stand", "set": [["unlearn.instead=turn"]]},
            "unlearn.instead: 'turn' is a clip to forget; known: stand, sway, nod",
        ),
        (
            {"set": [["unlearn.instead=sway"]]},
            "unlearn.instead: found sway; accepted: nothing, since arft teaches nothing in the place of the targets",
        ),
        (
            {"method": "finetune", "set": [["unlearn.stop_every=20"]]},
            "unlearn.stop_every: found 20; accepted: 0, since finetune has no stop rule",
        ),
        (
            {"set": [["unlearn.stop_every=-1"]]},
            "--set: unlearn.stop_every: found -1; accepted: a whole number from 0",
        ),
        ({"episodes": 0}, "--episodes: found 0; accepted: 1 or more"),
        ({"iterations": 0}, "iterations: found 0; accepted: a whole number from 1"),
        ({"iterations": -1}, "iterations: found -1; accepted: a whole number from 1"),
        ({"robot": "gg1"}, "robot 'gg1': no robots/gg1/gg1.yaml; did you mean 'g1'?"),
        ({"robot": "gg1", "base": None}, "robot 'gg1': no robots/gg1/gg1.yaml; did you mean 'g1'?"),
        ({"base": Path("nowhere")}, "nowhere: no such checkpoint folder"),
        ({"library": Path("nowhere")}, "nowhere/manifest.json: not found; a library is a folder with manifest.json"),
        ({"resume": True}, "run: --resume finds no checkpoint there; leave it out to start"),
        (
            {"resume": True, "output": None},
            "runs/unlearn-g1-001: --resume finds no checkpoint there; leave it out to start",
        ),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(refused, options, given, message):
    assert refused(unlearn.main, options(**given)) == message


def test_no_shipped_base_is_refused(refused, options, tmp_path, monkeypatch):
    monkeypatch.setattr(start, "DATA_DIR", tmp_path)
    message = f"{tmp_path}/g1/base: no policy is shipped for 'g1'; train one and name its checkpoint"
    assert refused(unlearn.main, options(base=None)) == message


@pytest.fixture
def damaged(base_run, tmp_path) -> Path:
    """A copy of the base that a test may damage."""
    return Path(shutil.copytree(base_run.checkpoint(4), tmp_path / "base"))


def test_a_base_of_another_robot_is_refused(refused, options, damaged):
    note = json.loads((damaged / "meta.json").read_text())
    (damaged / "meta.json").write_text(json.dumps(note | {"robot": "h2", "joints": note["joints"][:3]}))
    joints = len(note["joints"])
    message = f"{damaged}: robot: the checkpoint's is 'h2' (3 joints), this run's 'g1' ({joints} joints)"
    assert refused(unlearn.main, options(base=damaged)) == message


def test_a_base_of_another_network_is_refused(refused, options, damaged):
    message = refused(unlearn.main, options(base=damaged, set=[["ppo.critic_layers=[8]"]]))
    assert message == f"{damaged}: ppo.critic_layers: the checkpoint's is [16], this run's [8]"


def test_a_base_of_another_library_is_refused(refused, options, damaged, tmp_path, library_folder):
    library = Path(shutil.copytree(library_folder, tmp_path / "library"))
    manifest = json.loads((library / "manifest.json").read_text())
    del manifest["clips"]["nod"]
    (library / "manifest.json").write_text(json.dumps(manifest))
    message = refused(unlearn.main, options(base=damaged, library=library))
    assert message.startswith(f"{damaged}: library: the checkpoint's hash is ")
    assert message.endswith("(missing here: nod)")


def test_a_damaged_base_is_refused(refused, options, damaged):
    file = damaged / "policy.safetensors"
    file.write_bytes(file.read_bytes()[:100])
    assert refused(unlearn.main, options(base=damaged)) == (
        f"{file}: damaged: not what was saved; the checkpoint cannot be used"
    )
    (damaged / "meta.json").write_text("{")
    assert refused(unlearn.main, options(base=damaged)).startswith(f"{damaged}/meta.json: damaged: ")


def test_a_damaged_checkpoint_to_resume_is_refused(refused, unlearned_run, tmp_path):
    run = Path(shutil.copytree(unlearned_run.folder, tmp_path / "run"))
    shutil.rmtree(run / "checkpoints" / "00000002" / "run" / "d")
    message = refused(unlearn.main, unlearn.Options(output=run, resume=True))
    assert message.startswith(f"{run}/checkpoints/00000002/run/d/")
    assert message.endswith(": missing; the checkpoint cannot be used")


def test_a_base_that_is_gone_is_refused_before_the_run_continues(refused, unlearned_run, tmp_path):
    run = Path(shutil.copytree(unlearned_run.folder, tmp_path / "run"))
    config = (run / "config.yaml").read_text().splitlines()
    (run / "config.yaml").write_text("\n".join("base: gone" if "base: " in line else line for line in config))
    message = refused(unlearn.main, unlearn.Options(output=run, resume=True, iterations=3))
    assert message == "gone: no such checkpoint folder"


def test_flags_that_contradict_the_run_to_resume_are_refused(refused, unlearned_run):
    def resume(**flags) -> str:
        return refused(unlearn.main, unlearn.Options(output=unlearned_run.folder, resume=True, **flags))

    assert resume(penalty=8.0) == "--penalty: found 8.0, but the run to resume has 16.0; leave the flag out"
    assert resume(targets="nod, sway").startswith("--targets: found nod,sway, but the run to resume has turn")
    assert resume(base=Path("other")).startswith("--base: found other, but the run to resume has ")


def test_flags_choose_the_sampler_and_the_wrench(options):
    def settings(**given) -> tuple[str, str, float]:
        config = config_of_new_run(options(**given))
        return config.sampling.rule, config.sampling.clips, config.wrench.max_gain

    assert settings() == ("uniform_clips", "all", 0.0)
    assert settings(sampler="adaptive") == ("adaptive", "all", 0.0)
    assert settings(sampler="uniform_bins", wrench=True) == ("uniform_bins", "all", 0.5)  # the base's own β_max
    assert settings(method="finetune") == ("uniform_clips", "kept", 0.0)
    assert settings(method="finetune", clips="all") == ("uniform_clips", "all", 0.0)
    assert settings(method="retrain") == ("adaptive", "kept", 0.5)  # as the base was trained
    assert settings(method="retrain", sampler="uniform_clips") == ("uniform_clips", "kept", 0.5)
    assert settings(method="distill") == ("uniform_clips", "kept", 0.0)


@pytest.mark.parametrize(
    ("given", "share"),
    [
        ({}, 0.5),
        ({"method": "trajdeleter"}, 0.5),
        ({"method": "finetune", "clips": "all"}, 0.5),
        ({"method": "finetune"}, 0.0),  # which starts from no target
        ({"method": "retrain"}, 0.0),
        ({"method": "distill"}, 0.0),
        ({"sampler": "adaptive"}, 0.0),  # a sampler is compared by the shares that it gives
        ({"preset": "paper"}, 0.0),
    ],
)
def test_targets_get_a_share_of_the_uniform_starts_at_the_laptops_pace(options, unlearned_run, given, share):
    for base in ({}, {"base": unlearned_run.checkpoint(2)}):  # whose own training had the share
        config = config_of_new_run(options(**given, **base))
        assert (config.sampling.target_share, config.sampling.first_frame) == (share, 0.0)
        validate(config)


def test_a_wrench_that_the_base_did_not_have_is_the_paper_s(options, damaged):
    config = damaged / "config.yaml"
    config.write_text(config.read_text().replace("max_gain: 0.5", "max_gain: 0.0"))
    assert config_of_new_run(options(base=damaged)).wrench.max_gain == 0.0
    assert config_of_new_run(options(base=damaged, wrench=True)).wrench.max_gain == 0.6


def test_a_policy_from_scratch_is_held_by_nothing(options, unlearned_run):
    base = unlearned_run.checkpoint(2)
    weights = [config_of_new_run(options(method=name, base=base)).ppo.base_kl for name in ("arft", "retrain")]
    assert weights == [0.1, 0.0]


def test_a_distilled_policy_starts_afresh_and_is_pulled_towards_the_base_at_any_scale(options, base_run, tmp_path):
    assert config_of_new_run(options(method="distill", iterations=None)).iterations == 200
    assert config_of_new_run(options(method="distill", preset="paper")).ppo.base_kl == 1.0
    output = tmp_path / "run"
    unlearn.main(options(method="distill", iterations=2, episodes=2, output=output))
    start, base = load_state(output / "checkpoints" / "00000000"), load_state(base_run.checkpoint(4))
    assert float(start.policy.actor_normalizer.count) == 0.0 < float(base.policy.actor_normalizer.count)
    rows = read_rows(output / "metrics.jsonl")
    assert all(row["base_kl"] > 0.0 for row in rows)
    assert all(row["target/step_share"] == 0.0 for row in rows)
    assert {name for row in rows for name in row if name.startswith("target/")} == {"target/step_share"}
    assert load_config(output / "config.yaml").ppo.base_kl == 1.0
    policies = json.loads((output / "evaluation.json").read_text())["policies"]
    assert policies.keys() == {"base", "unlearned", "zero_action"}


def test_retraining_takes_as_many_steps_as_the_base_did(options):
    assert config_of_new_run(options(method="retrain")).iterations == 4
    assert config_of_new_run(options(method="retrain", iterations=None, preset="paper")).iterations == 1


@pytest.mark.parametrize("given", [{"sampler": "adaptive"}, {"sampler": "frozen"}, {"wrench": True}])
def test_what_goes_by_failure_levels_goes_on_with_the_base_s(options, base_run, given):
    setup = make_setup(config_of_new_run(options(**given)))
    base = load_state(base_run.checkpoint(4)).failure_level
    np.testing.assert_array_equal(started(setup).failure_level, base)
    assert (np.asarray(base) != 1.0).any()


def test_a_method_without_a_simulator_goes_through_the_same_loop_and_resumes_bit_for_bit(options, tmp_path):
    def edit(output: str, **given) -> Path:
        unlearn.main(options(method="policy_edit", output=tmp_path / output, episodes=2, **given))
        return tmp_path / output

    whole = edit("whole", iterations=3)
    halves = edit("halves", iterations=2)
    unlearn.main(unlearn.Options(output=halves, resume=True, iterations=3, episodes=2))
    one, two = (load_state(run / "checkpoints" / "00000003") for run in (whole, halves))
    assert_same(one, two)
    assert (whole / "evaluation.json").read_bytes().replace(b"whole", b"halves") == (
        halves / "evaluation.json"
    ).read_bytes()
    assert load_config(halves / "config.yaml").unlearn.method == "policy_edit"


def test_a_retrained_policy_starts_afresh_and_is_called_so(options, base_run, tmp_path):
    output = tmp_path / "run"
    unlearn.main(options(method="retrain", iterations=2, episodes=2, output=output))
    start, base = load_state(output / "checkpoints" / "00000000"), load_state(base_run.checkpoint(4))
    assert float(start.policy.actor_normalizer.count) == 0.0 < float(base.policy.actor_normalizer.count)
    assert (np.asarray(start.env.clip) != 1).all()  # `turn` is never started
    document = json.loads((output / "evaluation.json").read_text())
    assert document["policies"].keys() == {"base", "retrained", "zero_action"}
    assert document["budget"].keys() == {"base", "retrained"}


def test_an_unknown_method_is_refused(refused, options):
    assert refused(unlearn.main, options(method="finetuned")) == (
        "unlearn.method: no method 'finetuned'; did you mean 'finetune'?"
    )


def test_a_method_that_contradicts_the_run_to_resume_is_refused(refused, unlearned_run):
    message = refused(unlearn.main, unlearn.Options(output=unlearned_run.folder, resume=True, method="retrain"))
    assert message == "--method: found retrain, but the run to resume has arft; leave the flag out"


def test_another_robot_learns_from_the_first_forgets_and_is_evaluated_on_its_own_library(base_run, tmp_path):
    """The H2: 31 joints, the ankle's the other way round, the head before the arms."""
    start = base_run.checkpoint(4)
    given = train.Options(robot="h2", base=start, output=tmp_path / "base", iterations=2, set=[TINY])
    base = finished(train.main, given)
    wanted = {"robot": "h2", "base": base.checkpoint(2), "iterations": 1, "episodes": 1}
    run = finished(unlearn.main, unlearn.Options(**wanted, output=tmp_path / "unlearned"))
    document = json.loads((run.folder / "evaluation.json").read_text())
    assert document["robot"] == "h2"
    assert document["targets"] == ["punch", "kick"]
    assert set(document["policies"]["unlearned"]["clips"]) == set(read_manifest(DATA_DIR / "h2")["clips"])
    # A robot of 76 kg that stands where the reference stands stays up for some steps.
    assert document["policies"]["zero_action"]["kept"]["episode_length"]["mean"] > 5.0


def test_a_run_with_a_stop_rule_ends_early_and_after_a_kill_with_the_same_bits(options, tmp_path, monkeypatch):
    """Looks at 2 and 4 find the targets at a baseline of any skill; two iterations later the run ends."""
    monkeypatch.setattr(stopping, "AT_BASELINE", np.inf)
    monkeypatch.setattr(stopping, "SETTLE", 2)
    monkeypatch.setattr(metrics, "MINIMUM_SKILL_RANGE", -np.inf)  # this base hardly beats the zero action
    whole = tmp_path / "whole"
    unlearn.main(options(output=whole, iterations=9, episodes=1, set=[["unlearn.stop_every=2"]]))
    assert [path.name for path in sorted((whole / "checkpoints").iterdir())] == ["00000004", "00000006"]
    killed = Path(shutil.copytree(whole, tmp_path / "killed"))
    shutil.rmtree(killed / "checkpoints" / "00000006")
    (killed / "evaluation.json").unlink()
    unlearn.main(unlearn.Options(output=killed, resume=True, episodes=1))
    one, two = (load_state(run / "checkpoints" / "00000006") for run in (whole, killed))
    assert_same(one, two)
    longer = unlearn.Options(output=killed, resume=True, episodes=1, no_stop=True)
    unlearn.main(longer)
    assert [path.name for path in sorted((killed / "checkpoints").iterdir())] == ["00000008", "00000009"]


def test_a_stop_rule_is_the_default_where_a_method_has_one(options):
    def stop_every(**given) -> int:
        return config_of_new_run(options(**given)).unlearn.stop_every

    assert (stop_every(), stop_every(preset="paper"), stop_every(no_stop=True)) == (10, 10, 0)
    assert (stop_every(method="finetune"), stop_every(method="stand")) == (0, 0)


def test_a_base_that_cannot_stand_learns_that_first_and_then_teaches(options, tmp_path, capsys):
    def stand(learning: int, **given) -> unlearn.Options:
        steps = [f"unlearn.settings.stand_iterations={learning}"]
        return options(**{"method": "stand", "output": tmp_path / "run", "episodes": 1, "set": [steps]} | given)

    unlearn.main(stand(2, iterations=2))
    printed = capsys.readouterr().out
    assert re.search(
        r"the base stays upright in \d+% of the targets' episodes; it learns to stand first$", printed, re.M
    )
    assert re.search(r"^after training it stays upright in \d+%$", printed, re.M)
    assert "; it goes on for half as many iterations\n" in printed
    learned = checkpoint.read_info(tmp_path / "run-stand" / "checkpoints" / "00000003")
    assert (learned.config.sampling.target_share, learned.config.unlearn.method) == (1.0, "stand")
    starts = learned.config.sampling
    assert (starts.rule, starts.bin_seconds) == ("adaptive", 0.3)  # its bins are not the base's
    config = load_config(tmp_path / "run" / "config.yaml")
    assert (config.unlearn.instead, config.sampling.target_share, config.unlearn.stop_every) == ("stand", 0.5, 0)
    assert config.sampling.first_frame == PACE.first_frame > 0.0
    rows = read_rows(tmp_path / "run" / "metrics.jsonl")
    assert all(np.isfinite(row[name]) and row[name] > 0.0 for row in rows for name in ("teacher_kl", "base_kl"))
    policies = json.loads((tmp_path / "run" / "evaluation.json").read_text())["policies"]
    assert policies.keys() == {"base", "unlearned", "zero_action"}

    whole = load_state(tmp_path / "run" / "checkpoints" / "00000002")
    shutil.rmtree(tmp_path / "run" / "checkpoints" / "00000002")
    unlearn.main(unlearn.Options(output=tmp_path / "run", resume=True, episodes=1))
    assert_same(load_state(tmp_path / "run" / "checkpoints" / "00000002"), whole)

    shutil.rmtree(tmp_path / "run")
    with pytest.raises(InputError, match=r"run-stand: is of a run with other settings; remove it, or choose another"):
        unlearn.main(stand(4))


@pytest.mark.parametrize(("reached", "warned"), [(39, True), (40, False)])
def test_a_base_that_completes_nothing_is_said_first(base_run, reached, warned, monkeypatch, capfd, tmp_path):
    horizon = np.full(6, 40)
    length = np.array([1, 5, 39, 10, reached, 20])
    rollout = Rollout(np.repeat(np.arange(3), 2), np.zeros(6, int), horizon, length, np.zeros((6, 40)))

    class Rolled:
        def __init__(self, setup, *, episodes, seed):
            assert episodes == 2

        def rollout(self, policy):
            return rollout

    class Begun(Exception):
        pass

    def begin(*_, **__):
        raise Begun

    monkeypatch.setattr(comparison, "Evaluator", Rolled)
    monkeypatch.setattr(run, "run", begin)
    options = unlearn.Options(base=base_run.folder, targets="turn", output=tmp_path / "out")
    with pytest.raises(Begun):
        unlearn.main(options)
    text = f"the base completes no episode of any clip ({base_run.checkpoint(4)}): there is nothing to forget"
    assert capfd.readouterr().err == (f"warning: {text}\n" if warned else "")
