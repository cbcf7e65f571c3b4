"""Comparing pytrees."""

from typing import Any

import chex
import jax
import numpy as np


def leaves(tree: Any) -> dict[str, np.ndarray]:
    """Every leaf by its path."""
    return {jax.tree_util.keystr(path): np.asarray(leaf) for path, leaf in jax.tree_util.tree_leaves_with_path(tree)}


def assert_same(found: Any, expected: Any) -> None:
    """The same leaves, bit for bit."""
    chex.assert_trees_all_equal(found, expected, strict=True)
