"""The figure takes of each attack what brought back most."""

import pytest
from invented_evidence import compared, evidence, numbers

from forgetmimic_jax.attacks.figure import draw, what_brought_it_back


def test_of_several_variants_the_one_that_brought_most_is_shown():
    changes = {
        "near_duplicates__families__punch, speed": compared(0.4, 0.2),
        "numerics__changes__int8": {"punch": {"unlearned": numbers(0.3, 0.3, 0.2)}},
        "recovery__after__kick": compared(0.1, 0.3),
    }
    found = what_brought_it_back(evidence(**changes))
    assert list(found) == [
        "as it is:\npunch",
        "near-duplicates:\npunch, speed",
        "fine-tuned on kept\nclips: punch",
        "relearning, equal\ntarget steps (tracking)",
        "weights in\nint8: punch",
    ]
    assert found["near-duplicates:\npunch, speed"]["unlearned"].skill.mean == 0.4
    relearned = found["relearning, equal\ntarget steps (tracking)"]
    # Where the unlearned policy's training ends, at 90,000 target steps, it tracks 0.75 and the control, which needs
    # 100,000, 0.1 + 0.8 * 0.65 = 0.62, of the base's 0.8.
    assert relearned["unlearned"].skill.mean == pytest.approx(0.75 / 0.8)
    assert relearned["control"].skill.mean == pytest.approx(0.62 / 0.8)


def test_the_figure_has_a_bar_for_each_policy():
    skill, content = draw(evidence()).axes
    assert [len(bars) for bars in skill.containers if hasattr(bars, "patches")] == [5, 5, 5]
    assert skill.containers[1].patches[0].get_height() == 0.05
    assert content.get_ylabel() == "motion content on the targets"
