"""Numbers of policies on the same episodes, by hand."""

import numpy as np
import pytest

from forgetmimic_jax.attacks.document import Numbers, read_evidence, write_document
from forgetmimic_jax.attacks.performance import Performance, by_clip, compare, not_followed, over_seeds


def performance(**tracking: list[float]) -> Performance:
    """Four episodes of four steps, two of each clip; a policy tracks by one number in every step of an episode.

    The reference is 0.2 m away from the stand in the first two steps, and 0.1 m in the others. A robot is away from
    the reference by half of that, but for the base, which is on it.
    """
    series = {name: np.tile(np.array(values)[:, None], (1, 4)) for name, values in tracking.items()}
    movement = np.tile([0.04, 0.04, 0.01, 0.01], (4, 1))
    return Performance(
        names=("a", "b"),
        clip=np.array([0, 0, 1, 1]),
        start_frame=np.zeros(4, int),
        horizon=np.full(4, 4),
        length={name: np.full(4, 4) for name in tracking},
        tracking=series,
        deviation={name: movement * (0.0 if name == "base" else 0.25) for name in tracking},
        movement=movement,
    )


@pytest.fixture
def measured() -> Performance:
    return performance(
        base=[0.8, 0.8, 0.9, 0.9],
        zero_action=[0.2, 0.2, 0.1, 0.1],
        unlearned=[0.2, 0.4, 0.1, 0.3],
        control=[0.4, 0.4, 0.1, 0.1],
    )


def test_skill_and_what_is_above_the_control(measured):
    found = compare(measured, np.ones(4, bool), against={"unlearned": "control"}, seed=0)
    assert set(found) == {"base", "unlearned", "control"}
    # Means: base 0.85, zero action 0.15, unlearned 0.25, control 0.25.
    assert found["unlearned"].skill.mean == pytest.approx(0.1 / 0.7)
    assert found["unlearned"].skill_above.mean == pytest.approx(0.0)
    assert found["control"].skill_above is None
    assert found["base"].skill.mean == 1.0
    assert found["base"].success.mean == 1.0
    first = compare(measured, measured.of(["a"]), against={"unlearned": "control"}, seed=0)["unlearned"]
    assert first.skill.mean == pytest.approx(0.1 / 0.6)
    assert first.skill_above.mean == pytest.approx(-0.1 / 0.6)
    assert first.skill_above.low <= -0.1 / 0.6 <= first.skill_above.high


def test_each_clip_has_numbers_of_its_own(measured):
    found = by_clip(measured, ["a", "b"], against={"unlearned": "control"}, seed=0)
    # Clip b: base 0.9, zero action 0.1, unlearned 0.2, control 0.1.
    assert found["a"]["unlearned"].skill.mean == pytest.approx(0.1 / 0.6)
    assert found["b"]["unlearned"].skill.mean == pytest.approx(0.1 / 0.8)
    assert found["b"]["unlearned"].skill_above.mean == pytest.approx(0.1 / 0.8)


def test_a_base_that_hardly_beats_the_baseline_has_no_skill_to_retain():
    same = performance(base=[0.23] * 4, zero_action=[0.2] * 4, unlearned=[0.2] * 4)
    found = compare(same, np.ones(4, bool), against={}, seed=0)["unlearned"]
    assert found.skill is None
    assert found.content.mean == pytest.approx(0.75)


def test_motion_content_is_one_minus_deviation_over_movement(measured):
    np.testing.assert_allclose(measured.content("base"), 1.0)
    np.testing.assert_allclose(measured.content("unlearned"), 0.75)
    measured.deviation["unlearned"][0] = [0.04, 0.04, 0.0, 0.0]  # Σ 0.08 of Σ 0.10
    measured.deviation["unlearned"][1] = 1.0  # far away, clipped
    np.testing.assert_allclose(measured.content("unlearned"), [0.2, -1.0, 0.75, 0.75])


def test_motion_content_of_a_part_of_an_episode(measured):
    measured.deviation["unlearned"][0] = [0.04, 0.04, 0.0, 0.005]
    window = np.array([2, 0, 3, 0]), np.array([4, 2, 9, 4])
    np.testing.assert_allclose(measured.content("unlearned", window), [0.75, 0.75, 0.75, 0.75])
    window = np.array([0, 0, 0, 0]), np.array([2, 2, 2, 2])
    np.testing.assert_allclose(measured.content("unlearned", window), [0.0, 0.75, 0.75, 0.75])
    found = compare(measured, measured.of(["a"]), against={}, seed=0, window=window)["unlearned"]
    assert (found.content.mean, found.skill, found.success) == (pytest.approx(0.375), None, None)


def test_what_hardly_moves_has_no_motion_content(measured):
    measured.movement[2:] = 0.0024  # below 0.05² = 0.0025
    np.testing.assert_array_equal(np.isnan(measured.content("unlearned")), [False, False, True, True])
    found = compare(measured, measured.of(["b"]), against={}, seed=0)["unlearned"]
    assert found.content is None
    both = compare(measured, np.ones(4, bool), against={"unlearned": "base"}, seed=0)["unlearned"]
    assert (both.content.mean, both.content.n) == (pytest.approx(0.75), 2)
    assert both.content_above.mean == pytest.approx(-0.25)


def test_a_variant_that_the_base_does_not_follow(measured):
    original = performance(base=[0.9, 0.9, 0.5, 0.7])
    variants = performance(base=[0.4, 0.4, 0.3, 0.3])
    variants = Performance(**{**vars(variants), "names": ("a_fast", "b_fast")})
    names = {"a_fast": "a", "b_fast": "b"}
    assert not_followed(variants, original, names, 0.5) == {"a_fast": pytest.approx(4 / 9)}
    assert not_followed(variants, original, names, 0.51) == {"a_fast": pytest.approx(4 / 9), "b_fast": 0.5}


def test_with_several_seeds_the_seed_is_the_unit(measured):
    one = compare(measured, np.ones(4, bool), against={}, seed=0)
    assert over_seeds([one]) is one
    other = compare(
        performance(base=[0.85] * 4, zero_action=[0.15] * 4, unlearned=[0.39] * 4, control=[0.25] * 4),
        np.ones(4, bool), against={}, seed=0,
    )  # fmt: skip
    found = over_seeds([one, other])["unlearned"]
    low, high = 0.1 / 0.7, 0.24 / 0.7
    assert found.skill.mean == pytest.approx((low + high) / 2)
    assert found.skill.n == 2
    # Student's t with one degree of freedom: 12.706 standard errors, each half of the difference.
    assert found.skill.high - found.skill.mean == pytest.approx(12.706 * (high - low) / 2, rel=1e-3)
    assert found.skill_above is None


def test_a_part_of_a_document_is_written_as_it_is(tmp_path):
    write_document(tmp_path / "new" / "part.json", Numbers())
    assert (tmp_path / "new" / "part.json").read_text() == "{}\n"
    from invented_evidence import evidence

    document = evidence()
    write_document(tmp_path / "evidence.json", document)
    assert read_evidence(tmp_path / "evidence.json") == document
