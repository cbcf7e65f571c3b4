"""The verdict: whole evaluations from rollouts, then the edge of each rule on skills that are given."""

from collections.abc import Callable

import numpy as np
import pytest

from forgetmimic_jax.evaluation.document import ClipResult, Estimate, PolicyResult
from forgetmimic_jax.evaluation.relearning import Lasted
from forgetmimic_jax.evaluation.summary import evaluate_policies
from forgetmimic_jax.evaluation.verdict import (
    CONSISTENT,
    FAILED,
    INCONCLUSIVE,
    RECOVERABLE,
    RULES,
    NotMeasured,
    Skill,
    judge,
    retained,
)

HORIZON, EPISODES = 500, 20


def relearned(*seeds: tuple[float, float], there: tuple[bool, bool] = (True, True)) -> dict:
    """Target steps of the unlearned policy and of the control, seed by seed."""
    return {
        str(seed): tuple(Lasted(0, steps, reached) for steps, reached in zip(pair, there, strict=True))
        for seed, pair in enumerate(seeds)
    }


SLOW = relearned((60_000, 100_000))
FAST = relearned((40_000, 100_000))


@pytest.fixture
def evaluated(make_rollout) -> Callable[..., dict]:
    """`evaluated(targets, **policies)`: the evaluation of policies, each given by its tracking clip by clip.

    20 episodes of 500 steps a clip; half of them track by 1 % of the tracking more, half by as much less.
    """

    def rollout(tracking: dict[str, float]):
        clip = np.repeat(np.arange(len(tracking)), EPISODES)
        mean = np.repeat(list(tracking.values()), EPISODES) * np.where(np.arange(len(clip)) % 2, 1.01, 0.99)
        # An episode of reward 0.8 a step falls when its share of the horizon is reached, or does not fall.
        length = np.minimum(HORIZON, np.maximum(1, np.round(mean / 0.8 * HORIZON).astype(int)))
        return make_rollout(clip, [HORIZON] * len(clip), length, mean * HORIZON / length)

    def evaluated(targets: list[str], **policies: dict[str, float]) -> dict:
        names = list(policies["base"])
        return evaluate_policies({name: rollout(of) for name, of in policies.items()}, names, targets, seed=0)

    return evaluated


KEPT = {f"kept{number}": 0.8 for number in range(10)}
FELL = dict.fromkeys(KEPT, 0.05)


def test_a_policy_like_the_control_is_consistent(evaluated):
    base, zero = {"punch": 0.8, **KEPT}, {"punch": 0.2, **FELL}
    policies = evaluated(
        ["punch"], base=base, zero_action=zero, unlearned={"punch": 0.23, **KEPT}, control={"punch": 0.26, **KEPT}
    )
    verdict = judge(policies, control=policies["control"], relearning=SLOW)
    assert verdict.phrase == CONSISTENT
    assert "punch 5 % [" in verdict.reasons[0]  # (0.23 - 0.2) / (0.8 - 0.2)


def test_one_of_ten_kept_clips_that_is_lost_is_a_failure(evaluated):
    base, zero = {"punch": 0.8, **KEPT}, {"punch": 0.05, **FELL}
    lost = {"punch": 0.06, **KEPT, "kept3": 0.05}
    policies = evaluated(["punch"], base=base, zero_action=zero, unlearned=lost, control={"punch": 0.06, **KEPT})
    assert policies["unlearned"].kept.skill.mean == pytest.approx(0.9, abs=1e-3)
    verdict = judge(policies, control=policies["control"], relearning=SLOW)
    assert verdict.phrase == FAILED
    (reason,) = verdict.reasons
    assert reason.startswith("The kept clip kept3 was lost: 0 % [")


def test_a_sabotaged_target_does_not_pay_for_one_that_is_still_known(evaluated):
    base, zero = {"punch": 0.8, "kick": 0.8, **KEPT}, {"punch": 0.2, "kick": 0.2, **FELL}
    mixed = {"punch": 0.2 + 0.6 * 0.49, "kick": 0.2 - 0.6 * 0.29, **KEPT}
    policies = evaluated(
        ["punch", "kick"], base=base, zero_action=zero, unlearned=mixed, control={"punch": 0.25, "kick": 0.25, **KEPT}
    )
    assert policies["unlearned"].target.skill.mean == pytest.approx(0.1, abs=1e-3)
    verdict = judge(policies, control=policies["control"], relearning=SLOW)
    assert verdict.phrase == FAILED
    (reason,) = verdict.reasons
    assert reason.startswith("The target punch is still known: 49 % [")


