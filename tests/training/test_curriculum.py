"""The phases of pretraining on made-up curves: which clip gets what, and when a phase ends."""

import dataclasses
import json

import msgspec
import pytest

from forgetmimic_jax.settings.config import Config, PretrainConfig
from forgetmimic_jax.training.curriculum import (
    ClipProgress,
    Curriculum,
    Kept,
    Measured,
    advance,
    settings_of,
    step_shares,
)

# 100 evaluations; phases end at 50 and 70 of them at the latest; patience 2.
RULES = PretrainConfig(patience=2, gain=0.01, mastered=0.9, specialist_evaluations=4)
CONFIG = dataclasses.replace(Config(), iterations=1000, evaluate_every=10, pretrain=RULES)
START = Curriculum({name: ClipProgress() for name in ("walk", "kick", "flip")})


def found(walk: float, kick: float, flip: float, success: tuple[float, ...] | None = None) -> dict[str, Measured]:
    """An evaluation with these trackings; without `success`, a clip is completed as often as 1.2 times its tracking."""
    trackings = {"walk": walk, "kick": kick, "flip": flip}
    successes = [min(1.0, 1.2 * tracking) for tracking in trackings.values()] if success is None else success
    return {
        name: Measured(success=rate, tracking=tracking, steps=100.0 * tracking, completed=rate > 0.0)
        for (name, tracking), rate in zip(trackings.items(), successes, strict=True)
    }


def after(curriculum: Curriculum, *evaluations: dict[str, Measured], first: int = 1) -> Curriculum:
    """The curriculum after evaluations at iterations 10 · first, 10 · (first + 1), ..."""
    for number, evaluation in enumerate(evaluations, first):
        curriculum = advance(CONFIG, curriculum, evaluation, 10 * number)
    return curriculum


def phases(curriculum: Curriculum, *evaluations: dict[str, Measured], first: int = 1) -> list[str]:
    """The phase after each evaluation; of a specialist, with its clip."""
    said = []
    for number, evaluation in enumerate(evaluations, first):
        curriculum = advance(CONFIG, curriculum, evaluation, 10 * number)
        said.append(" ".join(filter(None, (curriculum.phase, curriculum.specialist))))
    return said


STALL = [found(0.85, 0.5, 0.1), found(0.8, 0.5, 0.1), found(0.86, 0.5, 0.1)]  # scores rise by less than 0.01
LAGGING = after(START, *STALL)


def test_a_clips_state_follows_its_success_and_its_progress():
    clip, states = ClipProgress(), []
    for success, tracking, completed in [
        *((0.0, 0.1, False), (0.1, 0.3, False)),  # a late start that reaches the end is no completed clip
        *((0.2, 0.3, True), (0.2, 0.31, True), (0.2, 0.31, True)),  # then two rises of less than 0.01
        *((0.9, 0.31, True), (0.5, 0.4, False)),
    ]:
        clip = clip.after(RULES, Measured(success, tracking, completed=completed))
        states.append(clip.state(RULES))
    assert states == ["new", "new", "learning", "learning", "stuck", "mastered", "learning"]
    assert (clip.record, clip.stalled, clip.completed) == (pytest.approx((0.9 + 0.31) / 2), 1, True)


def test_success_alone_is_progress_too():
    """The kick is tracked as well by a policy that completes it as by one that falls at its end."""
    clip = ClipProgress().after(RULES, Measured(0.85, 0.78)).after(RULES, Measured(0.95, 0.78))
    assert (clip.record, clip.stalled) == (pytest.approx(0.865), 0)


def test_broad_ends_when_the_mean_score_makes_no_progress():
    rising = [found(0.1 * number, 0.05 * number, 0.1) for number in range(1, 8)]
    assert phases(START, *rising) == ["broad"] * 7
    assert phases(START, *STALL) == ["broad", "broad", "lagging"]


def test_broad_ends_at_half_of_the_iterations_even_with_progress():
    rising = [found(0.2 + 0.012 * number, 0.1 + 0.012 * number, 0.1) for number in range(50)]
    assert phases(START, *rising)[-2:] == ["broad", "lagging"]


def test_the_best_policy_is_the_one_with_the_highest_mean_score():
    assert LAGGING.best.number == 3
    # Success is 1.2 times the tracking, at most 1.
    assert LAGGING.best.score == pytest.approx(((0.86 + 1.0) / 2 + 1.1 * 0.5 + 1.1 * 0.1) / 3)
    worse = after(LAGGING, found(0.2, 0.6, 0.1), first=4)
    assert worse.best == LAGGING.best


def test_where_every_clip_is_mastered_the_run_is_done():
    perfect = found(0.8, 0.8, 0.8, (0.9, 1.0, 0.95))
    assert phases(START, found(0.8, 0.8, 0.8, (0.9, 1.0, 0.85)), perfect) == ["broad", "done"]
    assert after(START, perfect).best.number == 1


