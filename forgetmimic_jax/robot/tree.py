"""The bodies of a model in its zero pose: which is whose other side, and which are limbs.

The robot faces x, z is up, so its left is at positive y.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import mujoco
import numpy as np

SIDE_WORDS = (("left", "right"), ("Left", "Right"), ("l_", "r_"), ("L_", "R_"), ("_l", "_r"), ("_L", "_R"))
MIRROR = 0.02  # m that a body may lie from its counterpart's mirror image


def says_other_side(left: str, right: str) -> bool:
    """Whether a left body has a right one's name, and a right body the left one's."""
    return left != right and any(left.replace(b, a) == right for a, b in SIDE_WORDS)


class Tree:
    """The bodies of a model in its zero pose, its root upright at the origin."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model = model
        self.names = [model.body(body).name for body in range(model.nbody)]
        data = at_rest(model)
        self.pos = data.xpos.copy()  # [body, 3] m
        self.children = [
            np.flatnonzero((model.body_parentid == body) & (np.arange(model.nbody) > 0)) for body in range(model.nbody)
        ]
        self.other = self._counterparts()

    def _counterparts(self) -> dict[int, int]:
        """Each body's other side, left to right and right to left: by the name, otherwise by the place."""
        found: dict[int, int] = {}
        depth = np.array([len(above(self.model, body)) for body in range(self.model.nbody)])
        for body in range(1, self.model.nbody):
            named = [self.names[body].replace(a, b) for pair in SIDE_WORDS for a, b in (pair, pair[::-1])]
            other = next(
                (self.names.index(name) for name in named if name != self.names[body] and name in self.names), None
            )
            if other is None and abs(self.pos[body, 1]) > MIRROR:
                away = np.linalg.norm(self.pos - self.pos[body] * [1, -1, 1], axis=-1)
                away[depth != depth[body]] = np.inf
                other = int(np.argmin(away)) if away.min() < MIRROR else None
            if other is not None and other != body:
                found[body] = other
        return {body: other for body, other in found.items() if found.get(other) == body}

    def below(self, body: int) -> list[int]:
        """A body and all that hangs on it."""
        return [body] + [each for child in self.children[body] for each in self.below(int(child))]

    def jointed(self, bodies: Sequence[int]) -> list[int]:
        """Those that a joint moves."""
        return [body for body in bodies if self.model.body_jntnum[body]]

    def chain(self, body: int) -> list[int]:
        """From a body down to its most jointed end."""
        chain = [body]
        while len(self.children[chain[-1]]):
            chain.append(
                int(max(self.children[chain[-1]], key=lambda child: len(self.jointed(self.below(int(child))))))
            )
        return chain

    def limbs(self) -> list[tuple[int, int]]:
        """The highest bodies of each pair of limbs, (left, right), the longest limbs first."""
        starts = [
            (body, other)
            for body, other in self.other.items()
            if self.model.body_parentid[body] not in self.other and self._is_left(body, other)
        ]
        return sorted(starts, key=lambda pair: -len(self.jointed(self.below(pair[0]))))

    def _is_left(self, body: int, other: int) -> bool:
        """By the side that most of the limb lies on."""
        return bool(self.pos[self.below(body), 1].mean() > self.pos[self.below(other), 1].mean())

    def pick(self, chain: Sequence[int], words: Sequence[str]) -> int | None:
        """The first body of a chain whose name, or whose joint's, has one of the words."""
        for body in chain:
            joints = range(self.model.body_jntadr[body], self.model.body_jntadr[body] + self.model.body_jntnum[body])
            texts = [self.names[body], *(self.model.joint(joint).name for joint in joints)]
            if any(word in text.lower() for word in words for text in texts):
                return body
        return None

    def middle(self, chain: Sequence[int]) -> int:
        """The body of a chain that is furthest from both its ends: where the limb bends."""
        ends = self.pos[[chain[0], chain[-1]]]
        return max(chain, key=lambda body: float(np.linalg.norm(self.pos[body] - ends, axis=-1).min()))


def above(model: mujoco.MjModel, body: int) -> list[int]:
    """Ids of a body, itself first, and of what it hangs on, up to the world."""
    chain = [body]
    while chain[-1]:
        chain.append(int(model.body_parentid[chain[-1]]))
    return chain


def at_rest(model: mujoco.MjModel, joints: Mapping[str, float] | None = None) -> mujoco.MjData:
    """The model with its root upright at the origin, its joints at 0 but for those named."""
    data = mujoco.MjData(model)
    data.qpos[:] = 0.0
    data.qpos[3] = 1.0
    for joint, angle in (joints or {}).items():
        data.qpos[model.joint(joint).qposadr[0]] = angle
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    return data
