"""The verdict on an evaluation alone: whole ones from rollouts, then the edge of each rule on skills that are given."""

from collections.abc import Callable

import numpy as np
import pytest

from forgetmimic_jax.attacks.verdict import CONSISTENT, FAILED, INCONCLUSIVE, NOT_ATTACKED, RULES, judge_evaluation
from forgetmimic_jax.evaluation.document import ClipResult, Estimate, PolicyResult
from forgetmimic_jax.evaluation.skill import Skill, retained
from forgetmimic_jax.evaluation.summary import evaluate_policies

HORIZON, EPISODES = 500, 20


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


def test_what_is_forgotten_and_kept_is_inconclusive_since_nothing_attacked_it(evaluated):
    base, zero = {"punch": 0.8, **KEPT}, {"punch": 0.2, **FELL}
    policies = evaluated(["punch"], base=base, zero_action=zero, unlearned={"punch": 0.23, **KEPT})
    verdict = judge_evaluation(policies["unlearned"])
    assert verdict.phrase == INCONCLUSIVE
    assert verdict.reasons[0].startswith("On these episodes the targets are forgotten (punch 5 % [")  # 0.03 / 0.6
    assert verdict.reasons[1:] == (NOT_ATTACKED,)


def test_one_of_ten_kept_clips_that_is_lost_is_a_failure(evaluated):
    base, zero = {"punch": 0.8, **KEPT}, {"punch": 0.05, **FELL}
    lost = {"punch": 0.06, **KEPT, "kept3": 0.05}
    policies = evaluated(["punch"], base=base, zero_action=zero, unlearned=lost)
    assert policies["unlearned"].kept.skill.mean == pytest.approx(0.9, abs=1e-3)
    verdict = judge_evaluation(policies["unlearned"])
    assert verdict.phrase == FAILED
    (reason,) = verdict.reasons
    assert reason.startswith("Lost: the kept clip kept3, 0 % [")


def test_a_sabotaged_target_does_not_pay_for_one_that_is_still_known(evaluated):
    base, zero = {"punch": 0.8, "kick": 0.8, **KEPT}, {"punch": 0.2, "kick": 0.2, **FELL}
    mixed = {"punch": 0.2 + 0.6 * 0.49, "kick": 0.2 - 0.6 * 0.29, **KEPT}
    policies = evaluated(["punch", "kick"], base=base, zero_action=zero, unlearned=mixed)
    assert policies["unlearned"].target.skill.mean == pytest.approx(0.1, abs=1e-3)
    verdict = judge_evaluation(policies["unlearned"])
    assert verdict.phrase == FAILED
    (reason,) = verdict.reasons
    assert reason.startswith("Still known: the target punch, skill 49 % [")


def test_a_policy_that_falls_at_once_is_over_forgotten(evaluated):
    base, zero = {"dance": 0.8, **KEPT}, {"dance": 0.03, **FELL}
    policies = evaluated(["dance"], base=base, zero_action=zero, unlearned={"dance": 0.003, **KEPT})
    verdict = judge_evaluation(policies["unlearned"])
    assert verdict.phrase == INCONCLUSIVE
    # (0.003 - 0.03) / (0.8 - 0.03)
    assert verdict.reasons[0].startswith("Over-forgotten: below the zero-action baseline (dance -4 % [")


def test_a_clip_that_the_base_cannot_do_is_left_out_and_named(evaluated):
    base = {"punch": 0.8, "crawl": 0.07, "swim": 0.06, **KEPT}
    zero = {"punch": 0.2, "crawl": 0.03, "swim": 0.02, **FELL}
    policies = evaluated(["punch", "swim"], base=base, zero_action=zero, unlearned={**zero, **KEPT})
    verdict = judge_evaluation(policies["unlearned"])
    assert verdict.reasons[0].startswith("On these episodes the targets are forgotten (punch 0 % [")
    assert verdict.reasons[-1] == (
        "No skill is defined, since the base itself is hardly better than the zero-action baseline: swim, crawl."
    )
    kept = {**zero, **KEPT, "punch": 0.8}
    only = judge_evaluation(evaluated(["swim"], base=base, zero_action=zero, unlearned=kept)["unlearned"])
    assert "The base itself is hardly better than the zero-action baseline on every target: no skill is defined." in (
        only.reasons
    )


# From here on the skills are given.


def interval(low: float, high: float) -> Estimate:
    return Estimate(mean=(low + high) / 2, low=low, high=high, std=0.1, n=20)


FORGOTTEN, WHOLE, ONE_EPISODE = interval(-0.1, 0.1), interval(0.9, 1.1), Estimate(mean=0.0, n=1)
ANY = Estimate()
METRICS = ("tracking_reward", "survival_weighted_tracking", "success_rate", "episode_length")


