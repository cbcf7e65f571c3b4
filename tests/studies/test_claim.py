"""The word that numbers give a claim, and its correction for many claims."""

import math

import pytest
from scipy import stats

from forgetmimic_jax.evaluation.repeats import Repeat, over_repeats
from forgetmimic_jax.evaluation.statistics import over_seeds
from forgetmimic_jax.studies import claim, variants
from forgetmimic_jax.studies.claim import Between, Finding, answer, corrected, finding, finding_between, judged, p_value

REPEATS = [str(Repeat(0, seed)) for seed in range(3)]


def by_repeat(values: list[Between]) -> dict[str, Between]:
    """Numbers of one base, a seed each."""
    return dict(zip(REPEATS, values, strict=False))


@pytest.mark.parametrize(
    ("values", "below", "word"),
    [
        ([0.01, 0.02, 0.015], True, "holds"),
        ([0.01, 0.02, 0.015], False, "does not hold"),
        ([0.5, 0.52, 0.51], True, "does not hold"),
        ([0.0, 0.1, 0.05], True, "open"),
        ([0.0, 0.1, 0.05], False, "open"),
        ([0.04], True, "one run: yes"),
        ([0.04], False, "one run: no"),
    ],
)
def test_a_claim_holds_where_the_whole_interval_does(values, below, word):
    assert judged(over_seeds(values), 0.05, below=below) == word


def test_a_p_value_is_that_of_students_test_and_crosses_five_per_cent_with_the_interval():
    values = [0.31, 0.35, 0.36, 0.39]
    estimate = over_seeds(values)
    for bound in (0.2, 0.33, 0.5):
        assert p_value(estimate, bound) == pytest.approx(stats.ttest_1samp(values, bound).pvalue)
    assert p_value(estimate, estimate["high"]) == pytest.approx(0.05)
    assert p_value(over_seeds([0.3]), 0.1) is None


def test_numbers_without_spread_that_are_no_rates_decide_nothing():
    same = over_repeats(dict.fromkeys(REPEATS, 0.3))
    assert (p_value(same, 0.1), judged(same, 0.1), judged(same, 0.5)) == (None, "one value", "one value")
    found = finding("c", same, 0.5, "0.3; bound 0.5", main=True)
    assert (found.word, found.p, found.evidence) == ("one value", None, "0.3; bound 0.5")
    assert answer("c", [found, Finding("", "holds", "", 3, main=True)]).word == "open"


def test_without_a_main_finding_a_claim_is_not_measured():
    found = answer("the claim", [Finding("part", "holds", "number", 3)])
    assert (found.word, found.evidence, found.n) == ("not measured", "", 0)


def test_the_seeds_of_one_base_among_several_decide_nothing():
    of_one = finding("", over_repeats(dict(zip(REPEATS, (0.1, 0.11, 0.12), strict=True))), 0.5, "")
    of_all = finding("", over_repeats({f"base {n}, seed 0": 0.1 + 0.01 * n for n in range(3)}), 0.5, "")
    alone = finding("", over_repeats({REPEATS[0]: 0.1}), 0.5, "")
    assert [of.word for of in corrected([of_one, of_all, alone], bases=3)] == ["one base: yes", "holds", "one run: yes"]
    assert corrected([of_one], bases=3)[0].p is None
    assert corrected([of_one], bases=1)[0].word == "holds"


def test_an_interval_that_spans_its_bound_says_how_many_units_would_decide():
    # Mean 2, standard deviation 1: t(0.975, 3) / sqrt(4) = 1.59 and t(0.975, 2) / sqrt(3) = 2.48 lie about 2.
    values = over_repeats({f"base {n}, seed 0": value for n, value in enumerate((1.0, 2.0, 3.0))})
    assert finding("", values, 0.0, "2").evidence == "2; with this mean and spread 4 bases would decide"
    # A distance of 0.1 needs 1.96² / 0.1² = 384 at the least.
    assert finding("", values, 1.9, "2").evidence == "2; with this mean and spread not even 100 bases would decide"
    assert finding("", values, -1.0, "2").evidence == "2"  # holds or fails as it is


def test_a_rate_that_is_the_same_in_every_run_is_tested_by_all_its_episodes():
    success = variants.estimates_of({key: {"success_rate": 0.05, "episodes": 40} for key in REPEATS})["success_rate"]
    assert success["episodes"] == 120
    below = stats.binomtest(6, 120, 0.1, alternative="less").pvalue
    assert p_value(success, 0.1) == pytest.approx(2 * below)
    assert p_value(success, success["high"]) == pytest.approx(0.05)
    assert p_value(success, success["low"]) == pytest.approx(0.05)


