"""An iteration on several devices: each holds its shard of the environments, and all hold everything else."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
from jax.sharding import Mesh, PartitionSpec

from forgetmimic_jax.basics.shards import AXIS
from forgetmimic_jax.ppo.state import TrainState
from forgetmimic_jax.tracking.env import Assets

EVERYWHERE, BY_ENVIRONMENT = PartitionSpec(), PartitionSpec(AXIS)
_FIELDS: dict[str, Any] = {field.name: EVERYWHERE for field in dataclasses.fields(TrainState)}
PLACES = TrainState(**{**_FIELDS, "env": BY_ENVIRONMENT})

Iteration = Callable[[Assets, TrainState], tuple[TrainState, dict[str, jax.Array]]]


def on_shards(iteration: Iteration, mesh: Mesh) -> Iteration:
    """The iteration of one shard's environments, on every device of the mesh at once.

    A shard is consecutive environments, so that branches of one state stay together. Shard i draws with the key folded
    with i; otherwise all shards would draw the same noise. The next iteration's key is folded with their number.
    """

    def of_shard(assets: Assets, state: TrainState) -> tuple[TrainState, dict[str, jax.Array]]:
        own = jax.random.fold_in(state.key, jax.lax.axis_index(AXIS))
        after, metrics = iteration(assets, dataclasses.replace(state, key=own))
        return dataclasses.replace(after, key=jax.random.fold_in(state.key, mesh.size)), metrics

    # What leaves as equal everywhere is so by the means in `basics.shards`, which JAX's own check does not see through.
    return jax.shard_map(
        of_shard, mesh=mesh, in_specs=(EVERYWHERE, PLACES), out_specs=(PLACES, EVERYWHERE), check_vma=False
    )