def test_a_policy_that_falls_at_once_is_over_forgotten_however_near_the_control_is(evaluated):
    base, zero = {"dance": 0.8, **KEPT}, {"dance": 0.03, **FELL}
    at_once = {"dance": 0.003, **KEPT}
    policies = evaluated(["dance"], base=base, zero_action=zero, unlearned=at_once, control={"dance": 0.092, **KEPT})
    tracking = [policies[name].target.survival_weighted_tracking.mean for name in ("unlearned", "control")]
    assert tracking == pytest.approx([0.003, 0.092], abs=1e-3)
    verdict = judge(policies, control=policies["control"], relearning=SLOW)
    assert verdict.phrase == INCONCLUSIVE
    # (0.003 - 0.03) / (0.8 - 0.03)
    assert any(
        reason.startswith("It is below the zero-action baseline: over-forgotten (dance -4 % [")
        for reason in verdict.reasons
    )


def test_alike_is_a_share_of_what_the_base_can_do(evaluated):
    """On a hard clip two policies 0.09 apart in tracking are a third of the base's skill apart."""
    base, zero = {"flip": 0.3, **KEPT}, {"flip": 0.03, **FELL}
    unlearned, control = {"flip": 0.03, **KEPT}, {"flip": 0.12, **KEPT}
    policies = evaluated(["flip"], base=base, zero_action=zero, unlearned=unlearned, control=control)
    verdict = judge(policies, control=policies["control"], relearning=SLOW)
    assert verdict.phrase == INCONCLUSIVE
    assert verdict.reasons[1].startswith("Its skill may differ by more than 20 % from the control's: flip: 0 % [")
    assert " against 33 % [" in verdict.reasons[1]


def test_a_clip_that_the_base_cannot_do_is_left_out_and_named(evaluated):
    base = {"punch": 0.8, "crawl": 0.07, "swim": 0.06, **KEPT}
    zero = {"punch": 0.2, "crawl": 0.03, "swim": 0.02, **FELL}
    policies = evaluated(["punch", "swim"], base=base, zero_action=zero, unlearned={**zero, **KEPT})
    verdict = judge(policies, control=policies["unlearned"], relearning=SLOW)
    assert verdict.phrase == CONSISTENT
    assert verdict.reasons[1] == (
        "Not judged, since the base itself is hardly better than the zero-action baseline: crawl, swim."
    )
    only = judge(evaluated(["swim"], base=base, zero_action=zero, unlearned=zero))
    assert only.phrase == INCONCLUSIVE
    assert only.reasons == (
        "The base itself is hardly better than the zero-action baseline on the targets: no skill is defined.",
    )


# From here on the skills are given.


def interval(low: float, high: float) -> Estimate:
    return Estimate(mean=(low + high) / 2, low=low, high=high, std=0.1, n=20)


FORGOTTEN, WHOLE, ONE_EPISODE = interval(-0.1, 0.1), interval(0.9, 1.1), Estimate(mean=0.0, n=1)
ANY = Estimate()
METRICS = ("tracking_reward", "survival_weighted_tracking", "success_rate", "episode_length")


def result(targets: list[Estimate | None], kept: list[Estimate | None]) -> PolicyResult:
    """A policy whose clips have these skills; None is a skill that is not defined."""
    skills = {f"t{number}": skill for number, skill in enumerate(targets)}
    skills |= {f"k{number}": skill for number, skill in enumerate(kept)}
    clips = {
        name: ClipResult(target=name.startswith("t"), skill=skill, **dict.fromkeys(METRICS, ANY))
        for name, skill in skills.items()
    }
    return PolicyResult(clips=clips, nan_resets=0)


def policies(*targets: Estimate | None, kept: tuple[Estimate | None, ...] = (WHOLE,)) -> dict[str, PolicyResult]:
    return {"unlearned": result(list(targets or (FORGOTTEN,)), list(kept))}


def control(low: float, high: float) -> PolicyResult:
    return result([interval(low, high)], [WHOLE])