def policy(*targets: Estimate | None, kept: tuple[Estimate | None, ...] = (WHOLE,)) -> PolicyResult:
    """A policy whose clips have these skills; None is a skill that is not defined."""
    skills = {f"t{number}": skill for number, skill in enumerate(targets or (FORGOTTEN,))}
    skills |= {f"k{number}": skill for number, skill in enumerate(kept)}
    clips = {
        name: ClipResult(target=name.startswith("t"), skill=skill, **dict.fromkeys(METRICS, ANY))
        for name, skill in skills.items()
    }
    return PolicyResult(clips=clips, nan_resets=0)


NOT_SURE, NOT_KEPT = "Whether this is forgotten is not sure: ", "Whether this is kept is not sure: "
NO_SKILL = "The base itself is hardly better than the zero-action baseline"
NO_DOUBT = "On these episodes the targets are forgotten "


@pytest.mark.parametrize(
    ("given", "phrase", "reason"),
    [
        (policy(interval(0.41, 0.60)), FAILED, "Still known: the target t0, skill 50 % [41, 60]"),
        (policy(FORGOTTEN, interval(0.39, 0.9)), INCONCLUSIVE, f"{NOT_SURE}the target t1, "),
        (policy(interval(0.19, 0.60)), INCONCLUSIVE, f"{NOT_SURE}the target t0, skill 40 % [19, 60]"),
        (policy(FORGOTTEN, interval(-0.1, 0.21)), INCONCLUSIVE, f"{NOT_SURE}the target t1, "),
        (policy(interval(-0.1, 0.2)), INCONCLUSIVE, f"{NO_DOUBT}(t0 5 % [-10, 20]"),
        (policy(kept=(*[WHOLE] * 9, interval(0.3, 0.49))), FAILED, "Lost: the kept clip k9, 40 % [30, 49] of"),
        (policy(kept=(*[WHOLE] * 9, interval(0.3, 0.5))), INCONCLUSIVE, f"{NOT_KEPT}the kept clip k9, "),
        (policy(kept=(*[WHOLE] * 9, interval(0.49, 0.9))), INCONCLUSIVE, f"{NOT_KEPT}the kept clip k9, "),
        (policy(kept=(*[WHOLE] * 9, interval(0.5, 0.9))), INCONCLUSIVE, NO_DOUBT),
        (policy(kept=(interval(0.6, 0.79),)), FAILED, "Lost: the kept clips on average, 70 % [60, 79] of the base's"),
        (policy(kept=(interval(0.6, 0.8),)), INCONCLUSIVE, f"{NOT_KEPT}the kept clips on average, 70 % [60, 80]"),
        (policy(kept=(interval(0.79, 1.1),)), INCONCLUSIVE, f"{NOT_KEPT}the kept clips on average, "),
        (policy(kept=(interval(0.8, 1.1),)), INCONCLUSIVE, NO_DOUBT),
        (policy(ONE_EPISODE), INCONCLUSIVE, f"{NOT_SURE}the target t0, skill 0 % (too few episodes for an interval)."),
        (policy(kept=(ONE_EPISODE,)), INCONCLUSIVE, f"{NOT_KEPT}the kept clip k0, 0 % (too few episodes"),
        (policy(None), INCONCLUSIVE, f"{NO_SKILL} on every target: "),
        (policy(kept=(None,)), INCONCLUSIVE, f"{NO_SKILL} on every kept clip: "),
        (policy(interval(-0.21, -0.01)), INCONCLUSIVE, "Over-forgotten: below the zero-action baseline (t0 -11 % ["),
        (policy(None, kept=(interval(0.1, 0.2),)), FAILED, "Lost: the kept clip k0, "),
        (policy(interval(0.5, 0.9), kept=(None,)), FAILED, "Still known: the target t0, "),
        (policy(interval(-0.2, 0.0)), INCONCLUSIVE, f"{NO_DOUBT}(t0 -10 % [-20, 0]"),
    ],
)  # fmt: skip
def test_the_edges_of_each_rule(given, phrase, reason):
    verdict = judge_evaluation(given)
    assert verdict.phrase == phrase
    assert verdict.reasons[0].startswith(reason)
    assert (NOT_ATTACKED in verdict.reasons) == (phrase == INCONCLUSIVE)


def test_every_failure_is_given_and_doubts_beside_failures_are_not():
    verdict = judge_evaluation(policy(interval(0.5, 0.9), interval(0.1, 0.3), kept=(interval(0.1, 0.4), WHOLE)))
    assert [reason.split(",")[0] for reason in verdict.reasons] == [
        *("Lost: the kept clip k0", "Lost: the kept clips on average", "Still known: the target t0"),
    ]


def test_a_negative_skill_counts_as_none_in_a_groups_mean():
    group = retained({"a": Skill(-0.7, -0.9, -0.5), "b": Skill(1.0, 0.9, 1.1), "c": Skill(0.15, -0.1, 0.4)})
    assert group == pytest.approx((1.15 / 3, 0.9 / 3, 1.5 / 3))


def test_there_are_four_phrases_and_none_is_certified():
    assert list(RULES) == ["consistent with retraining", "suppressed but recoverable", "inconclusive", "failed"]
    assert not any("certif" in text for pair in RULES.items() for text in pair)
    assert "at most 20 %" in RULES[CONSISTENT]
