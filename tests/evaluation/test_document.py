import dataclasses
import io
import json
from pathlib import Path

import msgspec
import numpy as np
import pytest
from rich.console import Console

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.basics.provenance import Provenance
from forgetmimic_jax.evaluation import plots
from forgetmimic_jax.evaluation.document import (
    Estimate,
    EvaluationDocument,
    check_policies,
    read_evaluation,
    to_dict,
    write_evaluation,
)
from forgetmimic_jax.evaluation.plots import clip_bars
from forgetmimic_jax.evaluation.summary import evaluate_policies
from forgetmimic_jax.evaluation.tables import fill, markdown, render_table

NAMES = ["walk", "punch", "unused", "crawl"]


@pytest.fixture
def rollouts(make_rollout):
    """Two episodes a clip, horizon 10. The base tracks walk and punch; the unlearned policy lost punch; none crawls."""
    clip, horizon = [0, 0, 1, 1, 3, 3], [10] * 6
    return {
        "zero_action": make_rollout(clip, horizon, [2, 2, 2, 2, 5, 5], [0.5] * 6, [0.4] * 6),
        "unlearned": make_rollout(clip, horizon, [10, 10, 1, 3, 5, 5], [0.7, 0.9, 0.5, 0.5, 0.5, 0.5], [0.2] * 6),
        "base": make_rollout(clip, horizon, [10, 10, 10, 5, 5, 5], [0.8, 1.0, 0.9, 0.9, 0.5, 0.5], [0.1] * 6),
    }


@pytest.fixture
def document(rollouts):
    return EvaluationDocument(
        schema=1,
        robot="g1",
        checkpoint="runs/base",
        config_hash="c0ffee",
        library_hash="beef",
        seed=0,
        episodes=2,
        targets=["punch"],
        policies=evaluate_policies(rollouts, NAMES, ["punch"], seed=0),
        budget={"unlearned": {"iterations": 40, "environment_steps": 123456}},
        made=Provenance(
            **dict.fromkeys(Provenance.__dataclass_fields__, "x") | {"cores": 2, "commit": "c0ffee123+changes"}
        ),
        policy_hashes={"base": "b", "unlearned": "u"},
    )


def test_numbers_by_hand(document):
    base, unlearned, zero = (document.policies[name] for name in ("base", "unlearned", "zero_action"))
    # punch: base 0.9 over 10 and over 5 of 10 steps; unlearned 0.5 over 1 and over 3 of 10.
    assert base.target.survival_weighted_tracking.mean == pytest.approx((0.9 + 0.45) / 2)
    assert unlearned.target.survival_weighted_tracking.mean == pytest.approx((0.05 + 0.15) / 2)
    assert unlearned.target.tracking_reward.mean == pytest.approx(0.5)
    assert base.target.success_rate.mean == 0.5
    assert unlearned.target.episode_length.mean == 2.0
    assert zero.clips["walk"].survival_weighted_tracking.mean == pytest.approx(0.1)
    # kept: walk (0.8, 0.9 mean) and crawl (0.25).
    assert unlearned.kept.survival_weighted_tracking.mean == pytest.approx((0.8 + 0.25) / 2)
    assert unlearned.kept.retention.mean == pytest.approx((0.8 + 0.25) / (0.9 + 0.25))
    # skill: (0.1 - 0.1) / (0.675 - 0.1) on punch; (0.8 - 0.1) / (0.9 - 0.1) on walk.
    assert unlearned.target.skill.mean == pytest.approx(0.0, abs=1e-12)
    assert unlearned.clips["walk"].skill.mean == pytest.approx(0.7 / 0.8)
    # ratios: while alive 0.5 / (0.8 and 0.5), over the horizon 0.1 / (0.8 and 0.25).
    assert unlearned.degradation_ratio.mean == pytest.approx(0.5 / 0.65)
    assert unlearned.survival_weighted_degradation_ratio.mean == pytest.approx(0.1 / 0.525)
    # errors: 0.2 of the unlearned, 0.1 of the base, in every step.
    assert unlearned.kept.errors["mpkpe"].mean == pytest.approx(0.2)
    assert unlearned.kept.metric("mpkpe_common").mean == pytest.approx(0.2)
    assert unlearned.kept.metric("skill") == unlearned.kept.skill


