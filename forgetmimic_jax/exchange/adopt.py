"""A policy of another project as a base of this one: its setup, its trial, the comparison, and the folder.

base/     the policy, a checkpoint
library/  its clips, where they came with it
"""

from __future__ import annotations

import dataclasses
import math
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import yaml

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.exchange.foreign import ForeignPolicy
from forgetmimic_jax.exchange.imported import with_actor, within_limit
from forgetmimic_jax.exchange.trial import Tracked, Trial, try_out
from forgetmimic_jax.motion.clip import Clip
from forgetmimic_jax.motion.library import add_clip, build_library, file_hash, library_hash, load_library
from forgetmimic_jax.policy.normalizer import OBSERVATION_LIMIT
from forgetmimic_jax.policy.policy import Policy
from forgetmimic_jax.robot.model import load_robot
from forgetmimic_jax.settings.config import Config
from forgetmimic_jax.tracking.env import make_assets
from forgetmimic_jax.tracking.rsi import initial_failure_level
from forgetmimic_jax.tracking.setup import Setup, make_setup
from forgetmimic_jax.training import checkpoint
from forgetmimic_jax.training.start import fresh_policy

LIBRARY = "library"
TOLERANCE = 1e-5  # of an action, or of 1 where the action is smaller
COMPARED = 20_000  # observations at most at which actions are compared
REFERENCE_TOLERANCE = 0.01  # of a reward, and rad
LEAST_SURVIVAL = 0.5  # of a clip's episodes with reset noise: a policy that is read right reaches 0.95 and more
FIGURES = ("reward", "joint_error", "survival")  # of `Tracked`, that a reference may have


@dataclass(frozen=True)
class Adopted:
    """A policy of ours that does what one of another project does, or several."""

    setup: Setup
    policy: Policy
    trial: Trial
    clips: tuple[tuple[Clip, Path], ...]  # that came with it, and the files that they are from
    progress: checkpoint.Progress
    facts: tuple[str, ...]  # what a user should know, in sentences


def own_setup(config: Config, clips: Sequence[Clip]) -> Setup:
    """A setup with clips that are in no folder yet; without any, with those of the config's library."""
    if not clips:
        return make_setup(config)
    robot = load_robot(config.robot, config.physics, config.action)
    return Setup(config, robot, build_library(robot, clips, 1.0 / config.physics.control_step), "")


def adopt(foreign: ForeignPolicy, config: Config, *, std: float, episodes: int, seed: int) -> Adopted:
    """A policy of ours with the same actions, after its trial.

    Args:
        foreign: the policy.
        config: of the preset, its library the folder that is named in the place of the policy's own clip.
        std: of the exploration noise, where the file has none.
        episodes: of the trial, a clip.
        seed: of the trial.

    Raises:
        InputError: an action that differs from the original's by more than 1e-5.
    """
    own = foreign.clip if config.library is None else None
    setup = own_setup(foreign.config(config), [own] if own else [])
    policy = with_actor(fresh_policy(setup, make_assets(setup)), foreign.actor, std)
    trial = try_out(setup, policy, episodes=episodes, seed=seed)
    return Adopted(
        setup=setup,
        policy=policy,
        trial=trial,
        clips=((own, foreign.clip_file or foreign.path),) if own else (),
        progress=checkpoint.Progress(foreign.actor.iteration, environment_steps=0),
        facts=(*compared(foreign, policy, trial), *foreign.doubts),
    )


def compared(foreign: ForeignPolicy, policy: Policy, trial: Trial) -> list[str]:
    """Sentences about the comparison of a policy's actions with the original's, all along its trial.

    Raises:
        InputError: they differ.
    """
    observations = trial.observations[:: max(1, math.ceil(len(trial.observations) / COMPARED))]
    inside = within_limit(policy, observations)
    if not inside.any():
        raise InputError(
            f"{foreign.path}: every observation of the clips lies past {OBSERVATION_LIMIT:g} standard "
            f"deviations of its normaliser; is its observation layout another?"
        )
    expected = foreign.original(observations[inside])
    found = np.asarray(policy.mean_action(jnp.asarray(observations[inside])))
    error = float((np.abs(found - expected) / np.maximum(1.0, np.abs(expected))).max())
    if not error <= TOLERANCE:
        raise InputError(f"{foreign.path}: actions differ from the original's by {error:.1e}; nothing was written")
    facts = [f"Actions equal the original's to {error:.0e} at {inside.sum():,} observations of the roll-outs."]
    if not inside.all():
        facts.append(
            f"{(~inside).sum():,} more lie past {OBSERVATION_LIMIT:g} standard deviations, where ours clips them."
        )
    return facts


