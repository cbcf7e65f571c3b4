"""What is finished stays: parts in a folder, and relearning that knows when it is settled."""

import msgspec
import pytest
from invented_evidence import estimate

from forgetmimic_jax.attacks.case import Scale
from forgetmimic_jax.attacks.document import Curve, Numbers
from forgetmimic_jax.attacks.gather import costs
from forgetmimic_jax.attacks.parts import Meter, Parts
from forgetmimic_jax.attacks.relearning import settled
from forgetmimic_jax.basics.errors import InputError


def test_a_part_is_made_once(tmp_path, small_setup):
    made = []

    def make() -> Numbers:
        made.append(1)
        return msgspec.convert({"skill": estimate(0.3)}, Numbers)

    for _ in range(2):
        parts = Parts(tmp_path / "evidence", small_setup, {"policies": {"base": "b"}, "seed": 0})
        assert parts.part("one", Numbers, make).skill.mean == 0.3
    assert len(made) == 1


def test_an_attack_that_fails_leaves_no_part(tmp_path, small_setup):
    parts = Parts(tmp_path, small_setup, {})
    with pytest.raises(ZeroDivisionError):
        parts.part("one", Numbers, lambda: 1 / 0)
    assert not (tmp_path / "one.json").exists()


def test_parts_of_another_policy_are_refused(tmp_path, small_setup):
    Parts(tmp_path / "evidence", small_setup, {"policies": {"base": "b"}, "seed": 0})
    with pytest.raises(InputError, match=r"policies: found \{'base': 'b'\}, but now it is \{'base': 'x'\}; remove the"):
        Parts(tmp_path / "evidence", small_setup, {"policies": {"base": "x"}, "seed": 0})


def test_an_attack_that_ends_early_still_counts_whole():
    shown = []
    meter = Meter(lambda done, steps, metrics: shown.append(done), {"recovery": 10, "numerics": 3})
    meter.tick()
    meter.tick()
    meter.finished("recovery")
    meter.finished("numerics")
    assert shown == [1, 2, 10, 13]


def test_what_trains_costs_its_iterations():
    scale = Scale(episodes=10, recovery_iterations=5, relearning_iterations=7, held_out_iterations=3, seeds=2)
    found = costs(scale)
    assert (found["recovery"], found["relearning"], found["held_out"]) == (30, 28, 12)
    assert found["originals"] == 30  # half of the episodes


def curve(tracking: list[float]) -> Curve:
    return Curve([10.0 * i for i in range(len(tracking))], tracking, [1000.0 * i for i in range(len(tracking))])


@pytest.mark.parametrize(
    ("tracking", "steps_to_beat", "ends"),
    [
        ([0.1, 0.5, 0.85], float("inf"), False),  # one evaluation above 80 %
        ([0.1, 0.85, 0.85], float("inf"), True),
        ([0.1, 0.85, 0.85], None, False),  # to the last level
        ([0.1, 0.96, 0.97], None, True),
        ([0.1, 0.2, 0.3], 2000.0, False),
        ([0.1, 0.2, 0.3], 1999.0, True),  # the other was faster, whatever follows
    ],
)
def test_a_relearning_ends_when_it_is_settled(tracking, steps_to_beat, ends):
    assert settled(curve(tracking), 1.0, steps_to_beat) == ends
