"""Non-linear least squares over a clip's frames, where a residual couples a few neighbouring frames."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.linalg import solveh_banded


class Residuals(NamedTuple):
    """Residuals of `frame`s [row, m] and their Jacobians [row, m, nv] by frames ahead of it."""

    frame: np.ndarray
    residual: np.ndarray
    jacobians: dict[int, np.ndarray]

    def softened(self, weight: float, sure: float) -> Residuals:
        """The residuals times `weight`; a row longer than about `sure` counts linearly instead of squared."""
        row = weight * (1.0 + np.sum(self.residual**2, axis=-1) / sure**2) ** -0.25
        jacobians = {offset: row[:, None, None] * jacobian for offset, jacobian in self.jacobians.items()}
        return Residuals(self.frame, row[:, None] * self.residual, jacobians)


def gauss_newton(
    terms_of: Callable[[np.ndarray], list[Residuals]],
    moved: Callable[[np.ndarray, np.ndarray], np.ndarray],
    qpos: np.ndarray,
    nv: int,
    cyclic: bool,
    iterations: int,
) -> tuple[np.ndarray, float]:
    """Lower the sum of squared residuals of qpos [frame, nq] by damped Gauss-Newton steps; where it got, and the sum.

    Args:
        terms_of: the residuals at a qpos.
        moved: a qpos moved along tangent steps [frame, nv].
        qpos: where to start.
        nv: tangent dimensions of a frame.
        cyclic: the last frame is followed by the first.
        iterations: steps at most.
    """
    damping = 1e-4
    terms = terms_of(qpos)
    cost = _cost(terms)
    for _ in range(iterations):
        candidate = moved(qpos, gauss_newton_step(terms, len(qpos), nv, cyclic, damping))
        new_terms = terms_of(candidate)
        new_cost = _cost(new_terms)
        if new_cost < cost:
            converged = cost - new_cost < 1e-5 * cost
            qpos, terms, cost, damping = candidate, new_terms, new_cost, max(damping / 4.0, 1e-6)
            if converged:
                break
        else:
            damping *= 8.0
    return qpos, cost


def gauss_newton_step(terms: list[Residuals], frames: int, nv: int, cyclic: bool, damping: float) -> np.ndarray:
    """Gauss-Newton step [frame, nv] of the block-banded (cyclic: block-circulant banded) normal equations."""
    reach = max(max(term.jacobians) for term in terms)
    blocks = np.zeros((reach + 1, frames, nv, nv))  # blocks[k, t] couples frame t with frame t + k
    gradient = np.zeros((frames, nv))
    for term in terms:
        for offset, jacobian in term.jacobians.items():
            at = (term.frame + offset) % frames
            gradient[at] += np.einsum("tmi,tm->ti", jacobian, term.residual)
            for other, other_jacobian in term.jacobians.items():
                if other >= offset:
                    product = np.swapaxes(jacobian, -1, -2) @ other_jacobian
                    blocks[other - offset, at] += product
    blocks[0] += damping * np.eye(nv)

    # A cyclic clip is folded (0, n-1, 1, n-2, ...), which turns the circle into a band of twice the width.
    every = np.arange(frames)
    place = np.where(every < (frames + 1) // 2, 2 * every, 2 * (frames - 1 - every) + 1) if cyclic else every
    width = (2 * reach + 1 if cyclic else reach + 1) * nv
    band = np.zeros((width, frames * nv))
    row, column = np.meshgrid(np.arange(nv), np.arange(nv), indexing="ij")
    for ahead in range(reach + 1):
        here = every if cyclic else every[: frames - ahead]
        there = (here + ahead) % frames
        for block, down, right in (
            (blocks[ahead, here], place[here], place[there]),
            (np.swapaxes(blocks[ahead, here], -1, -2), place[there], place[here]),
        )[: 2 if ahead else 1]:
            down_entry = down[:, None, None] * nv + row
            right_entry = right[:, None, None] * nv + column
            lower = down_entry >= right_entry
            band[(down_entry - right_entry)[lower], right_entry[lower]] += block[lower]
    solution = np.empty((frames, nv))
    order = np.argsort(place)
    solution[order] = -solveh_banded(band, gradient[order].reshape(-1), lower=True).reshape(frames, nv)
    return solution


def _cost(terms: list[Residuals]) -> float:
    return float(sum(np.sum(term.residual**2) for term in terms))
