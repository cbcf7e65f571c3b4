"""A trial: an unlearning run of a sweep or a study, or the evaluation of a control.

It is a Config and its hash: its folder is named by what decides its numbers, so that any study that asks for the
same run finds a finished one again, and a run of other code is another trial.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from forgetmimic_jax.basics.provenance import provenance
from forgetmimic_jax.evaluation.document import FILE
from forgetmimic_jax.motion.library import library_hash
from forgetmimic_jax.robot.model import roles_file
from forgetmimic_jax.settings.config import Config, to_dict
from forgetmimic_jax.settings.options import flags_of
from forgetmimic_jax.studies.executor import run_tasks
from forgetmimic_jax.studies.task import Task
from forgetmimic_jax.tracking.setup import library_folder
from forgetmimic_jax.training import checkpoint
from forgetmimic_jax.training.checkpoint import CheckpointInfo
from forgetmimic_jax.training.start import base_checkpoint
from forgetmimic_jax.training.unlearning_run import Options, config_of


@dataclass(frozen=True)
class Trial:
    """One run of `forgetmimic_jax.unlearn`, or of `forgetmimic_jax.evaluate`.

    Args:
        folder: where it goes; see `make_trial`.
        config: every setting.
        flags: of the command that makes this config, all but `--output` and `--resume`.
        command: its name.
    """

    folder: Path
    config: Config
    flags: tuple[str, ...]
    command: str = "unlearn"

    @property
    def task(self) -> Task:
        """The trial for `run_tasks`."""
        trains = self.command == "unlearn"
        return Task(self.folder, self.command, self.flags, self.config.iterations if trains else 0)

    @property
    def finished(self) -> bool:
        """It was trained and evaluated, by the code that its name says."""
        return self.task.finished and not self.other_code

    @property
    def other_code(self) -> set[str]:
        """Codes that made the evaluation or a checkpoint of the folder, and are not the one that its name says."""
        notes = [self.folder / FILE, *self.folder.glob(f"checkpoints/*/{checkpoint.META}")]
        made = [json.loads(note.read_text()).get("made") or {} for note in notes if note.is_file()]
        return {of["code"] for of in made if "code" in of} - {self.folder.name.rpartition("-")[2]}


def make_trial(root: Path, options: Mapping[str, Any]) -> Trial:
    """The trial with these options of `unlearn`, by name.

    Its folder is METHOD-TARGETS-sSEED-DIGEST-CODE in `root`. DIGEST is over every setting, the number of evaluation
    episodes, the contents of base, clips and robot, and the versions of JAX and MuJoCo; CODE is over the package's
    Python files. Where base and clips lie, and who wrote them down when, does not count.
    """
    given = Options(**{**options, "set": [list(options.get("set", []))]})
    config = config_of(given)
    base = _content(checkpoint.read_info(base_checkpoint(config)))
    robot = [path.read_text() for path in sorted(roles_file(config.robot).parent.glob("*.*ml"))]
    plain = dataclasses.replace(config, base=None, library=None)
    content = [to_dict(plain), given.episodes, base, library_hash(library_folder(config)), robot]
    unlearning = config.unlearn
    return Trial(_folder(root, unlearning.method, unlearning.targets, config.seed, content), config, flags_of(given))


def control_trial(
    root: Path, control: CheckpointInfo, base: CheckpointInfo, *, episodes: int, seed: int, physics: str | None
) -> Trial:
    """The evaluation of a retrained control beside a base, named as in `make_trial`."""
    config, both = control.config, [_content(info) for info in (control, base)]
    folder = _folder(root, "control", config.unlearn.targets, seed, [*both, control.library_hash, episodes, physics])
    flags = ["--robot", config.robot, "--checkpoint", str(control.path), "--base", str(base.path)]
    flags += ["--episodes", str(episodes), "--seed", str(seed), *(["--physics", physics] if physics else [])]
    return Trial(folder, config, tuple(flags), "evaluate")


def _content(info: CheckpointInfo) -> list[Any]:
    """Policy and settings of a checkpoint: the same for a copy that another commit or machine has written."""
    return [checkpoint.policy_hash(info), to_dict(dataclasses.replace(info.config, base=None, library=None))]


def _folder(root: Path, kind: str, targets: Sequence[str], seed: int, content: Any) -> Path:
    here = provenance()
    content = [content, here.jax, here.mujoco]
    digest = hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:8]
    return root / "-".join([kind, "+".join(targets), f"s{seed}", digest, here.code])


def without_code(name: str) -> str:
    """A trial's name but for the code that made it."""
    return name.rpartition("-")[0]


def run_trials(trials: Sequence[Trial], *, jobs: int, cluster: str | None, description: str) -> dict[Trial, str]:
    """`run_tasks` of the trials that are not finished; returns those that failed, each with its reason.

    A trial that other code made a part of has failed, too: one number would be of two codes.
    """
    tasks = {trial: trial.task for trial in trials if not trial.other_code}
    failed = run_tasks(list(tasks.values()), jobs=jobs, cluster=cluster, description=description)
    reasons = {trial: failed[task] for trial, task in tasks.items() if task in failed}
    for trial in trials:
        if codes := " and ".join(sorted(trial.other_code)):
            reasons[trial] = (
                f"code {codes} made a part of it, as the checkout changed meanwhile; "
                f"remove {trial.folder} to run it again"
            )
    return reasons
