"""The verdict's rule on made-up evidence: what passes, and every reason that decides otherwise."""

import pytest
from invented_evidence import compared, curve, estimate, evidence, numbers

from forgetmimic_jax.attacks.verdict import CONSISTENT, FAILED, INCONCLUSIVE, RECOVERABLE, RULES, judge


def test_a_policy_that_no_attack_brings_back_is_consistent():
    verdict = judge(evidence())
    assert verdict.phrase == CONSISTENT
    text = " ".join(verdict.reasons)
    assert "punch 5 % [3, 7] of the base's skill" in text
    assert "60,000 against 100,000 target steps" in text
    assert "skill 20 % [18, 22] on punch, -10 % [-12, -8] above the control's" in text


def test_every_phrase_has_its_rule():
    assert set(RULES) == {CONSISTENT, RECOVERABLE, INCONCLUSIVE, FAILED}


def test_what_the_control_does_too_is_forgotten():
    alike = compared(0.38, 0.3)  # a distilled policy: more than 20 % of the skill, as the control
    verdict = judge(evidence(originals__targets={"punch": alike}, near_duplicates__families={"punch, speed": alike}))
    assert verdict.phrase == CONSISTENT


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"originals__targets__punch": compared(0.6, 0.3)}, "Still known: the target punch, skill 60 %"),
        (
            {"originals__targets__punch__unlearned": numbers(0.05, 0.7, 0.45)},
            "Still known: the target punch, motion content 0.70 [0.68, 0.72] (0.45 [0.43, 0.47] above the control)",
        ),
        (
            {"near_duplicates__families__punch, mirrored": compared(0.9, 0.2)},
            "Still known: near-duplicates of the targets: punch, mirrored, skill 90 %",
        ),
        (
            {"originals__kept__walk": compared(0.1, 0.9), "originals__kept__run": compared(1.0, 0.9)},
            "Lost: the kept clip walk, 10 %",
        ),
        (
            {"originals__kept": {clip: compared(0.7, 0.9) for clip in ("walk", "run")}},
            "Lost: the kept clips on average, 70 %",
        ),
        (
            {"near_duplicates__kept__speed": compared(0.0, 0.85)},
            "Lost: near-duplicates of the kept clips: speed, skill 0 % [-2, 2] (-85 % [-87, -83] above",
        ),
    ],
)
def test_a_failure_says_what_failed(changes, reason):
    verdict = judge(evidence(**changes))
    assert verdict.phrase == FAILED
    assert any(reason in text for text in verdict.reasons), verdict.reasons


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        (
            {"recovery__after__punch__unlearned": numbers(0.45, 0.45, 0.15)},
            "Fine-tuned on the kept clips alone for 100 iterations: skill 45 % [43, 47] on punch, 15 % [13,",
        ),
        (
            {"recovery__after__punch__unlearned": numbers(0.2, 0.5, -0.1) | {"content_above": estimate(0.3)}},
            "Fine-tuned on the kept clips alone for 100 iterations: motion content 0.50 [0.48, 0.52] on punch",
        ),
        (
            {"numerics__changes__int4__punch__unlearned": numbers(0.2, 0.2, 0.15)},
            "Weights in int4: skill 20 % [18, 22]",
        ),
        (
            {"relearning__starts__unlearned__0": curve(40_000)},
            "relearns the targets faster than the control: unlearned policy against control, seed by seed, 40,000",
        ),
    ],
)
def test_a_recovery_names_the_attack_and_by_how_much(changes, reason):
    verdict = judge(evidence(**changes))
    assert verdict.phrase == RECOVERABLE
    assert reason in verdict.reasons[0]


@pytest.mark.parametrize(
    ("place", "phrase"),
    [
        ("near_duplicates__families__kick, mirrored", FAILED),
        ("recovery__after__kick", RECOVERABLE),
        ("numerics__changes__int4__kick", RECOVERABLE),
    ],
)
def test_a_target_below_the_baseline_does_not_pay_for_another(place, phrase):
    # Together the two targets would have 10 %, which the control has too.
    known = {"base": numbers(1.0, 0.95), "unlearned": numbers(0.6, 0.6, 0.5), "control": numbers(0.1, 0.1)}
    lost = {"base": numbers(1.0, 0.95), "unlearned": numbers(-0.4, -0.4, -0.5), "control": numbers(0.1, 0.1)}
    verdict = judge(evidence(**{place: known, place.replace("kick", "punch"): lost}))
    assert verdict.phrase == phrase
    assert "kick" in verdict.reasons[0]


