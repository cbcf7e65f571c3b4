"""Whether relearning was faster than the control's: the edge of the rule, then over seeds."""

import msgspec
import pytest
from invented_evidence import curve

from forgetmimic_jax.attacks.document import Relearning
from forgetmimic_jax.attacks.pace import pace, sooner_than_control
from forgetmimic_jax.evaluation.relearning import Lasted


@pytest.mark.parametrize(
    ("steps", "there", "faster"),
    [
        ((40_000, 100_000), (True, True), True),
        ((50_000, 100_000), (True, True), False),  # half is not less than half
        ((60_000, 100_000), (True, True), False),
        ((40_000, 100_000), (True, False), True),  # the control needs even more
        ((60_000, 100_000), (True, False), None),
        ((60_000, 100_000), (False, True), False),  # it needs even more
        ((40_000, 100_000), (False, True), None),
        ((60_000, 100_000), (False, False), None),
    ],
)
def test_faster_is_less_than_half_of_the_controls_steps(steps, there, faster):
    unlearned, control = (Lasted(0, of, reached) for of, reached in zip(steps, there, strict=True))
    assert sooner_than_control(unlearned, control) is faster


def relearned(*steps: tuple[int, int]) -> Relearning:
    """By seed, the target steps of the unlearned policy and of the control."""
    starts = {
        name: {str(seed): curve(of[place]) for seed, of in enumerate(steps)}
        for place, name in enumerate(("unlearned", "control"))
    }
    return msgspec.convert({"base": {str(seed): 0.8 for seed in range(len(steps))}, "starts": starts}, Relearning)


def test_the_word_is_of_every_seed_and_the_steps_are_given():
    fast, words = pace(relearned((40_000, 100_000), (30_000, 90_000)))
    assert fast is True
    assert words == (
        "It relearns the targets faster than the control: unlearned policy against control, seed by seed, 40,000 "
        "against 100,000; 30,000 against 90,000 target steps until 80 % of the base's tracking."
    )
    assert pace(relearned((60_000, 100_000)))[0] is False
    one, words = pace(relearned((40_000, 100_000), (60_000, 100_000)))
    assert one is None
    assert words.startswith("With some seeds it relearns")
    assert pace(relearned())[0] is None
    assert pace(None) == (None, "How fast it relearns the targets was not measured.")
