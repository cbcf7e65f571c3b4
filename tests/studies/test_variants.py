import json
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from forgetmimic_jax.evaluation.repeats import Repeat
from forgetmimic_jax.studies.variants import estimates_of, gained, summary, variant_bars, variant_table


def by_repeat(runs: list) -> dict:
    """Runs of one base, a seed each."""
    return {str(Repeat(0, seed)): run for seed, run in enumerate(runs)}


def test_numbers_of_several_seeds_become_students_intervals():
    values = [0.2, 0.5, 0.35]
    found = estimates_of(by_repeat([{"target": {"success_rate": value}, "ratio": 2.0 * value} for value in values]))
    low, high = stats.t.interval(0.95, 2, loc=np.mean(values), scale=stats.sem(values))
    estimate = found["target"]["success_rate"]
    assert (estimate["mean"], estimate["low"], estimate["high"]) == pytest.approx((np.mean(values), low, high))
    assert estimate["n"] == 3
    assert found["ratio"]["mean"] == pytest.approx(0.7)


def test_one_seed_has_no_interval_and_a_number_that_some_lack_is_over_the_others():
    found = estimates_of(by_repeat([{"skill": 0.5}, {}]))
    assert found == {"skill": {"mean": 0.5, "n": 1, "unit": "seed"}}


def test_seeds_that_all_fail_have_the_exact_interval_of_their_episodes_together():
    runs = [{"success_rate": 0.0, "episodes": 40, "skill": 0.1}] * 3
    found = estimates_of(by_repeat(runs))["success_rate"]
    exact = stats.binomtest(0, 120).proportion_ci(method="exact")
    assert (found["low"], found["high"], found["n"]) == pytest.approx((0.0, exact.high, 3))
    assert found["episodes"] == 120
    some = estimates_of(by_repeat([*runs[:2], {**runs[0], "success_rate": 0.3}]))["success_rate"]
    low, high = stats.t.interval(0.95, 2, loc=0.1, scale=stats.sem([0.0, 0.0, 0.3]))
    assert (some["low"], some["high"]) == pytest.approx((low, high))
    assert "low" not in estimates_of(by_repeat(runs[:1]))["success_rate"]


def seeds(target: list[float], kept: list[float]) -> dict:
    """Two seeds, of each of which success and tracking are given: of the targets, and of the kept clips."""

    def group(success: float, tracking: float) -> dict:
        return {"success_rate": success, "survival_weighted_tracking": tracking}

    policy = [{"target": group(success, target[1]), "kept": group(*kept)} for success in target[0]]
    base = [{"target": group(success, 0.75), "kept": group(0.8, 0.7)} for success in (0.8, 1.0)]
    zero = [{"target": group(success, 0.1), "kept": group(0.0, 0.1)} for success in (0.0, 0.2)]
    runs = zip(policy, base, zero, strict=True)
    return by_repeat([{"policy": one, "base": b, "zero_action": z} for one, b, z in runs])


@pytest.fixture
def variants() -> dict:
    return {"λ = 16": {"options": {}, "runs": seeds([[0.0, 0.2], 0.2], [0.8, 0.7])}}


def test_a_difference_is_between_runs_of_the_same_repeat(variants):
    assert gained(variants, "λ = 16", None, "target", "success_rate") == pytest.approx(by_repeat([-0.8, -0.8]))
    other = {"runs": {"base 0, seed 1": variants["λ = 16"]["runs"]["base 0, seed 0"]}}
    of = {**variants, "other": other}
    assert gained(of, "λ = 16", "other", "target", "success_rate") == pytest.approx({"base 0, seed 1": 0.2})
    assert gained(of, "λ = 16", "gone", "target", "success_rate") == {}


NUMBERS = ("success_rate", "survival_weighted_tracking", "tracking_reward", "episode_length")


def write(folder: Path, policies: dict) -> None:
    """An evaluation.json of policies."""
    names = dict.fromkeys(("robot", "checkpoint", "config_hash", "library_hash"), "")
    document = {"schema": 1, "seed": 0, "episodes": 6, "targets": [], **names, "policies": policies}
    (folder / "evaluation.json").write_text(json.dumps(document))


