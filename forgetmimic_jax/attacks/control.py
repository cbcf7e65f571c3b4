"""The control: a policy that never rolled out a target clip, checked to belong to the run."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.evaluation.document import FILE
from forgetmimic_jax.tracking.setup import Setup
from forgetmimic_jax.training import checkpoint
from forgetmimic_jax.training.checkpoint import CheckpointInfo
from forgetmimic_jax.unlearning.registry import methods

METHOD = "distill"  # unless the user names a run


def beside(run: Path) -> Path:
    """The folder of the control that is made for a run."""
    return run.with_name(f"{run.name}-control")


def is_finished(run: Path) -> bool:
    """Whether a run was trained and evaluated, which is the last that it does."""
    return (run / FILE).is_file()


def read_control(run: Path, subject: CheckpointInfo, setup: Setup) -> CheckpointInfo:
    """What the policy of a control says of itself.

    Args:
        run: its folder, or that of its policy alone.
        subject: the unlearned policy.
        setup: of the unlearned policy.

    Raises:
        InputError: no policy, or one that is no control of the unlearned one.
    """
    if not run.is_dir():
        raise InputError(f"{run}: no such folder; name a run of distill, retrain or pretrain, or leave it out")
    info = checkpoint.read_info(run)
    check_never_rolled_out(info, subject.config.unlearn.targets)
    taught = methods()[info.config.unlearn.method].start == "taught"
    if taught and info.base != subject.base:
        raise InputError(f"{run}: base: found {info.base}; accepted: {subject.base}, as in the unlearned run")
    checkpoint.check_matches(info, setup)
    return info


def check_never_rolled_out(info: CheckpointInfo, targets: Sequence[str]) -> None:
    """InputError unless a policy was trained from a fresh one on all clips but the targets."""
    fresh = [name for name, of in methods().items() if of.start != "base"]
    unlearn = info.config.unlearn
    for name, found, accepted in (
        ("unlearn.method", unlearn.method if unlearn.targets else "none", fresh),
        ("sampling.clips", info.config.sampling.clips, ["kept"]),
        ("unlearn.targets", sorted(unlearn.targets), [sorted(targets)]),
    ):
        if found not in accepted:
            raise InputError(
                f"{info.path}: {name}: found {found}; accepted for a control: {' or '.join(map(str, accepted))}"
            )