def test_skill_is_absent_where_the_base_is_no_better_than_the_zero_action_baseline(document):
    assert document.policies["unlearned"].clips["crawl"].skill is None
    assert document.policies["base"].clips["walk"].skill is None


def test_schema(document):
    content = to_dict(document)
    assert content["schema"] == 1
    assert set(content) >= {"robot", "checkpoint", "config_hash", "library_hash", "seed", "episodes", "targets"}
    for policy in content["policies"].values():
        assert set(policy["clips"]) == {"walk", "punch", "crawl"}
        assert {name for name, clip in policy["clips"].items() if clip["target"]} == {"punch"}
        groups = [policy["target"], policy["kept"], *policy["clips"].values(), {"ratio": policy["degradation_ratio"]}]
        for group in groups:
            for name, estimate in group.items():
                if name == "target":
                    continue
                assert set(estimate) == {"mean", "low", "high", "std", "n"}, name
                assert estimate["low"] - 1e-6 <= estimate["mean"] <= estimate["high"] + 1e-6
        assert {"mpkpe", "mpkpe_common"} <= set(policy["kept"])
        assert policy["kept"]["mpkpe"]["n"] == 4


def test_without_targets_everything_is_kept(rollouts):
    policies = evaluate_policies({"base": rollouts["base"]}, NAMES, [], seed=0)
    assert set(policies) == {"base"}
    base = policies["base"]
    assert (base.target, base.degradation_ratio) == (None, None)
    assert list(base.kept.errors) == ["mpkpe"]  # nothing to have steps in common with


def test_success_from_frame_0_counts_the_episodes_that_start_there(make_rollout):
    """Of punch: one of two from frame 0 and one of one from later on; of walk: none starts at frame 0."""
    rollout = make_rollout([0, 0, 1, 1, 1], [10] * 5, [10, 10, 10, 4, 10], [1.0] * 5)
    rollout = dataclasses.replace(rollout, start_frame=np.array([7, 5, 0, 0, 6]))
    base = evaluate_policies({"base": rollout}, ["walk", "punch"], ["punch"], seed=0)["base"]
    assert base.clips["walk"].success_rate_from_frame_0 is None
    found = base.target.success_rate_from_frame_0
    assert (found.mean, found.n, base.target.success_rate.n) == (0.5, 2, 3)


def test_one_episode_a_clip_writes_no_nan(tmp_path, make_rollout, document):
    rollouts = {"base": make_rollout([0, 1], [10, 10], [10, 4], [0.9, 0.9])}
    policies = evaluate_policies(rollouts, ["a", "b"], ["b"], seed=0)
    assert policies["base"].clips["a"].tracking_reward == Estimate(mean=pytest.approx(0.9), n=1)
    write_evaluation(tmp_path / "evaluation.json", msgspec.structs.replace(document, policies=policies))
    text = (tmp_path / "evaluation.json").read_text()
    assert "NaN" not in text
    assert "null" not in text


def test_the_file_holds_the_document_and_nothing_else_is_left(tmp_path, document):
    path = tmp_path / "new" / "evaluation.json"
    write_evaluation(path, document)
    assert list(path.parent.iterdir()) == [path]
    assert json.loads(path.read_text()) == to_dict(document)
    assert read_evaluation(path) == document


def test_the_page_gives_the_conditions_and_every_clip(document):
    text = markdown(document)
    assert "Seed 0, 2 episodes a clip." in text
    assert "unlearned 123,456 environment steps, 40 iterations" in text
    assert "| punch | target | 50 % [1, 99] → 0 % [0, 84] |" in text
    # (1 - p)^2 = 0.025
    assert "0 successes of 2 still allow a rate of up to 84 %" in text
    assert "| target: mpkpe, m, common steps | 0.100 [0.100, 0.100] | 0.200 [0.200, 0.200] | 0.400" in text