def test_in_the_broad_phase_failing_clips_get_more_steps_and_short_episodes_more_starts():
    first = settings_of(CONFIG, START)
    assert first.starts == pytest.approx((1 / 3, 1 / 3, 1 / 3))
    assert first.best_kl == (0.0, 0.0, 0.0)
    assert (first.target_kl, first.gae_lambda) == (CONFIG.ppo.target_kl, CONFIG.ppo.gae_lambda)
    one = after(START, found(0.8, 0.5, 0.2))
    # ρ = 0.15 evenly, 0.85 by failures of 0.2, 0.5 and 0.8 of 1.5.
    shares = [0.05 + 0.85 * failure / 1.5 for failure in (0.2, 0.5, 0.8)]
    assert list(step_shares(CONFIG, one).values()) == pytest.approx(shares)
    starts = [share / steps for share, steps in zip(shares, (80, 50, 20), strict=True)]
    assert settings_of(CONFIG, one).starts == pytest.approx([start / sum(starts) for start in starts])


def test_lagging_clips_get_three_quarters_of_the_steps_and_mastered_ones_a_kl():
    assert LAGGING.states(RULES) == {"walk": "mastered", "kick": "learning", "flip": "learning"}
    # Failures 0.5 and 0.9.
    assert step_shares(CONFIG, LAGGING) == pytest.approx(
        {"walk": 0.25, "kick": 0.75 * 0.5 / 1.4, "flip": 0.75 * 0.9 / 1.4}
    )
    settings = settings_of(CONFIG, LAGGING)
    assert settings.best_kl == (RULES.best_kl, 0.0, 0.0)
    assert (settings.target_kl, settings.gae_lambda) == (RULES.target_kl, RULES.gae_lambda)
    # The flip makes no progress: half of its weight. The walk has lapsed: it lags too, and keeps its KL.
    later = after(LAGGING, found(0.6, 0.6, 0.1), first=4)
    weights = {"walk": 0.4 * 0.5, "kick": 0.4, "flip": 0.9 * 0.5}
    even = {name: 0.15 / 3 + 0.85 * failure / 1.7 for name, failure in (("walk", 0.4), ("kick", 0.4), ("flip", 0.9))}
    assert step_shares(CONFIG, later) == pytest.approx(even)  # all clips lag: none to take steps from
    mastered = after(LAGGING, found(0.86, 0.6, 0.1), first=4)
    total = weights["kick"] + weights["flip"]
    assert step_shares(CONFIG, mastered) == pytest.approx(
        {"walk": 0.25, "kick": 0.75 * weights["kick"] / total, "flip": 0.75 * weights["flip"] / total}
    )
    assert settings_of(CONFIG, later).best_kl == (RULES.best_kl, 0.0, 0.0)


def test_lagging_ends_when_the_mean_stalls_or_every_clip_is_mastered_or_stuck():
    same = found(0.86, 0.5, 0.1)
    assert phases(LAGGING, same, found(0.86, 0.505, 0.1), first=4) == ["lagging", "stuck kick"]
    # The flip rises further, and the kick loses as much: no clip of all is better, but the flip has an expert.
    curve = [found(0.86, 0.48, 0.12), found(0.86, 0.46, 0.14), found(0.86, 0.44, 0.16)]
    assert phases(LAGGING, *curve, first=4) == ["lagging", "distil", "stuck kick"]
    rising = [found(0.86, 0.5 + 0.04 * number, 0.1) for number in range(4)]
    assert phases(LAGGING, *rising, first=4) == ["lagging"] * 4
    assert advance(CONFIG, LAGGING, same, 700).phase == "stuck"  # the latest end


def test_the_expert_of_a_clip_is_the_policy_that_did_it_best_if_clearly_better_than_the_best():
    now = after(LAGGING, found(0.2, 0.6, 0.1), found(0.2, 0.61, 0.105), first=4)
    assert {clip: kept.number for clip, kept in now.experts.items()} == {"kick": 5}  # 0.005 of the flip are too few
    assert now.best == LAGGING.best
    better = after(now, found(0.86, 0.608, 0.3), first=6)
    assert (better.best.number, better.experts) == (6, {})


def test_the_best_policy_before_is_the_expert_of_a_clip_that_the_next_one_lost():
    now = after(LAGGING, found(0.6, 0.88, 0.2), first=4)
    assert now.best.number == 4
    assert {clip: kept.number for clip, kept in now.experts.items()} == {"walk": LAGGING.best.number}
    later = after(now, found(0.6, 0.89, 0.2), first=5)
    assert {clip: kept.number for clip, kept in later.experts.items()} == {"walk": LAGGING.best.number}