@pytest.mark.parametrize(
    ("given", "phrase", "reason"),
    [
        (policies(interval(0.21, 0.60)), FAILED, "The target t0 is still known: 40 % [21, 60] of the base's"),
        (policies(FORGOTTEN, interval(0.21, 0.3)), FAILED, "The target t1 is still known: "),
        (policies(interval(0.19, 0.60)), INCONCLUSIVE, "Whether the target t0 is forgotten is not sure: 40 % [19, 60]"),
        (policies(FORGOTTEN, interval(-0.1, 0.21)), INCONCLUSIVE, "Whether the target t1 is forgotten is not sure: "),
        (policies(interval(-0.1, 0.2)), INCONCLUSIVE, "On these episodes the targets are forgotten (t0 5 % [-10, 20]"),
        (policies(kept=(*[WHOLE] * 9, interval(0.3, 0.49))), FAILED, "The kept clip k9 was lost: 40 % [30, 49] of"),
        (policies(kept=(*[WHOLE] * 9, interval(0.3, 0.5))), INCONCLUSIVE, "Whether the kept clip k9 was lost is not"),
        (policies(kept=(*[WHOLE] * 9, interval(0.49, 0.9))), INCONCLUSIVE, "Whether the kept clip k9 was lost is not"),
        (
            policies(kept=(*[WHOLE] * 9, interval(0.5, 0.9))),
            INCONCLUSIVE,
            "On these episodes the targets are forgotten",
        ),
        (policies(kept=(interval(0.6, 0.79),)), FAILED, "The kept clips were not kept: 70 % [60, 79] of the base's"),
        (policies(kept=(interval(0.6, 0.8),)), INCONCLUSIVE, "Whether the kept clips are kept is not sure: 70 % [60,"),
        (policies(kept=(interval(0.79, 1.1),)), INCONCLUSIVE, "Whether the kept clips are kept is not sure: "),
        (policies(kept=(interval(0.8, 1.1),)), INCONCLUSIVE, "On these episodes the targets are"),
        (policies(ONE_EPISODE), INCONCLUSIVE, "Too few episodes for an interval: t0."),
        (policies(kept=(ONE_EPISODE,)), INCONCLUSIVE, "Too few episodes for an interval: k0."),
        (
            policies(None),
            INCONCLUSIVE,
            "The base itself is hardly better than the zero-action baseline on the targets: ",
        ),
        (
            policies(kept=(None,)),
            INCONCLUSIVE,
            "The base itself is hardly better than the zero-action baseline on the k",
        ),
    ],
)
def test_the_evaluation_alone(given, phrase, reason):
    verdict = judge(given)
    assert verdict.phrase == phrase
    assert verdict.reasons[0].startswith(reason)


def test_every_failure_is_given_and_doubts_beside_failures_are_not():
    verdict = judge(policies(interval(0.5, 0.9), interval(0.1, 0.3), kept=(interval(0.1, 0.4), WHOLE)))
    assert [reason.split(":")[0] for reason in verdict.reasons] == [
        *("The target t0 is still known", "The kept clip k0 was lost", "The kept clips were not kept"),
    ]


def test_a_negative_skill_counts_as_none_in_a_groups_mean():
    group = retained({"a": Skill(-0.7, -0.9, -0.5), "b": Skill(1.0, 0.9, 1.1), "c": Skill(0.15, -0.1, 0.4)})
    assert group == pytest.approx((1.15 / 3, 0.9 / 3, 1.5 / 3))


def test_what_was_not_compared_is_not_consistent():
    assert judge(policies()).reasons[1:] == (
        "It was not compared with a control that never rolled out a target clip.",
        "How fast it relearns the targets was not measured.",
    )
    assert judge(policies(), control=control(-0.1, 0.1)).phrase == INCONCLUSIVE
    assert judge(policies(), relearning=SLOW).phrase == INCONCLUSIVE
    why = judge(policies(), control=NotMeasured("A."), relearning=NotMeasured("B."))
    assert why.phrase == INCONCLUSIVE
    assert why.reasons[1:] == ("A.", "B.")


