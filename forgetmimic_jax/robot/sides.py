"""The left and the right of a robot: its pairs of bodies, and the limbs and joints that are each other's mirror image.

A limb is all that hangs on one side of a pair: it begins at the body's highest ancestor that does not carry the pair's
other body too. The joints of two such limbs stand in one order, so each has its counterpart.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Generic, TypeVar

import mujoco
import numpy as np

from forgetmimic_jax.robot.tree import above

T = TypeVar("T")
LEFT, RIGHT = "left", "right"
SIDES = (LEFT, RIGHT)


@dataclass(frozen=True)
class Pairs(Generic[T]):
    """Bodies that a robot has twice, (left, right), by name or by id."""

    hips: tuple[T, T]  # their origin is the joint's centre, as it is for knees, shoulders and elbows
    knees: tuple[T, T]
    feet: tuple[T, T]  # with the soles' shapes
    shoulders: tuple[T, T]
    elbows: tuple[T, T]
    hands: tuple[T, T]


def body_ids(model: mujoco.MjModel, pairs: Pairs[str]) -> Pairs[int]:
    """The pairs by body id."""
    return Pairs(**{role: (model.body(left).id, model.body(right).id) for role, (left, right) in vars(pairs).items()})


def side_problems(model: mujoco.MjModel, pairs: Pairs[int]) -> Iterator[str]:
    """Pairs that give no left and right, and limbs whose joints cannot be counterparts; a line each."""
    starts: dict[int, tuple[str, str]] = {}
    for role, pair in vars(pairs).items():
        left, right = model.body(pair[0]).name, model.body(pair[1]).name
        if pair[0] in above(model, pair[1]) or pair[1] in above(model, pair[0]):
            yield f"{role}: '{left}' and '{right}' are one body, or one carries the other; accepted: left and right"
            continue
        limbs = _limb(model, *pair), _limb(model, *pair[::-1])
        for limb, side in zip(limbs, SIDES, strict=True):
            other_role, other_side = starts.setdefault(limb, (role, side))
            if side != other_side:
                body = model.body(limb).name
                yield f"{role}: '{body}' is on the {side}, but on the {other_side} by {other_role}"
                break  # its counterpart is on the wrong side, too
        counts = [len(_joints(model, limb)) for limb in limbs]
        if counts[0] != counts[1]:
            yield f"{role}: the left limb has {counts[0]} joints and the right one {counts[1]}; accepted: as many"


def sides_of_bodies(model: mujoco.MjModel, pairs: Pairs[int]) -> tuple[str, ...]:
    """'left', 'right' or '' of every body of the model."""
    start = {limb: side for pair in _limbs(model, pairs) for limb, side in zip(pair, SIDES, strict=True)}
    return tuple(next((start[one] for one in above(model, body) if one in start), "") for body in range(model.nbody))


def counterparts(model: mujoco.MjModel, pairs: Pairs[int]) -> dict[int, int]:
    """Joint id to the id of the other side's joint, for the joints of the limbs."""
    found: dict[int, int] = {}
    for left, right in _limbs(model, pairs):
        for one, other in zip(_joints(model, left), _joints(model, right), strict=True):
            found |= {one: other, other: one}
    return found


def _limbs(model: mujoco.MjModel, pairs: Pairs[int]) -> set[tuple[int, int]]:
    """The bodies that the limbs begin at, (left, right)."""
    return {(_limb(model, left, right), _limb(model, right, left)) for left, right in vars(pairs).values()}


def _limb(model: mujoco.MjModel, body: int, other: int) -> int:
    """The body's highest ancestor, itself included, that does not carry `other` too."""
    shared = above(model, other)
    return next(one for one in reversed(above(model, body)) if one not in shared)


def _joints(model: mujoco.MjModel, limb: int) -> np.ndarray:
    """Ids of the joints of a limb's bodies, in the model's order."""
    carried = [limb in above(model, body) for body in range(model.nbody)]
    return np.flatnonzero(np.asarray(carried)[model.jnt_bodyid])
