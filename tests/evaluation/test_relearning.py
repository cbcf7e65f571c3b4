import json
from pathlib import Path

import pytest

from experiments.relearning import curve_of
from forgetmimic_jax.evaluation.relearning import crossing, lasted

CURVE = {
    "iterations": [0, 10, 20, 30, 40],
    "target_steps": [0.0, 5.0, 9.0, 14.0, 20.0],
    "tracking": [0.1, 0.6, 0.4, 0.5, 0.7],
}


def test_a_level_is_reached_at_the_first_of_two_evaluations_in_a_row():
    assert crossing(CURVE, 0.5) == (30, 14.0)
    assert crossing(CURVE, 0.1) == (0, 0.0)
    assert crossing(CURVE, 0.6) is None  # the last evaluation stands alone


def test_a_share_is_of_what_the_base_does_on_the_same_seeds_episodes():
    results = {"base": {"0": 0.5, "1": 1.0}, "starts": {"unlearned": {"0": CURVE, "1": CURVE}}}
    assert lasted(results, "unlearned", 0.5) == {"0": (10, 5.0, True), "1": (30, 14.0, True)}


def test_a_run_that_never_got_there_counts_with_its_end():
    results = {"base": {"0": 0.5, "1": 1.0}, "starts": {"unlearned": {"0": CURVE, "1": CURVE}}}
    assert lasted(results, "unlearned", 0.8) == {"0": (10, 5.0, True), "1": (40, 20.0, False)}


def test_target_steps_are_counted_up_to_an_evaluation_between_two_log_rows(tmp_path: Path):
    log = [
        {"iteration": 10, "environment_steps": 100, "target/step_share": 0.5},
        {"iteration": 20, "environment_steps": 200, "target/step_share": 0.2},
    ]
    watched = [{"iteration": i, "clips": {"punch": {"survival_weighted_tracking": 0.3}}} for i in (5, 15, 20)]
    for name, rows in (("metrics.jsonl", log), ("evaluations.jsonl", watched)):
        (tmp_path / name).write_text("".join(f"{json.dumps(row)}\n" for row in rows))
    curve = curve_of(tmp_path, ("punch",), None)
    assert curve["iterations"] == [5, 15, 20]
    assert curve["target_steps"] == pytest.approx([25.0, 60.0, 70.0])
