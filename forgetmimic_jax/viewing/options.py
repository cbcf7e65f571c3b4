"""Which policies `play` and `video` show."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from forgetmimic_jax.settings.options import at_least, comma_separated

if TYPE_CHECKING:
    from forgetmimic_jax.training.comparison import Comparison


@dataclass(kw_only=True)
class Shown:
    """The policies that are shown side by side, and their clips."""

    robot: str = "g1"
    """Robot under robots/."""
    checkpoint: Path | None = None
    """Checkpoint, or the folder of a run, such as an unlearning run's; by default what is shipped: the base
    data/ROBOT/base, and the policies data/ROBOT/unlearned-METHOD made from it."""
    base: Path | None = None
    """For an unlearned checkpoint, the base beside it; the one it started from by default."""
    beside: str | None = None
    """More checkpoints to show beside these, comma-separated; each is named by its method."""
    seed: int = 0
    """Seed of the reset noise; the same for every policy."""
    library: Path | None = None
    """Folder of clips; the checkpoint's by default."""

    def load(self) -> Comparison:
        """The policies on MuJoCo's C engine.

        Raises:
            InputError: see `load_comparison`.
        """
        from forgetmimic_jax.training.comparison import load_comparison
        from forgetmimic_jax.training.start import base_folder, shipped_policies

        at_least(0, "--seed", self.seed)
        beside = [Path(one) for one in comma_separated(self.beside or "")]
        path = self.checkpoint
        if path is None:
            path, *shipped = shipped_policies(self.robot, "unlearned") or (base_folder(self.robot),)
            beside = [*shipped, *beside]
        return load_comparison(
            path, robot=self.robot, base=self.base, beside=beside, library=self.library, physics="native"
        )
