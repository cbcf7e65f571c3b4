import pytest

from forgetmimic_jax.evaluation.relearning import Lasted
from forgetmimic_jax.evaluation.verdict import CONSISTENT, FAILED, INCONCLUSIVE, RECOVERABLE, RULES, judge


def interval(low: float, high: float) -> dict:
    return {"mean": (low + high) / 2, "low": low, "high": high, "std": 0.1, "n": 20}


FORGOTTEN, KEPT, TRACKING = interval(-0.1, 0.1), interval(0.9, 1.1), interval(0.1, 0.2)


def policies(target: dict = FORGOTTEN, kept: dict = KEPT) -> dict:
    """An evaluation in which the targets' and the kept clips' skill left are given."""
    unlearned = {"target": {"skill": target, "survival_weighted_tracking": TRACKING}, "kept": {"skill": kept}}
    return {"base": {}, "unlearned": unlearned, "zero_action": {}}


def never_lived(low: float, high: float) -> dict:
    return {"target": {"survival_weighted_tracking": interval(low, high)}}


def relearned(*seeds: tuple[float, float], there: tuple[bool, bool] = (True, True)) -> dict:
    """Target steps of the unlearned policy and of the control, seed by seed."""
    return {
        str(seed): tuple(Lasted(0, steps, reached) for steps, reached in zip(pair, there, strict=True))
        for seed, pair in enumerate(seeds)
    }


SLOW = relearned((60_000, 100_000))
FAST = relearned((40_000, 100_000))


@pytest.mark.parametrize(
    ("target", "kept", "word", "reason"),
    [
        (interval(0.21, 0.60), KEPT, FAILED, "The targets are still known: 40 % [21, 60] of the skill"),
        (FORGOTTEN, interval(0.4, 0.79), FAILED, "The kept clips were lost: "),
        (interval(-0.1, 0.21), KEPT, INCONCLUSIVE, "Whether the targets are forgotten is not sure: "),
        (interval(0.19, 0.60), KEPT, INCONCLUSIVE, "Whether the targets are forgotten is not sure: "),
        (FORGOTTEN, interval(0.79, 1.1), INCONCLUSIVE, "Whether the kept clips are kept is not sure: "),
        (FORGOTTEN, interval(0.7, 0.81), INCONCLUSIVE, "Whether the kept clips are kept is not sure: "),
        (
            interval(-0.1, 0.2),
            interval(0.8, 1.1),
            INCONCLUSIVE,
            "On these episodes the targets are forgotten (5 % [-10",
        ),
        ({}, KEPT, INCONCLUSIVE, "The base itself is hardly better on the targets than no policy"),
        (
            interval(-0.1, 0.1),
            {"mean": 1.0, "n": 1},
            INCONCLUSIVE,
            "The base itself is hardly better on the kept clips",
        ),
    ],
)
def test_the_evaluation_alone(target, kept, word, reason):
    verdict = judge(policies(target, kept))
    assert verdict.word == word
    assert verdict.reasons[0].startswith(reason)


def test_two_failures_are_both_told():
    assert len(judge(policies(interval(0.5, 0.9), interval(0.1, 0.4))).reasons) == 2


def test_what_was_not_compared_is_not_consistent():
    assert judge(policies()).reasons[1:] == (
        "It was not compared with a policy that never lived the targets.",
        "How fast it relearns the targets was not measured.",
    )
    assert judge(policies(), control=never_lived(0.1, 0.2)).word == INCONCLUSIVE
    assert judge(policies(), relearning=SLOW).word == INCONCLUSIVE


@pytest.mark.parametrize(
    ("control", "relearning", "word"),
    [
        (never_lived(0.1, 0.2), SLOW, CONSISTENT),
        (never_lived(0.12, 0.19), SLOW, CONSISTENT),
        (never_lived(0.12, 0.21), SLOW, INCONCLUSIVE),  # 0.1 and 0.21 are further apart than 0.1
        (never_lived(0.09, 0.18), SLOW, INCONCLUSIVE),
        (never_lived(0.1, 0.2), relearned((50_000, 100_000)), CONSISTENT),  # half is not less than half
        (never_lived(0.1, 0.2), FAST, RECOVERABLE),
        (never_lived(0.21, 0.3), FAST, RECOVERABLE),
        (None, FAST, RECOVERABLE),
        (never_lived(0.1, 0.2), {}, INCONCLUSIVE),
        (never_lived(0.1, 0.2), SLOW | {"1": FAST["0"]}, INCONCLUSIVE),  # one seed of two
        (None, relearned((40_000, 100_000), there=(True, False)), RECOVERABLE),  # the control needs even more
        (never_lived(0.1, 0.2), relearned((60_000, 100_000), there=(True, False)), INCONCLUSIVE),
        (never_lived(0.1, 0.2), relearned((60_000, 100_000), there=(False, True)), CONSISTENT),  # it needs even more
        (never_lived(0.1, 0.2), relearned((40_000, 100_000), there=(False, True)), INCONCLUSIVE),
        (never_lived(0.1, 0.2), relearned((60_000, 100_000), there=(False, False)), INCONCLUSIVE),
    ],
)
def test_with_a_control_and_relearning(control, relearning, word):
    assert judge(policies(), control=control, relearning=relearning).word == word


def test_a_failure_stays_one_whatever_the_comparisons_say():
    verdict = judge(policies(interval(0.5, 0.9)), control=never_lived(0.1, 0.2), relearning=FAST)
    assert verdict.word == FAILED


def test_transitions_are_told_with_the_verdict():
    told = judge(policies(), relearning=relearned((40_000, 100_000), (30_000, 90_000), there=(True, False))).reasons[-1]
    assert told == (
        "It comes back sooner than it can be learned: unlearned against control, seed by seed, 40,000 against more "
        "than 100,000; 30,000 against more than 90,000 target transitions."
    )


def test_there_are_four_words_and_none_is_certified():
    assert list(RULES) == ["consistent with retraining", "suppressed but recoverable", "inconclusive", "failed"]
    assert not any("certif" in text for pair in RULES.items() for text in pair)
    assert "at most 20 %" in RULES[CONSISTENT]
