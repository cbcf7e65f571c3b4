"""What a command measures or shows side by side: a checkpoint's policy and, if that was unlearned, its base's."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.evaluation.evaluate import Subject
from forgetmimic_jax.evaluation.rollout import Evaluator
from forgetmimic_jax.policy.policy import Policy
from forgetmimic_jax.settings.config import EngineName
from forgetmimic_jax.settings.options import on_engine, replace_given
from forgetmimic_jax.tracking.setup import Setup, check_targets, make_setup, on_library
from forgetmimic_jax.training import checkpoint
from forgetmimic_jax.training.checkpoint import CheckpointInfo
from forgetmimic_jax.training.folder import folder_of
from forgetmimic_jax.training.start import base_checkpoint
from forgetmimic_jax.unlearning.registry import method_of


@dataclass(frozen=True)
class Comparison:
    """One or two policies on the same robot and clips."""

    setup: Setup
    policies: dict[str, Policy]  # `base`, or `base` and what the method makes of it, such as `unlearned`
    info: dict[str, CheckpointInfo]  # of each policy
    targets: tuple[str, ...]  # clips to forget

    @property
    def subjects(self) -> dict[str, Subject]:
        """The policies as an evaluation takes them."""
        return {name: subject(policy, self.info[name]) for name, policy in self.policies.items()}


def subject(policy: Policy, info: CheckpointInfo) -> Subject:
    """The policy of a checkpoint as an evaluation takes it."""
    return Subject(policy, checkpoint.policy_hash(info), info.environment_steps)


def load_comparison(
    path: Path,
    *,
    robot: str,
    base: Path | None = None,
    beside: Sequence[Path] = (),
    targets: tuple[str, ...] | None = None,
    library: Path | None = None,
    physics: EngineName | None = None,
) -> Comparison:
    """A checkpoint's policy and, if it is an unlearned one, its base's before it.

    With others beside it, an unlearned policy is named by its method, or by its run where two have one method.

    Args:
        path: the checkpoint, or a run's folder.
        robot: name of the robot that it must be for.
        base: checkpoint to compare with; the one that unlearning started from by default.
        beside: more checkpoints.
        targets: clips to forget; by default the checkpoint's own, those of them that are in the library.
        library: folder of clips, which may be other ones; the checkpoint's by default.
        physics: engine; the checkpoint's by default.

    Raises:
        InputError: a checkpoint that is damaged or does not fit, a base that was replaced since, or a target that is
            no clip.
    """
    info = checkpoint.read_info(path)
    config = on_library(on_engine(replace_given(info.config, robot=robot), physics), library)
    setup = make_setup(config)
    forgetful = bool(info.config.unlearn.targets)
    name: str = method_of(info.config).result if forgetful else "base"
    compared = {name: info}
    if forgetful:
        compared = {"base": checkpoint.read_info(base or base_checkpoint(info.config)), **compared}
        found = checkpoint.policy_hash(compared["base"])
        if base is None and info.base not in (None, found):
            raise InputError(
                f"{path}: unlearned from the policy {info.base}, but {compared['base'].path} is now {found}; name the "
                f"base it started from with --base"
            )
    if beside:
        others = [path, *beside] if forgetful else list(beside)
        compared = {"base": compared["base"], **_by_method(others)}
    for one in reversed(compared.values()):
        checkpoint.check_matches(one, setup, other_library=library is not None)
    targets = config.unlearn.targets if targets is None else targets
    check_targets(targets, setup.library.names)
    policies = {name: checkpoint.load_policy(one, setup.robot) for name, one in compared.items()}
    return Comparison(setup, policies, compared, targets)


def _by_method(paths: Sequence[Path]) -> dict[str, CheckpointInfo]:
    """Checkpoints by the method that made each, or by the run's folder where a method made several.

    Raises:
        InputError: two that have no name to tell them apart.
    """
    found = [checkpoint.read_info(path) for path in paths]
    methods = [info.config.unlearn.method if info.config.unlearn.targets else "base" for info in found]
    named: dict[str, CheckpointInfo] = {}
    for path, info, method in zip(paths, found, methods, strict=True):
        run = folder_of(path)
        name = run.name if run and (methods.count(method) > 1 or method == "base") else method
        if name in named or name == "base":
            raise InputError(f"--beside: {path}: another policy is called '{name}'; name checkpoints of different runs")
        named[name] = info
    return named


def completes_nothing(setup: Setup, policy: Policy) -> bool:
    """Whether a policy completes no episode of any clip: one from each clip's first frame, one from another frame.

    On MuJoCo's C engine, whatever the run's is: MJX would be compiled for this alone.
    """
    setup = dataclasses.replace(setup, config=on_engine(setup.config, "native"))
    rollout = Evaluator(setup, episodes=2, seed=setup.config.seed).rollout(policy)
    return bool((rollout.length < rollout.horizon).all())