def test_holms_correction_by_hand():
    def words(p: list[float | None], main: list[bool]) -> list[str]:
        found = [Finding("", "holds", "", 3, value, is_main) for value, is_main in zip(p, main, strict=True)]
        return [of.word for of in corrected(found)]

    # bounds by size: 0.05 / 4, / 3, / 2, / 1; the third p is over its bound, so the fourth is open too
    assert words([0.04, 0.012, 0.001, 0.03], [False] * 4) == ["open", "holds", "holds", "open"]
    assert words([0.04, 0.016, 0.012, 0.02], [False] * 4) == ["holds"] * 4
    assert words([0.013, 0.013, 0.013, 0.013], [False] * 4) == ["open"] * 4
    # two families of two, each with bounds 0.025 and 0.05
    assert words([0.04, 0.02, 0.03, 0.04], [True, True, False, False]) == ["holds", "holds", "open", "open"]
    # what was not tested does not count
    assert words([0.04, None], [False, False]) == ["holds", "holds"]


def test_a_number_of_which_only_bounds_are_known_decides_what_they_allow():
    def word(values: list[Between], *, below: bool) -> str:
        return finding_between("", by_repeat(values), 8.0, "", below=below).word

    known, under, over = Between(5.0, 5.0), Between(-math.inf, 6.0), Between(16.0, math.inf)
    assert word([known, under, known], below=True) == "holds"
    assert word([known, under, known], below=False) == "does not hold"
    further = Between(17.0, math.inf)
    assert word([over, further, over], below=True) == "does not hold"
    assert word([over, further, over], below=False) == "holds"
    assert word([over, over, over], below=True) == "open"  # without spread
    assert word([known, known, over], below=True) == "open"
    assert word([under, over], below=True) == "open"
    assert word([under], below=True) == "one run: yes"
    assert word([over], below=True) == "one run: no"
    assert word([Between(-math.inf, 12.0)], below=True) == "open"


def test_with_several_bases_bounds_are_means_of_each_bases_seeds():
    def between(*of_base: tuple[float, float]) -> dict[str, Between]:
        """Two seeds of each base, of which the second is only known to lie above."""
        pairs = {Repeat(base, 0): Between(of[0], of[0]) for base, of in enumerate(of_base)}
        pairs |= {Repeat(base, 1): Between(of[1], math.inf) for base, of in enumerate(of_base)}
        return {str(repeat): value for repeat, value in pairs.items()}

    # Means of at least 9, 10 and 11 over three bases: Student's test of these three.
    found = finding_between("", between((8.0, 10.0), (9.0, 11.0), (10.0, 12.0)), 5.0, "", below=False)
    assert (found.word, found.n) == ("holds", 3)
    assert found.p == pytest.approx(stats.ttest_1samp([9.0, 10.0, 11.0], 5.0).pvalue)
    found = finding_between("", between((8.0, 10.0), (9.0, 11.0), (10.0, 12.0)), 10.0, "", below=False)
    assert (found.word, found.n, found.p) == ("open", 3, 1.0)


def test_what_could_not_be_decided_counts_as_tested_only_where_it_was_measured():
    nothing, some = Between(-math.inf, math.inf), Between(-math.inf, 12.0)
    assert finding_between("", by_repeat([nothing, nothing]), 8.0, "").p is None
    assert finding_between("", by_repeat([some, some]), 8.0, "").p == 1.0
    # 5, at most 6 and 5: Student's test of these three against 8
    found = finding_between("", by_repeat([Between(5.0, 5.0), Between(-math.inf, 6.0), Between(5.0, 5.0)]), 8.0, "")
    assert found.p == pytest.approx(stats.ttest_1samp([5.0, 6.0, 5.0], 8.0).pvalue)


@pytest.mark.parametrize(
    ("words", "word"),
    [
        (["holds", "holds"], "holds"),
        (["holds", "open"], "open"),
        (["holds", "does not hold"], "does not hold"),
        (["open", "does not hold"], "does not hold"),
        (["one run: yes", "one run: yes"], "one run: yes"),
        (["one run: yes", "one run: no"], "open"),
    ],
)
def test_a_studys_answer_needs_all_of_its_main_findings(words, word):
    main = [Finding("part", word, f"number {i}", 3 - i, main=True) for i, word in enumerate(words)]
    other = Finding("more", "does not hold", "another number", 1)
    found = answer("the claim", [other, *main])
    assert (found.claim, found.word, found.n) == ("the claim", word, 2)
    assert found.evidence == "number 0; number 1"


def test_the_table_has_the_main_findings_first():
    found = [finding("b", over_seeds([1.0, 1.1]), 9.0, "one"), finding("a", over_seeds([1.0]), 9.0, "two", main=True)]
    rows = claim.findings_table(found).splitlines()[2:]
    assert rows == ["| a | **one run: yes** | two | 1 |", "| b | **holds** | one | 2 seeds |"]
