import numpy as np
import pytest
from scipy import stats

from forgetmimic_jax.evaluation.variants import over_seeds, variant_bars, variant_table


def test_numbers_of_several_seeds_become_students_intervals():
    values = [0.2, 0.5, 0.35]
    found = over_seeds([{"target": {"success_rate": value}, "ratio": 2.0 * value} for value in values])
    low, high = stats.t.interval(0.95, 2, loc=np.mean(values), scale=stats.sem(values))
    estimate = found["target"]["success_rate"]
    assert (estimate["mean"], estimate["low"], estimate["high"]) == pytest.approx((np.mean(values), low, high))
    assert estimate["n"] == 3
    assert found["ratio"]["mean"] == pytest.approx(0.7)


def test_one_seed_has_no_interval_and_a_number_that_some_lack_is_over_the_others():
    found = over_seeds([{"skill": 0.5}, {}])
    assert found == {"skill": {"mean": 0.5, "n": 1}}


def test_seeds_that_all_fail_have_the_exact_interval_of_their_episodes_together():
    runs = [{"success_rate": 0.0, "episodes": 40, "skill": 0.1}] * 3
    found = over_seeds(runs)["success_rate"]
    exact = stats.binomtest(0, 120).proportion_ci(method="exact")
    assert (found["low"], found["high"], found["n"]) == pytest.approx((0.0, exact.high, 3))
    some = over_seeds([*runs[:2], {**runs[0], "success_rate": 0.3}])["success_rate"]
    low, high = stats.t.interval(0.95, 2, loc=0.1, scale=stats.sem([0.0, 0.0, 0.3]))
    assert (some["low"], some["high"]) == pytest.approx((low, high))
    assert "low" not in over_seeds(runs[:1])["success_rate"]


def estimates(success: float, tracking: float) -> dict:
    return over_seeds(
        [{"success_rate": value, "survival_weighted_tracking": tracking} for value in (success - 0.1, success + 0.1)]
    )


@pytest.fixture
def variants() -> dict:
    def policy(success: float, tracking: float) -> dict:
        return {"target": estimates(success, tracking), "kept": estimates(0.8, 0.7)}

    over = {"base": policy(0.9, 0.75), "zero_action": policy(0.1, 0.1), "policy": policy(0.1, 0.2)}
    return {"λ = 16": {"options": {}, "over_seeds": over}}


def test_the_table_shows_base_floor_variants_and_the_paper(variants):
    text = variant_table(variants, {"λ = 16": {"target": {"tracking_reward": 0.5972, "success_rate": 0.0}}})
    targets = [line.split(" | ") for line in text.splitlines() if line.startswith("| ")]
    assert [row[0] for row in targets[2:6]] == ["| base", "| zero action", "| λ = 16", "| *paper: λ = 16*"]
    # 0.9 ± 12.7 · 0.1: no interval leaves what a rate can be
    assert targets[2][1:4] == ["2", "90 % [0, 100]", "0.75 [0.75, 0.75]"]
    assert targets[5][1:5] == ["", "0 %", "", "0.60"]
    assert "another library" in text


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