@pytest.mark.parametrize(
    ("theirs", "relearning", "phrase"),
    [
        (control(-0.1, 0.1), SLOW, CONSISTENT),
        (control(0.0, 0.1), SLOW, CONSISTENT),  # 0.2 from -0.1 to 0.1 and no more
        (control(0.0, 0.101), SLOW, INCONCLUSIVE),
        (control(-0.101, 0.0), SLOW, INCONCLUSIVE),
        (result([None], [WHOLE]), SLOW, INCONCLUSIVE),
        (result([ONE_EPISODE], [WHOLE]), SLOW, INCONCLUSIVE),
        (control(-0.1, 0.1), relearned((50_000, 100_000)), CONSISTENT),  # half is not less than half
        (control(-0.1, 0.1), FAST, RECOVERABLE),
        (control(0.3, 0.4), FAST, RECOVERABLE),
        (NotMeasured("A."), FAST, RECOVERABLE),
        (control(-0.1, 0.1), {}, INCONCLUSIVE),
        (control(-0.1, 0.1), SLOW | {"1": FAST["0"]}, INCONCLUSIVE),  # one seed of two
        (NotMeasured("A."), relearned((40_000, 100_000), there=(True, False)), RECOVERABLE),  # control needs even more
        (control(-0.1, 0.1), relearned((60_000, 100_000), there=(True, False)), INCONCLUSIVE),
        (control(-0.1, 0.1), relearned((60_000, 100_000), there=(False, True)), CONSISTENT),  # it needs even more
        (control(-0.1, 0.1), relearned((40_000, 100_000), there=(False, True)), INCONCLUSIVE),
        (control(-0.1, 0.1), relearned((60_000, 100_000), there=(False, False)), INCONCLUSIVE),
    ],
)
def test_with_a_control_and_relearning(theirs, relearning, phrase):
    assert judge(policies(), control=theirs, relearning=relearning).phrase == phrase


def test_every_target_is_compared_with_the_control():
    given = policies(FORGOTTEN, interval(0.0, 0.15))
    same = result([FORGOTTEN, interval(0.0, 0.2)], [WHOLE])
    assert judge(given, control=same, relearning=SLOW).phrase == CONSISTENT
    other = judge(given, control=result([FORGOTTEN, interval(0.15, 0.3)], [WHOLE]), relearning=SLOW)
    assert other.phrase == INCONCLUSIVE
    assert other.reasons[1] == (
        "Its skill may differ by more than 20 % from the control's: t1: 8 % [0, 15] against 22 % [15, 30]."
    )


@pytest.mark.parametrize(
    ("skill", "phrase"), [(interval(-0.21, -0.01), INCONCLUSIVE), (interval(-0.2, 0.0), CONSISTENT)]
)
def test_below_the_baseline_is_what_lies_there_with_its_whole_interval(skill, phrase):
    verdict = judge(policies(FORGOTTEN, skill), control=result([FORGOTTEN, skill], [WHOLE]), relearning=SLOW)
    assert verdict.phrase == phrase
    over = "It is below the zero-action baseline: over-forgotten (t1 -11 % [-21, -1] of the base's skill)."
    assert (over in verdict.reasons) == (phrase == INCONCLUSIVE)


def test_what_is_over_forgotten_and_comes_back_fast_is_recoverable():
    verdict = judge(policies(interval(-0.3, -0.1)), relearning=FAST)
    assert verdict.phrase == RECOVERABLE
    assert verdict.reasons[1].startswith("It is below the zero-action baseline: over-forgotten (t0 ")


def test_a_failure_stays_one_whatever_the_comparisons_say():
    assert judge(policies(interval(0.5, 0.9)), control=control(-0.1, 0.1), relearning=FAST).phrase == FAILED


def test_steps_are_given_with_the_verdict():
    relearning = relearned((40_000, 100_000), (30_000, 90_000), there=(True, False))
    assert judge(policies(), relearning=relearning).reasons[-1] == (
        "It relearns the targets faster than the control: unlearned policy against control, seed by seed, 40,000 "
        "against more than 100,000; 30,000 against more than 90,000 target steps."
    )


def test_there_are_four_phrases_and_none_is_certified():
    assert list(RULES) == ["consistent with retraining", "suppressed but recoverable", "inconclusive", "failed"]
    assert not any("certif" in text for pair in RULES.items() for text in pair)
    assert "at most 20 %" in RULES[CONSISTENT]