def test_what_single_policies_did_best_is_distilled_before_any_specialist():
    curve = [found(0.2, 0.7, 0.1), found(0.86, 0.3, 0.3)]
    now = after(LAGGING, *curve, first=4)
    assert (now.phase, {clip: kept.number for clip, kept in now.experts.items()}) == ("distil", {"kick": 4, "flip": 5})
    # The student learned the kick alone, so the flip's specialist starts from the flip's expert.
    now = advance(CONFIG, now, found(0.86, 0.7, 0.1), 50)
    assert (now.phase, now.specialists, now.best.number) == ("stuck", ("kick", "flip"), 6)
    assert now.start == now.best
    now = advance(CONFIG, now, found(0.1, 0.8, 0.1), 60)
    assert (now.specialist, now.start.number) == ("flip", 5)
    assert now.clips["flip"] == ClipProgress(now.start.clips["flip"], now.start.clips["flip"].score, 0, True)


STUCK = after(LAGGING, found(0.86, 0.5, 0.1), found(0.86, 0.505, 0.1), first=4)


def test_a_specialist_gets_one_clip_and_starts_from_the_best():
    assert STUCK.specialists == ("kick", "flip")
    assert (STUCK.stage, STUCK.longest, STUCK.start) == (2, 4, STUCK.best)
    settings = settings_of(CONFIG, STUCK)
    assert settings.starts == (0.0, 1.0, 0.0)
    assert settings.best_kl == (0.0, 0.0, 0.0)
    assert STUCK.clips["kick"] == ClipProgress(STUCK.best.clips["kick"], STUCK.best.clips["kick"].score, 0, True)


def test_a_specialist_ends_with_its_clip_mastered_stuck_or_its_time():
    assert phases(STUCK, found(0.3, 0.8, 0.0), first=6) == ["stuck flip"]
    no_progress = [found(0.3, 0.5, 0.0), found(0.3, 0.5, 0.0)]
    assert phases(STUCK, *no_progress, first=6) == ["stuck kick", "stuck flip"]
    slow = [found(0.3, 0.52 + 0.02 * number, 0.0) for number in range(4)]
    assert phases(STUCK, *slow, first=6) == ["stuck kick"] * 3 + ["stuck flip"]
    assert phases(STUCK, *no_progress, *no_progress, first=6)[-1] == "done"  # no expert: nothing to distil


def test_a_specialists_evaluation_says_nothing_of_other_clips():
    now = after(STUCK, found(0.1, 0.55, 0.0), first=6)
    assert now.clips["walk"].last.tracking == 0.86
    assert now.states(RULES) == {"walk": "mastered", "kick": "learning", "flip": "stuck"}
    assert now.best == STUCK.best


def test_specialists_are_distilled_and_come_again_for_what_is_not_mastered():
    curve = [found(0.3, 0.8, 0.0), found(0.3, 0.5, 0.1), found(0.3, 0.5, 0.1)]
    distil = after(STUCK, *curve, first=6)
    assert (distil.phase, set(distil.experts), distil.start) == ("distil", {"kick"}, STUCK.best)
    again = advance(CONFIG, distil, found(0.86, 0.8, 0.1), 80)
    assert (again.phase, again.specialists, again.experts, again.best.number) == ("stuck", ("flip",), {}, 9)
    assert advance(CONFIG, distil, found(0.86, 0.95, 0.95), 80).phase == "done"
    assert advance(CONFIG, distil, found(0.86, 0.79, 0.1), 1000).phase == "done"  # no time left


def test_a_distillation_that_fails_loses_no_expert():
    distil = after(STUCK, found(0.3, 0.8, 0.0), found(0.3, 0.5, 0.1), found(0.3, 0.5, 0.1), first=6)
    failed = advance(CONFIG, distil, found(0.4, 0.4, 0.1), 80)
    assert (failed.phase, failed.specialists, failed.best) == ("stuck", ("kick", "flip"), STUCK.best)
    assert failed.start == failed.experts["kick"] == distil.experts["kick"]


def test_specialists_share_the_time_that_is_left_as_the_scores_that_are_lacking():
    now = advance(CONFIG, LAGGING, found(0.86, 0.501, 0.1), 940)  # six evaluations; 0.45 and 0.89 are lacking
    assert (now.phase, now.longest) == ("stuck", 2)
    end = advance(CONFIG, now, found(0.3, 0.56, 0.0), 1000)  # a run that is continued may have fewer iterations
    assert (end.phase, set(end.experts)) == ("distil", {"kick"})
    flip = after(now, found(0.3, 0.56, 0.0), found(0.3, 0.6, 0.0), first=95)
    assert (flip.specialist, flip.longest) == ("flip", 4)
    assert advance(CONFIG, LAGGING, found(0.86, 0.501, 0.1), 1000).phase == "done"
    now = advance(CONFIG, LAGGING, found(0.2, 0.6, 0.1), 1000)
    assert now.phase == "distil"  # it takes no iterations


def test_a_curriculum_is_plain_values():
    curve = after(STUCK, found(0.1, 0.6, 0.0), first=6)
    text = json.dumps(msgspec.to_builtins(curve))
    assert msgspec.convert(json.loads(text), Curriculum) == curve
    assert isinstance(curve.experts["kick"], Kept)