def test_a_failed_write_leaves_the_old_file(tmp_path, document):
    path = tmp_path / "evaluation.json"
    write_evaluation(path, document)
    with pytest.raises(ValueError, match="JSON compliant"):
        write_evaluation(path, msgspec.structs.replace(document, seed=np.nan))
    assert read_evaluation(path) == document


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: "{", "not an evaluation, or damaged: JSONDecodeError: "),
        (lambda text: "[1]", "not an evaluation, or damaged: TypeError: "),
        (lambda text: "{}", "not an evaluation, or damaged: KeyError: 'schema'"),
        (lambda text: text.replace('"schema": 1', '"schema": 7'), "schema: found 7; accepted: 1"),
        (lambda text: text.replace('"episodes"', '"other"'), "Object missing required field `episodes`"),
        (lambda text: text.replace('"skill": {', '"skill": 3, "x": {', 1), "Expected `object | null`, got `int` - at"),
        (lambda text: text.replace('"success_rate"', '"other"'), "Object missing required field `success_rate`"),
        (lambda text: text.replace('"policies": {', '"policies": {"x": 3, '), "TypeError: "),
    ],
)
def test_a_damaged_or_foreign_file_is_refused_in_one_line(tmp_path, document, change, message):
    path = tmp_path / "evaluation.json"
    write_evaluation(path, document)
    path.write_text(change(path.read_text()))
    with pytest.raises(InputError) as error:
        read_evaluation(path)
    assert str(error.value).startswith(f"{path}: ")
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_an_older_evaluation_is_of_residual_actions(tmp_path, document):
    content = to_dict(document)
    content.pop("action_mode", None)
    (tmp_path / "evaluation.json").write_text(json.dumps(content))
    assert read_evaluation(tmp_path / "evaluation.json").action_mode == "residual"


def test_no_file_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"none\.json: not found"):
        read_evaluation(tmp_path / "none.json")


ROOT = Path(__file__).resolve().parents[2]
STORED = [*ROOT.glob("data/*/base/evaluation.json"), *ROOT.glob("experiments/results/*/evaluation.json")]


