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

# 100 evaluations; phases end at 50, 70 and 90 of them at the latest; patience 2.
RULES = PretrainConfig(patience=2, gain=0.01, specialist_evaluations=4)
CONFIG = dataclasses.replace(Config(), iterations=1000, evaluate_every=10, pretrain=RULES)
START = Curriculum({name: ClipProgress() for name in ("walk", "kick", "flip")})


def found(walk: float, kick: float, flip: float, success: tuple[float, ...] | None = None) -> dict[str, Measured]:
    """An evaluation with these trackings; without `success`, a clip is completed as often as 1.2 times its tracking."""
    trackings = {"walk": walk, "kick": kick, "flip": flip}
    successes = [min(1.0, 1.2 * tracking) for tracking in trackings.values()] if success is None else success
    return {
        name: Measured(success=rate, tracking=tracking, steps=100.0 * tracking)
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


STALL = [found(0.85, 0.5, 0.1), found(0.8, 0.5, 0.1), found(0.86, 0.5, 0.1)]  # mean 0.4833, then no 0.4933
LAGGING = after(START, *STALL)


def test_a_clips_state_follows_its_success_and_its_progress():
    clip = ClipProgress()
    states = []
    for success, tracking in [(0, 0.1), (0, 0.3), (0.2, 0.305), (0.2, 0.31), (0.2, 0.31), (0.9, 0.31), (0.5, 0.4)]:
        clip = clip.after(RULES, Measured(success, tracking))
        states.append(clip.state(RULES))
    # The third rise is too small; the fourth is of 0.01 in two evaluations; the last two end a stall of one.
    assert states == ["new", "new", "learning", "learning", "learning", "mastered", "learning"]
    assert (clip.record, clip.stalled) == (0.4, 0)
    stuck = clip.after(RULES, Measured(0.5, 0.40)).after(RULES, Measured(0.5, 0.405))
    assert (stuck.state(RULES), stuck.stalled) == ("stuck", 2)


def test_broad_ends_when_the_mean_tracking_makes_no_progress():
    rising = [found(0.1 * number, 0.05 * number, 0.1) for number in range(1, 8)]
    assert phases(START, *rising) == ["broad"] * 7
    assert phases(START, *STALL) == ["broad", "broad", "lagging"]


def test_broad_ends_at_half_of_the_iterations_even_with_progress():
    rising = [found(0.2 + 0.012 * number, 0.1 + 0.012 * number, 0.1) for number in range(50)]
    assert phases(START, *rising)[-2:] == ["broad", "lagging"]


def test_the_best_policy_is_the_one_with_the_highest_mean_tracking():
    assert LAGGING.best.number == 3
    assert LAGGING.best.tracking == pytest.approx((0.86 + 0.5 + 0.1) / 3)
    worse = after(LAGGING, found(0.2, 0.6, 0.1), first=4)
    assert worse.best == LAGGING.best


def test_where_every_clip_is_mastered_only_settling_is_left():
    perfect = found(0.8, 0.8, 0.8, (0.9, 1.0, 0.95))
    assert phases(START, perfect, perfect, perfect) == ["broad", "broad", "settle"]


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


def test_lagging_ends_when_every_clip_is_mastered_or_stuck():
    curve = [found(0.86, 0.5, 0.1), found(0.86, 0.505, 0.1)]
    assert phases(LAGGING, *curve, first=4) == ["lagging", "stuck kick"]
    curve = [found(0.86, 0.5, 0.1), found(0.86, 0.6, 0.1), found(0.86, 0.78, 0.1), found(0.86, 0.78, 0.1)]
    assert phases(LAGGING, *curve, first=4) == ["lagging", "lagging", "stuck flip", "stuck flip"]


STUCK = after(LAGGING, found(0.86, 0.5, 0.1), found(0.86, 0.505, 0.1), first=4)


def test_a_specialist_gets_one_clip_and_starts_from_the_best():
    assert STUCK.specialists == ("kick", "flip")
    assert (STUCK.stage, STUCK.longest) == (2, 4)
    settings = settings_of(CONFIG, STUCK)
    assert settings.starts == (0.0, 1.0, 0.0)
    assert settings.best_kl == (0.0, 0.0, 0.0)
    assert STUCK.clips["kick"] == ClipProgress(STUCK.best.clips["kick"], STUCK.best.clips["kick"].tracking, 0, True)


def test_a_specialist_ends_with_its_clip_mastered_stuck_or_its_time():
    assert phases(STUCK, found(0.3, 0.8, 0.0), first=6) == ["stuck flip"]
    no_progress = [found(0.3, 0.5, 0.0), found(0.3, 0.5, 0.0)]
    assert phases(STUCK, *no_progress, first=6) == ["stuck kick", "stuck flip"]
    slow = [found(0.3, 0.52 + 0.02 * number, 0.0) for number in range(4)]
    assert phases(STUCK, *slow, first=6) == ["stuck kick"] * 3 + ["stuck flip"]
    assert phases(STUCK, *no_progress, *no_progress, first=6)[-1] == "settle"  # no expert: nothing to distil


def test_a_specialists_evaluation_says_nothing_of_other_clips():
    now = after(STUCK, found(0.1, 0.55, 0.0), first=6)
    assert now.clips["walk"].last.tracking == 0.86
    assert now.states(RULES) == {"walk": "mastered", "kick": "learning", "flip": "stuck"}
    assert now.best == STUCK.best


def test_an_expert_is_the_specialist_that_tracks_its_clip_best():
    now = after(STUCK, found(0.1, 0.51, 0.0), first=6)
    assert now.experts == {}  # no clear gain over the best policy's 0.505
    now = after(STUCK, found(0.1, 0.6, 0.0), found(0.1, 0.55, 0.0), first=6)
    assert now.experts["kick"].number == 6
    now = after(now, found(0.1, 0.7, 0.0), first=8)
    assert now.experts["kick"].number == 8


def test_an_expert_that_the_best_policy_reaches_is_none():
    now = after(STUCK, found(0.1, 0.6, 0.0), first=6)
    now = after(now, found(0.9, 0.65, 0.1), first=7)
    assert now.best.number == 7
    assert now.experts == {}


def test_experts_are_distilled_and_the_rest_lags_again():
    curve = [found(0.3, 0.8, 0.0), found(0.3, 0.5, 0.1), found(0.3, 0.5, 0.1)]
    distil = after(STUCK, *curve, first=6)
    assert (distil.phase, set(distil.experts)) == ("distil", {"kick"})
    lagging = advance(CONFIG, distil, found(0.86, 0.79, 0.1), 80)
    assert (lagging.phase, lagging.experts, lagging.best.number) == ("lagging", {}, 9)
    assert settings_of(CONFIG, lagging).best_kl == (RULES.best_kl, RULES.best_kl, 0.0)


def test_where_it_is_too_late_for_lagging_specialists_come_again_until_there_is_no_time_left():
    distil = after(STUCK, found(0.3, 0.8, 0.0), found(0.3, 0.5, 0.1), found(0.3, 0.5, 0.1), first=6)
    again = advance(CONFIG, distil, found(0.86, 0.79, 0.1), 700)
    assert (again.phase, again.specialists, again.experts) == ("stuck", ("flip",), {})
    assert advance(CONFIG, distil, found(0.86, 0.95, 0.95), 700).phase == "settle"
    assert advance(CONFIG, distil, found(0.86, 0.79, 0.1), 900).phase == "settle"


def test_specialists_share_the_time_that_is_left():
    late = dataclasses.replace(LAGGING, stage=9)
    now = advance(CONFIG, late, found(0.86, 0.6, 0.2), 700)  # lagging ends here; 20 evaluations until 90 %
    assert (now.phase, now.longest) == ("stuck", 4)
    now = advance(CONFIG, dataclasses.replace(LAGGING), found(0.86, 0.6, 0.2), 850)
    assert (now.phase, now.longest) == ("stuck", 2)
    now = advance(CONFIG, LAGGING, found(0.86, 0.6, 0.2), 900)
    assert now.phase == "settle"


def test_settling_lasts_a_tenth_and_its_kl_falls_to_nothing():
    now = dataclasses.replace(LAGGING, phase="settle", evaluations=0)
    kl = []
    for number in range(10):
        kl.append(settings_of(CONFIG, now).target_kl)
        assert settings_of(CONFIG, now).best_kl == (RULES.best_kl,) * 3
        assert now.phase == "settle"
        now = advance(CONFIG, now, found(0.86, 0.6, 0.2), 910 + 10 * number)
    assert now.phase == "done"
    assert kl == pytest.approx([RULES.target_kl * (0.1 * left) ** 2 for left in range(10, 0, -1)])


def test_a_curriculum_is_plain_values():
    curve = after(STUCK, found(0.1, 0.6, 0.0), first=6)
    text = json.dumps(msgspec.to_builtins(curve))
    assert msgspec.convert(json.loads(text), Curriculum) == curve
    assert isinstance(curve.experts["kick"], Kept)
