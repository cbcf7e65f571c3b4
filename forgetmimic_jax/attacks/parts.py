"""Evidence that is gathered part by part: what is finished stays in the run's folder, and a second start continues.

evidence/conditions.json    what the parts are of; parts of anything else are refused
evidence/NAME.json          an attack's numbers, or one curve
evidence/policies/NAME      a policy that an attack trained
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from forgetmimic_jax.attacks.document import write_document
from forgetmimic_jax.basics.console import Show
from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.basics.files import write_json
from forgetmimic_jax.policy.policy import Policy
from forgetmimic_jax.tracking.env import make_assets
from forgetmimic_jax.tracking.rsi import initial_failure_level
from forgetmimic_jax.tracking.setup import Setup
from forgetmimic_jax.training import checkpoint
from forgetmimic_jax.training.checkpoint import Progress

T = TypeVar("T")


class Parts:
    """The finished parts in a folder."""

    def __init__(self, folder: Path, setup: Setup, conditions: Mapping[str, Any]):
        """Check that the folder's parts, if there are any, are of these conditions.

        Args:
            folder: of the parts.
            setup: of the unlearned policy.
            conditions: plain values: which policies, clips and code, and how much of everything.

        Raises:
            InputError: the folder's parts are of other conditions.
        """
        self.folder, self._setup = folder, setup
        path = folder / "conditions.json"
        ours = json.loads(json.dumps(conditions))
        if path.is_file():
            theirs = json.loads(path.read_text())
            for name in {**theirs, **ours}:
                if theirs.get(name) != ours.get(name):
                    raise InputError(
                        f"{path}: {name}: found {theirs.get(name)}, but now it is {ours.get(name)}; remove the folder "
                        f"{folder} to start again"
                    )
            return
        folder.mkdir(parents=True, exist_ok=True)
        write_json(path, ours)

    def part(self, name: str, kind: type[T], make: Callable[[], T]) -> T:
        """A part by its name; it is made, and written, if it is not there yet."""
        path = self.folder / f"{name}.json"
        if path.is_file():
            return msgspec.json.decode(path.read_bytes(), type=kind)
        found = make()
        write_document(path, found)
        return found

    def policy(self, name: str, make: Callable[[], Policy]) -> Policy:
        """A policy by its name; it is trained, and written, if it is not there yet."""
        path, setup = self.folder / "policies" / name, self._setup
        if not (path / checkpoint.META).is_file():
            level = initial_failure_level(setup.config.sampling, make_assets(setup).bins)
            checkpoint.save_policy(path, setup, make(), level, Progress(0, 0))
        return checkpoint.load_policy(checkpoint.read_info(path), setup.robot)


class Meter:
    """How much is done of all attacks together, in iterations of a training or what takes as long."""

    def __init__(self, show: Show, costs: Mapping[str, int]):
        self._show, self._costs = show, costs
        self._done, self._within = 0, 0

    def tick(self) -> None:
        """One iteration of a training is done."""
        self._within += 1
        self._show(self._done + self._within, 0, {})

    def finished(self, name: str) -> None:
        """An attack is done, perhaps with fewer iterations than it could have taken."""
        self._done, self._within = self._done + self._costs[name], 0
        self._show(self._done, 0, {})