@pytest.mark.parametrize("path", STORED, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_stored_evaluations_are_read_whole(path):
    assert to_dict(read_evaluation(path)) == json.loads(path.read_text())


def test_policies_on_the_disk_must_be_those_that_were_evaluated(document):
    file, disk = Path("evaluation.json"), Path("runs/base")
    check_policies(document, file, {"base": (disk, "b"), "unlearned": (Path("runs/u"), "u")})
    with pytest.raises(InputError) as error:
        check_policies(document, file, {"base": (disk, "c"), "unlearned": (Path("runs/u"), "u")})
    assert str(error.value) == (
        "runs/base: found the policy c; evaluation.json is of the base policy b; name that one, or evaluate again"
    )
    older = msgspec.structs.replace(document, policy_hashes={})
    check_policies(older, file, {"base": (disk, "c")})  # it does not say


def test_the_subject_is_the_unlearned_policy_or_the_first_other(document):
    assert document.subject == "unlearned"
    base = document.policies["base"]

    def subject(*names: str) -> str | None:
        return msgspec.structs.replace(document, policies=dict.fromkeys(names, base)).subject

    assert subject("base", "fine_tuned", "retrained", "unlearned", "zero_action") == "unlearned"
    assert subject("base", "retrained", "zero_action") == "retrained"
    assert subject("base", "zero_action") is None


def test_the_terminal_separates_forgotten_from_kept_in_80_columns(document):
    console = Console(width=80, record=True, file=io.StringIO())
    console.print(render_table(document))
    lines = console.export_text().splitlines()
    row = {line.split()[0]: line for line in lines if line.strip()}
    assert " ".join(row["punch"].split()) == "punch target 50 % → 0 % 0.68 → 0.10 0.10 0 % forgotten"
    assert " ".join(row["walk"].split()) == "walk kept 100 % → 100 % 0.90 → 0.80 0.10 88 % kept"
    assert row["crawl"].rstrip().endswith("not learned")


def test_readme_blocks_are_filled_from_the_file_they_name(tmp_path, document):
    write_evaluation(tmp_path / "results" / "evaluation.json", document)
    block = "a\n<!-- evaluation:start results/evaluation.json -->\nold\n<!-- evaluation:end -->\nb\n"
    filled = fill(block, tmp_path)
    assert "old" not in filled
    assert "Trained for: unlearned 123,456 environment steps, 40 iterations. Code: commit c0ffee1+changes." in filled
    # punch is the one target; walk and crawl are kept.
    assert "| target success | 50 % [1, 99] | 0 % [0, 84] | 0 % [0, 84] |" in filled
    assert [line.split(" | ")[0] for line in filled.splitlines() if line.startswith("| ")] == [
        *("| ", "| ---", "| target success", "| target tracking", "| target skill"),
        *("| kept success", "| kept tracking", "| kept skill"),
    ]
    assert fill(filled, tmp_path) == filled
    with pytest.raises(InputError, match=r"no file none\.json"):
        fill(block.replace("results/evaluation.json", "none.json"), tmp_path)


def test_figures_are_written(tmp_path, document):
    clip_bars(document, tmp_path / "clips.png")
    assert (tmp_path / "clips.png").read_bytes().startswith(b"\x89PNG")


def test_a_runs_clips_are_drawn_over_its_environment_steps(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(plots, "save", lambda figure, path: drawn.append(figure))
    rows = [
        {
            "environment_steps": 1_000_000 * (i + 1),
            "clips": {
                clip: {"success_rate": rate * i, "survival_weighted_tracking": 0.5 * rate * i}
                for clip, rate in (("walk", 0.5), ("spin", 0.25))
            },
        }
        for i in range(3)
    ]
    evaluations = tmp_path / "evaluations.jsonl"
    evaluations.write_text("".join(json.dumps(row) + "\n" for row in rows))
    plots.clips_over_time(evaluations, tmp_path / "evaluations.png")
    panels = {axes.get_title(): [line.get_xydata().tolist() for line in axes.lines] for axes in drawn[0].axes}
    assert panels["walk"] == [[[1, 0], [2, 0.5], [3, 1.0]], [], [[1, 0], [2, 0.25], [3, 0.5]], []]
    assert panels["spin"][0] == [[1, 0], [2, 0.25], [3, 0.5]]


def test_a_pretrained_clip_has_its_state_and_its_specialist_apart(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(plots, "save", lambda figure, path: drawn.append(figure))

    def row(millions: int, success: float, state: str, **more: str) -> dict:
        of = {"success_rate": success, "survival_weighted_tracking": 0.5 * success, "state": state}
        return {"environment_steps": 1_000_000 * millions, "clips": {"walk": of, "spin": of}, **more}

    rows = [row(1, 0.2, "learning"), row(2, 0.6, "stuck", specialist="spin"), row(4, 0.8, "mastered")]
    evaluations = tmp_path / "evaluations.jsonl"
    evaluations.write_text("".join(json.dumps(row) + "\n" for row in rows))
    plots.clips_over_time(evaluations, tmp_path / "evaluations.png")
    panels = {axes.get_title(): axes for axes in drawn[0].axes}
    lines = {title: [line.get_xydata().tolist() for line in axes.lines] for title, axes in panels.items()}
    assert lines["walk · mastered"] == [[[1, 0.2], [4, 0.8]], [], [[1, 0.1], [4, 0.4]], []]
    assert lines["spin · mastered"] == [[[1, 0.2], [4, 0.8]], [[2, 0.6]], [[1, 0.1], [4, 0.4]], [[2, 0.3]]]
    spans = [(patch.get_x(), patch.get_width()) for patch in panels["walk · mastered"].patches]
    assert spans == [(0, 1), (1, 1), (2, 2)]
    assert len({patch.get_facecolor() for patch in panels["walk · mastered"].patches}) == 3
