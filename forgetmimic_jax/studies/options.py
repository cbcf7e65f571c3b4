"""The options that all studies have."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from forgetmimic_jax.settings.options import Settings


@dataclass(kw_only=True)
class Options:
    """Run the missing trials of a study, then write its JSON, its page and its figure."""

    robot: str = "g1"
    """Robot under robots/."""
    bases: str | None = None
    """Checkpoints that the trials start from, comma-separated; by default every data/ROBOT/base* that is shipped."""
    controls: str | None = None
    """Runs of `make pretrain WITHOUT=TARGETS`, comma-separated: retrained controls, the first one beside the first
    base. By default every data/ROBOT/control* that is of these targets; without any, the study retrains."""
    targets: str | None = None
    """Clips to forget, comma-separated; the library's default targets (g1: punch,kick) by default."""
    preset: Literal["cpu", "paper"] = "cpu"
    """cpu: a laptop's settings and iterations; paper: the paper's, for a GPU."""
    iterations: int | None = None
    """PPO iterations of each trial; the preset's by default."""
    control_iterations: int | None = None
    """Iterations of a control that the study retrains; as many steps as the base was trained for by default."""
    seeds: int | None = None
    """Runs of each kind from each base, with the seeds 0, 1, ...; by default 1 with several bases, over which the
    intervals are then, and 3 with one base, whose seeds they are over."""
    episodes: int = 20
    """Evaluation episodes a clip."""
    jobs: int | None = None
    """Trials at a time on this machine; they share its cores evenly; one on each GPU by default, 2 without a GPU."""
    cluster: str | None = None
    """Address of a dask scheduler, such as tcp://host:8786, whose workers run the trials; see docs/cluster.md."""
    trials: Path = Path("runs/trials")
    """Folder of the trials, where every study finds the finished ones again."""
    mix_commits: bool = False
    """Take finished runs of other code too; the page then says which code made which run."""
    physics: Literal["auto", "native", "mjx", "mjx-warp"] | None = None
    """Physics engine; auto is native on a CPU and mjx on a GPU or TPU."""
    library: Path | None = None
    """Folder of clips; the base's by default."""
    output: Path | None = None
    """Folder for NAME.json, NAME.md and NAME.png; experiments/results/ROBOT by default."""
    draw: bool = False
    """Only write page and figure again, from the JSON."""
    set: Settings = field(default_factory=list)
    """Any other settings of every trial, such as ppo.learning_rate=1e-4."""