def falls(foreign: ForeignPolicy, clips: Mapping[str, Tracked]) -> str | None:
    """A sentence about the clips that a policy falls on, and about what was assumed of it; None if it falls on none."""
    fallen = [f"{name} {of.survival:.0%}" for name, of in clips.items() if not of.survival >= LEAST_SURVIVAL]
    if not fallen:
        return None
    assumed = [f"{row.what} ({row.assumed})" for row in foreign.rows if row.assumed]
    return (
        f"{foreign.path}: the policy falls: survival: {', '.join(fallen)}; {LEAST_SURVIVAL:.0%} or more is expected of "
        f"a policy on a clip that it knows; what was not read but assumed may be wrong: {', '.join(assumed)}"
    )


def read_reference(path: Path | None) -> dict[str, dict[str, float]]:
    """Figures that a roll-out must give, by clip; '' stands for every clip.

    The file is JSON or YAML: `{"joint_error": 0.126, "reward": 0.914}`, or a table of such tables by clip.

    Raises:
        InputError: no such file, or other content.
    """
    if path is None:
        return {}
    try:
        content = yaml.safe_load(path.read_text())
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: neither JSON nor YAML: {str(error).splitlines()[0]}") from None
    if not content:
        raise InputError(f"{path}: found {content!r}; accepted: a table of {', '.join(FIGURES)}")
    tables = (
        content if isinstance(content, dict) and all(isinstance(v, dict) for v in content.values()) else {"": content}
    )
    for clip, table in tables.items():
        if not isinstance(table, dict) or not table:
            raise InputError(f"{path}: found {table!r}; accepted: a table of {', '.join(FIGURES)}")
        for name, value in table.items():
            if name not in FIGURES or isinstance(value, bool) or not isinstance(value, int | float):
                where = f"{clip}: " if clip else ""
                raise InputError(f"{path}: {where}{name}: found {value!r}; accepted: numbers of {', '.join(FIGURES)}")
    return tables


def check_reference(
    path: Path | None, references: Mapping[str, Mapping[str, float]], clips: Mapping[str, Tracked]
) -> None:
    """InputError unless every figure of a reference is met to 0.01 by the clip that it is of."""
    for clip in references:
        if clip and clip not in clips:
            raise InputError(f"{path}: no clip '{clip}' in the roll-out; found {', '.join(clips)}")
    for clip, tracked in clips.items():
        for name, wanted in references.get(clip, references.get("", {})).items():
            found = getattr(tracked, name)
            if not abs(found - wanted) <= REFERENCE_TOLERANCE:
                raise InputError(
                    f"{path}: {clip}: {name}: found {found:.3f}, the reference has {wanted:.3f}; accepted: within "
                    f"{REFERENCE_TOLERANCE:g}; nothing was written"
                )


def write_base(output: Path, adopted: Adopted) -> Path:
    """Write library and policy; the policy's folder. After a failure nothing of them is left.

    Args:
        output: a folder that is empty or does not exist.
        adopted: the policy.
    """
    existed = output.is_dir()
    config, setup = adopted.setup.config, adopted.setup
    try:
        if adopted.clips:
            folder = output / LIBRARY
            for clip, source in adopted.clips:
                facts = {"source": source.name, "source_sha256": file_hash(source), "source_fps": clip.fps,
                         "licence": "unknown", "cyclic": False}  # fmt: skip
                add_clip(folder, setup.robot, clip, facts)
            config = dataclasses.replace(config, library=str(folder))
            setup = dataclasses.replace(
                setup,
                config=config,
                library=load_library(setup.robot, folder, fps=1.0 / config.physics.control_step),
                library_hash=library_hash(folder),
            )
        level = initial_failure_level(config.sampling, make_assets(setup).bins)
        checkpoint.save_policy(output / checkpoint.BASE, setup, adopted.policy, level, adopted.progress)
    except BaseException:
        for part in (output / LIBRARY, output / checkpoint.BASE):
            shutil.rmtree(part, ignore_errors=True)
        if not existed and output.is_dir():
            output.rmdir()
        raise
    return output / checkpoint.BASE
