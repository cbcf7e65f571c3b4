"""The policies that a study starts from and compares with: its bases, and its retrained controls."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.settings.interface import differences
from forgetmimic_jax.settings.options import comma_separated
from forgetmimic_jax.studies.options import Options

if TYPE_CHECKING:
    from forgetmimic_jax.training.checkpoint import CheckpointInfo


def find_bases(options: Options) -> tuple[CheckpointInfo, ...]:
    """The bases that a study names, or the shipped ones.

    Raises:
        InputError: none, one of another robot, or one of other clips, or of another interface than the first.
    """
    from forgetmimic_jax.training.checkpoint import read_info
    from forgetmimic_jax.training.start import base_folder, shipped_policies

    if options.bases is None:
        paths = shipped_policies(options.robot, "base") or (base_folder(options.robot),)
    else:
        paths = tuple(Path(name) for name in comma_separated(options.bases))
    if not paths:
        raise InputError("--bases: no checkpoint named; leave the flag out for the shipped ones")
    infos = tuple(read_info(path) for path in paths)
    if infos[0].robot != options.robot:
        raise InputError(f"{infos[0].path}: robot: found '{infos[0].robot}'; --robot is '{options.robot}'")
    _check_alike(infos, infos[0])
    return infos


def find_controls(
    options: Options, targets: tuple[str, ...], bases: Sequence[CheckpointInfo]
) -> tuple[CheckpointInfo, ...]:
    """The retrained controls that a study names, or the shipped ones of its targets; one for each base at most.

    Raises:
        InputError: one that is named is of other clips, or rolled out a target.
    """
    from forgetmimic_jax.attacks.control import check_never_rolled_out
    from forgetmimic_jax.training.checkpoint import read_info
    from forgetmimic_jax.training.start import shipped_policies

    if options.controls is None:
        shipped = [read_info(path) for path in shipped_policies(options.robot, "control")]
        alike = [info for info in shipped if not any(_differences(info, bases[0]))]
        return tuple(info for info in alike if set(info.config.unlearn.targets) == set(targets))[: len(bases)]
    infos = tuple(read_info(Path(name)) for name in comma_separated(options.controls))
    if len(infos) > len(bases):
        raise InputError(f"--controls: found {len(infos)}; accepted: one for each base at most, here {len(bases)}")
    _check_alike(infos, bases[0])
    for info in infos:
        check_never_rolled_out(info, targets)
    return infos


def named_of_other_robots(options: Options) -> list[str]:
    """In words, which flags name policies of another robot than the study's."""
    from forgetmimic_jax.training.checkpoint import read_info

    found = []
    for flag, names in (("--bases", options.bases), ("--controls", options.controls)):
        robots = {read_info(Path(name)).robot for name in comma_separated(names or "")} - {options.robot}
        if robots:
            found.append(f"{flag} names policies of the {' and '.join(sorted(robots))}")
    return found


def retrained_in_words(conditions: Mapping[str, Any]) -> str:
    """How the retrained policies of a study were made, for its page."""
    if "controls" in conditions:
        steps = " and ".join(dict.fromkeys(f"{of['environment_steps']:,}" for of in conditions["controls"]))
        return (
            "The retrained policies are controls of `make pretrain WITHOUT=TARGETS`, trained as a base is, for "
            f"{steps} environment steps."
        )
    return (
        f"The retrained policy was trained for {conditions['control_iterations']:,} iterations; a short training makes "
        "it a reference for the first steps only."
    )


def _check_alike(infos: Iterable[CheckpointInfo], first: CheckpointInfo) -> None:
    """InputError where a policy cannot stand beside the first base."""
    for info in infos:
        for name, found, needed in _differences(info, first):
            raise InputError(f"{info.path}: {name}: found {found}; accepted: {needed}, as in {first.path}")


def _differences(info: CheckpointInfo, first: CheckpointInfo) -> Iterator[tuple[str, Any, Any]]:
    """What keeps two policies from one environment: its name, of the one, and of the other."""
    for name in ("robot", "clips", "library_hash"):
        if getattr(info, name) != getattr(first, name):
            yield name, getattr(info, name), getattr(first, name)
    yield from differences(info.config, first.config)
