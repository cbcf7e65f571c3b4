import io
import json

import numpy as np
import pytest
from rich.console import Console

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.evaluation import plots
from forgetmimic_jax.evaluation.plots import clip_bars, training_curves
from forgetmimic_jax.evaluation.report import evaluate_policies, evaluation_document, render_table, write_evaluation
from forgetmimic_jax.evaluation.tables import fill, markdown_tables

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
    return evaluation_document(
        evaluate_policies(rollouts, NAMES, ["punch"], seed=0),
        robot="g1",
        checkpoint="runs/base",
        config_hash="c0ffee",
        library_hash="beef",
        seed=0,
        episodes=2,
        targets=["punch"],
        budget={"unlearned": {"iterations": 40, "environment_steps": 123456}},
    )


def mean(estimate):
    return estimate["mean"]


def test_numbers_by_hand(document):
    base, unlearned, floor = (document["policies"][name] for name in ("base", "unlearned", "zero_action"))
    # punch: base 0.9 over 10 and over 5 of 10 steps; unlearned 0.5 over 1 and over 3 of 10.
    assert mean(base["target"]["survival_weighted_tracking"]) == pytest.approx((0.9 + 0.45) / 2)
    assert mean(unlearned["target"]["survival_weighted_tracking"]) == pytest.approx((0.05 + 0.15) / 2)
    assert mean(unlearned["target"]["tracking_reward"]) == pytest.approx(0.5)
    assert mean(base["target"]["success_rate"]) == 0.5
    assert mean(unlearned["target"]["episode_length"]) == 2.0
    assert mean(floor["clips"]["walk"]["survival_weighted_tracking"]) == pytest.approx(0.1)
    # kept: walk (0.8, 0.9 mean) and crawl (0.25).
    assert mean(unlearned["kept"]["survival_weighted_tracking"]) == pytest.approx((0.8 + 0.25) / 2)
    assert mean(unlearned["kept"]["retention"]) == pytest.approx((0.8 + 0.25) / (0.9 + 0.25))
    # skill: (0.1 - 0.1) / (0.675 - 0.1) on punch; (0.8 - 0.1) / (0.9 - 0.1) on walk.
    assert mean(unlearned["target"]["skill"]) == pytest.approx(0.0, abs=1e-12)
    assert mean(unlearned["clips"]["walk"]["skill"]) == pytest.approx(0.7 / 0.8)
    # ratios: while alive 0.5 / (0.8 and 0.5), over the horizon 0.1 / (0.8 and 0.25).
    assert mean(unlearned["degradation_ratio"]) == pytest.approx(0.5 / 0.65)
    assert mean(unlearned["survival_weighted_degradation_ratio"]) == pytest.approx(0.1 / 0.525)


def test_skill_is_absent_where_the_base_is_no_better_than_the_floor(document):
    assert "skill" not in document["policies"]["unlearned"]["clips"]["crawl"]
    assert "skill" not in document["policies"]["base"]["clips"]["walk"]


def test_schema(document):
    assert document["schema"] == 1
    assert set(document) >= {"robot", "checkpoint", "config_hash", "library_hash", "seed", "episodes", "targets"}
    for policy in document["policies"].values():
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
    assert set(policies["base"]) == {"clips", "kept", "nan_resets"}
    assert not any(name.endswith("_common") for name in policies["base"]["kept"])


def test_an_unknown_target_names_the_nearest_clip(rollouts):
    with pytest.raises(InputError, match="no clip 'pnch' in the library; did you mean 'punch'"):
        evaluate_policies(rollouts, NAMES, ["pnch"], seed=0)


def test_one_episode_a_clip_writes_no_nan(tmp_path, make_rollout):
    rollouts = {"base": make_rollout([0, 1], [10, 10], [10, 4], [0.9, 0.9])}
    policies = evaluate_policies(rollouts, ["a", "b"], ["b"], seed=0)
    assert policies["base"]["clips"]["a"]["tracking_reward"] == {"mean": pytest.approx(0.9), "n": 1}
    document = evaluation_document(
        policies, robot="g1", checkpoint="x", config_hash="", library_hash="", seed=0, episodes=1, targets=["b"]
    )
    path, _ = write_evaluation(tmp_path, document)
    assert "NaN" not in path.read_text()


def test_files_hold_the_document_and_nothing_else_is_left(tmp_path, document):
    as_json, as_markdown = write_evaluation(tmp_path / "new", document)
    assert json.loads(as_json.read_text()) == document
    assert sorted(path.name for path in as_json.parent.iterdir()) == ["evaluation.json", "evaluation.md"]
    text = as_markdown.read_text()
    assert "Seed 0, 2 episodes a clip." in text
    assert "unlearned 123,456 environment steps, 40 iterations" in text
    assert "| punch | target | 50 % [1, 99] → 0 % [0, 84] |" in text
    # (1 - p)^2 = 0.025
    assert "0 successes of 2 still allow a rate of up to 84 %" in text


def test_a_failed_write_leaves_the_old_file(tmp_path, document):
    as_json, _ = write_evaluation(tmp_path, document)
    with pytest.raises(ValueError, match="JSON compliant"):
        write_evaluation(tmp_path, document | {"seed": np.nan})
    assert json.loads(as_json.read_text()) == document


def test_the_terminal_tells_forgotten_from_kept_in_80_columns(document):
    console = Console(width=80, record=True, file=io.StringIO())
    console.print(render_table(document))
    lines = console.export_text().splitlines()
    row = {line.split()[0]: line for line in lines if line.strip()}
    assert " ".join(row["punch"].split()) == "punch target 50 % → 0 % 0.68 → 0.10 0.10 0 % forgotten"
    assert " ".join(row["walk"].split()) == "walk kept 100 % → 100 % 0.90 → 0.80 0.10 88 % kept"
    assert row["crawl"].rstrip().endswith("not learned")


def test_readme_blocks_are_filled_from_the_file_they_name(tmp_path, document):
    write_evaluation(tmp_path / "results", document)
    block = "a\n<!-- evaluation:start results/evaluation.json -->\nold\n<!-- evaluation:end -->\nb\n"
    filled = fill(block, tmp_path)
    assert "old" not in filled
    assert markdown_tables(document) in filled
    assert fill(filled, tmp_path) == filled
    with pytest.raises(InputError, match=r"no file none\.json"):
        fill(block.replace("results/evaluation.json", "none.json"), tmp_path)


def test_figures_are_written(tmp_path, document):
    clip_bars(document, tmp_path / "clips.png")
    curves = tmp_path / "metrics.jsonl"
    curves.write_text('{"iteration": 0, "environment_steps": 0, "kl": 0.1}\n{"iteration": 1, "environment_steps": 5}\n')
    training_curves(curves, tmp_path / "curves.png")
    for name in ("clips.png", "curves.png"):
        assert (tmp_path / name).read_bytes().startswith(b"\x89PNG")
    with pytest.raises(InputError, match="no loss in its lines"):
        training_curves(curves, tmp_path / "other.png", keys=["loss"])


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
    assert panels["walk"] == [[[1, 0], [2, 0.5], [3, 1.0]], [[1, 0], [2, 0.25], [3, 0.5]]]
    assert panels["spin"][0] == [[1, 0], [2, 0.25], [3, 0.5]]