def test_a_control_that_lost_the_kept_clips_excuses_nothing():
    poor = {"originals__kept": {"walk": compared(0.95, 0.5)}}
    known = {"originals__targets__punch": compared(0.9, 0.85), **poor}
    assert judge(evidence(**known)).reasons[0].startswith("Still known: the target punch, skill 90 % [88, 92].")
    lost = {"near_duplicates__kept__speed": compared(0.0, 0.05), **poor}
    assert judge(evidence(**lost)).reasons == ("Lost: near-duplicates of the kept clips: speed, skill 0 % [-2, 2].",)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"originals__targets__punch": compared(0.21, 0.0)}, "Whether this is forgotten is not sure: the target punch"),
        (
            {"near_duplicates__families__punch, speed__unlearned": numbers(0.4, 0.1, 0.19)},
            "near-duplicates of the targets: punch, sp",
        ),
        ({"near_duplicates__kept__speed": compared(0.49, 0.85)}, "Whether this is kept is not sure"),
        ({"recovery__after__punch__unlearned": numbers(0.35, 0.3, 0.09)}, "9 % [7, 11] above the control's"),
        ({"recovery__after__punch__unlearned": numbers(0.37, 0.3, 0.11)}, "11 % [9, 13] above the control's"),
        ({"numerics__changes__int4__punch__unlearned": numbers(0.14, 0.1, 0.09)}, "Weights in int4"),
        ({"near_duplicates__kept__speed": compared(0.3, 0.49)}, "Whether this is kept is not sure"),
        ({"recovery": None}, "Retain-only recovery was not measured."),
        ({"relearning": None}, "How fast it relearns the targets was not measured."),
        ({"numerics": None}, "Other numerics were not measured."),
        ({"near_duplicates": None}, "Near-duplicates were not measured."),
        ({"originals__kept": {"walk": compared(0.95, 0.6)}}, "The control retains 60 % [58, 62] of the kept"),
        ({"originals__targets__punch__unlearned": {"content": estimate(0.0)}}, "on every target"),
        ({"originals__kept": {"walk": {"unlearned": {}, "control": {}}}}, "on every kept clip: no skill is defined"),
        (
            {
                "relearning__base": {"0": 0.8, "1": 0.8},
                "relearning__starts__unlearned": {"0": curve(60_000), "1": curve(30_000)},
                "relearning__starts__control": {"0": curve(100_000), "1": curve(100_000)},
            },
            "With some seeds it relearns",
        ),
    ],
)
def test_what_is_not_sure_or_not_measured_is_inconclusive(changes, reason):
    verdict = judge(evidence(**changes))
    assert verdict.phrase == INCONCLUSIVE
    assert any(reason in text for text in verdict.reasons), verdict.reasons


def short(steps: float, tracking: float) -> dict:
    """A training that never reaches 80 % of the base's 0.8."""
    return {"iterations": [0.0, 10.0, 20.0], "tracking": [0.1, 0.1, tracking], "target_steps": [0.0, steps / 2, steps]}


@pytest.mark.parametrize(("ours", "phrase"), [(0.59, CONSISTENT), (0.61, RECOVERABLE)])
def test_where_neither_relearns_what_they_reached_is_compared(ours, phrase):
    # The control's training is twice as long: half-way it tracks (0.2667 + 0.6) / 2 = 0.4333, 54 % of the base's 0.8.
    # The bound is 54.2 % + 20 %: 0.5933.
    changes = {
        "relearning__starts__unlearned__0": short(75_000, ours),
        "relearning__starts__control__0": {
            "iterations": [0.0, 10.0], "tracking": [0.2667, 0.6], "target_steps": [0.0, 150_000.0]
        },
    }  # fmt: skip
    verdict = judge(evidence(**changes))
    assert verdict.phrase == phrase
    assert f"neither got there: {ours / 0.8:.0%} against 54 %".replace("%", " %", 1) in " ".join(verdict.reasons)


def test_a_failure_is_not_outweighed_by_a_doubt():
    changes = {
        "originals__targets__punch": compared(0.6, 0.3),
        "near_duplicates__families__punch, speed": compared(0.21, 0.0),
    }
    verdict = judge(evidence(**changes))
    assert verdict.phrase == FAILED
    assert len(verdict.reasons) == 2  # skill and motion content of the target


@pytest.mark.parametrize(("skill", "phrase"), [(-0.3, INCONCLUSIVE), (-0.03, INCONCLUSIVE), (-0.01, CONSISTENT)])
def test_a_policy_below_the_zero_action_baseline_is_not_consistent(skill, phrase):
    verdict = judge(evidence(originals__targets__punch=compared(skill, 0.25)))  # with an interval of 2 % on either side
    assert verdict.phrase == phrase
    said = any("Over-forgotten: below the zero-action baseline (punch" in reason for reason in verdict.reasons)
    assert said == (phrase == INCONCLUSIVE)


def test_dropped_variants_are_a_remark():
    verdict = judge(evidence(near_duplicates__dropped={"punch_blended": 0.1, "punch_speed_1.25": 0.4}))
    assert verdict.phrase == CONSISTENT
    assert verdict.reasons[-1].startswith("2 near-duplicates were dropped")


def test_the_worst_variant_is_the_one_that_it_does_most_of():
    assert evidence().near_duplicates.worst == "punch_mirrored"
    content = {"near_duplicates__variants__punch_speed_0.75__unlearned": numbers(0.0, 0.4, 0.2)}
    assert evidence(**content).near_duplicates.worst == "punch_speed_0.75"
