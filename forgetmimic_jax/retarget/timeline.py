"""How a clip's frames follow each other: a line, or a circle whose further rounds are moved by a planar step."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from forgetmimic_jax.motion.kinematics import rotation
from forgetmimic_jax.retarget.planar import PlanarTransform


@dataclass(frozen=True)
class Timeline:
    """The frames of a clip; with a step, frame `frames` is frame 0 moved by it."""

    frames: int
    step: PlanarTransform | None
    fps: float

    @property
    def cyclic(self) -> bool:
        return self.step is not None

    def having(self, ahead: int) -> tuple[np.ndarray, np.ndarray]:
        """Frames that have a frame `ahead` of them, and the rows of those."""
        here = np.arange(self.frames if self.cyclic else self.frames - ahead)
        return here, (here + ahead) % self.frames

    def positions(self, pos: np.ndarray, here: np.ndarray, ahead: int) -> np.ndarray:
        """World positions [row, ..., 3] `ahead` of the frames `here`, from those of every frame."""
        index = here + ahead
        result = pos[index % self.frames].copy()
        past = index >= self.frames
        if self.step is not None and past.any():
            result[past] = self.step.apply(result[past])
        return result

    def vectors(self, columns: np.ndarray, here: np.ndarray, ahead: int) -> np.ndarray:
        """World vectors as columns [row, ..., 3, n] (a Jacobian, say) `ahead` of the frames `here`."""
        index = here + ahead
        result = columns[index % self.frames].copy()
        past = index >= self.frames
        if self.step is not None and past.any():
            result[past] = yaw_matrix(self.step.yaw) @ result[past]
        return result

    def changes(self, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Tangent steps [row, nv] from each frame's qpos to the next, and their Jacobians over both [row, nv, nv]."""
        here, ahead = self.having(1)
        linear = self.positions(qpos[:, :3], here, 1) - qpos[here, :3]
        turns = rotation(qpos[:, 3:7])
        turns_ahead = turns[ahead]
        if self.step is not None:
            turns_ahead[-1] = self.step.turn(turns_ahead[-1])
        angular = (turns[here].inv() * turns_ahead).as_rotvec()
        joints = qpos[ahead, 7:] - qpos[here, 7:]
        change = np.concatenate([linear, angular, joints], axis=-1)

        # d angular = (I - w/2) d ahead - (I + w/2) d here to first order in the turn w of one frame.
        nv = change.shape[1]
        half = 0.5 * cross_matrix(angular)
        after = np.broadcast_to(np.eye(nv), (len(here), nv, nv)).copy()
        before = -after
        after[:, 3:6, 3:6] += half
        before[:, 3:6, 3:6] += half
        if self.step is not None:
            after[-1, :3, :3] = yaw_matrix(self.step.yaw)
        return change, before, after


def cross_matrix(vectors: np.ndarray) -> np.ndarray:
    """Matrices [..., 3, 3] whose product with w is v x w, of vectors v [..., 3]."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*vectors.shape, 3)


def yaw_matrix(yaw: float) -> np.ndarray:
    """Rotation matrix [3, 3] by yaw rad about z."""
    return Rotation.from_rotvec([0.0, 0.0, yaw]).as_matrix()