def test_a_trials_summary_has_the_means_that_tables_and_figures_read(tmp_path):
    def policy(value: float) -> dict:
        metrics = {name: {"mean": value, "low": 0.0, "n": 6} for name in NUMBERS} | {"mpkpe": {"mean": 1.0}}
        groups = {"clips": {"run": {"target": False, **metrics}}, "target": metrics, "kept": metrics}
        return {**groups, "degradation_ratio": {"mean": 2 * value}, "nan_resets": 0}

    write(tmp_path, {"base": policy(0.9), "unlearned": policy(0.1), "zero_action": policy(0.0)})
    rows = [
        {"environment_steps": 10, "target/step_share": 0.5, "target/lambda_crit": 7.5},
        {"environment_steps": 40, "target/step_share": 0.1, "target/lambda_crit": 7.9},
    ]
    (tmp_path / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    found = summary(tmp_path)
    group = dict.fromkeys(NUMBERS, 0.1) | {"episodes": 6}
    assert found["policy"] == {"target": group, "kept": group, "clips": {"run": 0.1}, "degradation_ratio": 0.2}
    assert found["lambda_crit"] == 7.5
    assert found["target_step_share"] == pytest.approx((10 * 0.5 + 30 * 0.1) / 40)
    rows = [{name: row[name] for name in ("environment_steps", "target/step_share")} for row in rows]
    (tmp_path / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    assert "lambda_crit" not in summary(tmp_path)


def test_the_table_shows_base_floor_variants_and_the_paper(variants):
    text = variant_table(variants, {"λ = 16": {"target": {"tracking_reward": 0.5972, "success_rate": 0.0}}})
    targets = [line.split(" | ") for line in text.splitlines() if line.startswith("| ")]
    assert [row[0] for row in targets[2:6]] == ["| base", "| zero action", "| λ = 16", "| *paper: λ = 16*"]
    # 0.9 ± 12.7 · 0.1: no interval leaves what a rate can be
    assert targets[2][1:4] == ["2 seeds", "90 % [0, 100]", "0.75"]
    assert targets[5][1:5] == ["", "0 %", "", "0.60"]
    assert "another library" in text


def test_numbers_without_terminations_are_columns_which_are_empty_where_a_trial_lacks_them(variants, tmp_path):
    header, _, *rows = [line.split(" | ") for line in variant_table(variants, {}).splitlines() if line.startswith("| ")]
    assert header[-3:] == ["upright", "impact", "content |"]
    assert rows[0][-3:] == ["", "", " |"]
    for seed, run in enumerate(variants["λ = 16"]["runs"].values()):
        run["policy"]["target"] |= {"upright_rate": 0.0, "impact_rate": 0.9 + 0.1 * seed, "motion_content": -0.9}
    rows = [line.split(" | ") for line in variant_table(variants, {}).splitlines() if line.startswith("| λ")]
    assert rows[0][-3:] == ["0 %", "95 % [31, 100]", "-0.90 |"]
    assert len(rows[1]) == 9, "kept clips have none"


def test_a_trials_summary_has_the_numbers_without_terminations(tmp_path):
    group = {name: {"mean": 0.5, "n": 6} for name in NUMBERS}
    every = {name: {"mean": mean, "n": 6} for name, mean in (("upright_rate", 0.5), ("motion_content", 0.1))}
    target = {**group, "unbounded": {"all_starts": every, "from_frame_0": {"upright_rate": {"mean": 1.0}}}}
    write(tmp_path, {"unlearned": {"clips": {}, "target": target, "kept": group, "nan_resets": 0}})
    (tmp_path / "metrics.jsonl").write_text("")
    found = summary(tmp_path)["policy"]
    assert (found["target"]["upright_rate"], found["target"]["motion_content"]) == (0.5, 0.1)
    assert "upright_rate" not in found["kept"]


def test_variants_with_targets_of_their_own_have_bases_of_their_own(variants):
    run = variants["λ = 16"]
    two = {label: {**run, "options": {"targets": label}} for label in ("run", "walk")}
    rows = [line.split(" | ")[0] for line in variant_table(two, {}).splitlines() if line.startswith("| ")]
    assert rows[2:8] == [
        *("| base (run)", "| zero action (run)", "| run"),
        *("| base (walk)", "| zero action (walk)", "| walk"),
    ]


def test_the_bars_are_the_means(variants):
    figure = variant_bars(variants)
    heights = [bar.get_height() for bar in figure.axes[0].patches]
    assert heights == pytest.approx([0.9, 0.1, 0.8, 0.8])  # targets of base and variant, then kept clips
