from forgetmimic_jax.evaluation.relearning import crossing, crossings, lasted

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
    assert crossings(results, "unlearned", 0.8) == [(10, 5.0), None]
    assert crossings(results, "unlearned", 0.4) == [(10, 5.0), (10, 5.0)]


def test_a_run_that_never_got_there_counts_with_its_end():
    results = {"base": {"0": 0.5, "1": 1.0}, "starts": {"unlearned": {"0": CURVE, "1": CURVE}}}
    assert lasted(results, "unlearned", 0.8) == {"0": (10, 5.0, True), "1": (40, 20.0, False)}
