"""The stop rule on made-up curves: when a run settles, how its step size falls, and that a resume changes nothing."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console

from forgetmimic_jax.settings.config import UnlearnConfig
from forgetmimic_jax.tracking.env import make_assets
from forgetmimic_jax.training import stopping
from forgetmimic_jax.training.course import Position
from forgetmimic_jax.training.stopping import Stopping, retained, settles_from


@pytest.mark.parametrize(
    ("curve", "expected"),
    [
        ([], None),
        ([0.9, 0.5, 0.2, 0.11], None),
        ([0.9, 0.09], None),
        ([0.9, 0.1, 0.1], 60),
        ([0.9, 0.09, 0.11, 0.08, -0.2], 100),  # not in a row, and then it is
        ([-0.1, -0.1, 0.9], 40),  # what comes later changes nothing
        ([float("nan")] * 3, None),  # skill is undefined where the base is no better than zero action
    ],
)
def test_a_run_settles_from_the_second_look_in_a_row_at_the_baseline(curve, expected):
    assert settles_from([(20 * (i + 1), skill) for i, skill in enumerate(curve)]) == expected


def test_a_target_below_the_baseline_does_not_pay_for_another():
    base, zero = np.array([0.9, 0.8, 0.22]), np.array([0.1, 0.2, 0.2])
    # 49 % and -29 %: their mean would be 10 %. The third clip's base is hardly better than the zero action.
    policy = np.array([0.1 + 0.49 * 0.8, 0.2 - 0.29 * 0.6, 0.9])
    assert retained(policy, base, zero) == pytest.approx(0.245)
    assert np.isnan(retained(policy, zero, zero))


@pytest.fixture
def course(tiny_setup, monkeypatch, tmp_path):
    """A course of `turn`, looked at every 5 iterations, whose skill at iteration i is `curve[i]`."""
    unlearn = UnlearnConfig(("turn",), settings={"penalty": 16.0}, stop_every=5)
    ppo = dataclasses.replace(tiny_setup.config.ppo, base_kl=0.1)
    config = dataclasses.replace(tiny_setup.config, iterations=300, evaluate_every=0, unlearn=unlearn, ppo=ppo)
    setup = dataclasses.replace(tiny_setup, config=config)
    looks = []

    class Targets:
        def __init__(self, _setup):
            pass

        def skill(self, iteration: int) -> float:
            looks.append(iteration)
            return {5: 0.9, 10: 0.03}.get(iteration, 0.0)

    monkeypatch.setattr(stopping, "Targets", Targets)

    def course(resumed=None, setup=setup) -> Stopping:
        return Stopping(setup, None, tmp_path, Console(), resumed)

    course.assets, course.looks, course.setup = make_assets(setup), looks, setup
    return course


def through(course: Stopping, assets, start: int, end: int) -> tuple[list[tuple[float, ...]], int]:
    """Share of the step size and KL weights of the two clips, of every iteration from `start`; and the last one."""
    state = SimpleNamespace(policy=start)
    position = course.begin(Position(state, assets, start, 0))
    shares = []
    for iteration in range(start + 1, end + 1):
        if course.finished:
            break
        focus = position.assets.focus
        shares.append((float(focus.settle), *focus.base_kl.tolist()))
        state = SimpleNamespace(policy=iteration)  # a policy that the stand-in for the evaluation knows by its number
        position = course.after(dataclasses.replace(position, state=state, iteration=iteration))
    return shares, position.iteration


def test_the_step_size_falls_to_nothing_over_100_iterations_and_the_run_ends(course):
    shares, end = through(course(), course.assets, 0, 300)
    assert end == 115  # 15 and 100
    assert course.looks == [5, 10, 15]  # at the baseline at 10 and 15
    step_size, on_kept, on_target = zip(*shares, strict=True)
    assert step_size == pytest.approx([1.0] * 15 + [1.0 - i / 100 for i in range(100)])
    assert on_kept == pytest.approx([0.1] * 15 + [0.6] * 100)
    assert set(on_target) == {0.0}


def test_a_run_without_a_kl_to_the_base_settles_without_one(course):
    setup = course.setup
    without = dataclasses.replace(setup.config, ppo=dataclasses.replace(setup.config.ppo, base_kl=0.0))
    resumed = SimpleNamespace(curriculum={"skills": [(5, 0.0), (10, 0.0)]})
    settling = course(resumed, dataclasses.replace(setup, config=without))
    focus = settling.begin(Position(SimpleNamespace(policy=20), course.assets, 20, 0)).assets.focus
    assert (float(focus.settle), focus.base_kl) == (pytest.approx(1.0 - 10 / 100), None)


@pytest.mark.parametrize("stopped", [7, 10, 12, 15, 22, 115])
def test_a_run_that_was_stopped_ends_where_it_would_have(course, stopped):
    whole, end = through(course(), course.assets, 0, 300)
    first = course()
    before, _ = through(first, course.assets, 0, stopped)
    resumed = course(SimpleNamespace(curriculum=first.curriculum))
    after, found = through(resumed, course.assets, stopped, 300)
    assert (before + after, found) == (whole, end)
    assert resumed.note == {"target_skill": 0.0}


def test_before_the_first_look_there_is_no_skill_to_log(course):
    assert course().note == {}
