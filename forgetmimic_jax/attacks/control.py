"""The control: a policy that never rolled out a target clip, checked to belong to the run."""

from __future__ import annotations

from pathlib import Path

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.evaluation.document import FILE
from forgetmimic_jax.tracking.setup import Setup
from forgetmimic_jax.training import checkpoint
from forgetmimic_jax.training.checkpoint import CheckpointInfo, newest_checkpoint
from forgetmimic_jax.unlearning.registry import methods

METHOD = "distill"  # unless the user names a run


def beside(run: Path) -> Path:
    """The folder of the control that is made for a run."""
    return run.with_name(f"{run.name}-control")


def is_finished(run: Path) -> bool:
    """Whether a run was trained and evaluated, which is the last that it does."""
    return (run / FILE).is_file()


def read_control(run: Path, subject: CheckpointInfo, setup: Setup) -> CheckpointInfo:
    """The last checkpoint of a control.

    Args:
        run: its folder.
        subject: the unlearned policy.
        setup: of the unlearned policy.

    Raises:
        InputError: no run, or one that is no control of this policy.
    """
    newest = newest_checkpoint(run)
    if newest is None:
        raise InputError(f"{run}: no run with a checkpoint; name one of METHOD=distill or retrain, or leave it out")
    info = checkpoint.read_info(newest)
    fresh = [name for name, of in methods().items() if of.start != "base"]
    unlearn, sampling = info.config.unlearn, info.config.sampling
    if unlearn.method not in fresh or not unlearn.targets:
        raise InputError(f"{run}: unlearn.method: found {unlearn.method}, no control; accepted: {', '.join(fresh)}")
    if sampling.clips != "kept":
        raise InputError(f"{run}: sampling.clips: found {sampling.clips}, so it rolled out the targets; accepted: kept")
    for field, found, ours in (
        ("targets", sorted(unlearn.targets), sorted(subject.config.unlearn.targets)),
        ("base", info.base, subject.base),
    ):
        if found != ours:
            raise InputError(f"{run}: {field}: found {found}; accepted: {ours}, as in the unlearned run")
    checkpoint.check_matches(info, setup)
    return info
