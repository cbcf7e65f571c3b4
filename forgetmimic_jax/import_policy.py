"""Make a base of policies of other projects: `forgetmimic import-policy policy.onnx`."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from forgetmimic_jax.basics.errors import InputError, run_command
from forgetmimic_jax.settings.config import Preset
from forgetmimic_jax.settings.options import at_least, parse, replace_given

if TYPE_CHECKING:
    from forgetmimic_jax.exchange.adopt import Adopted
    from forgetmimic_jax.exchange.foreign import ForeignPolicy
    from forgetmimic_jax.exchange.trial import Tracked
    from forgetmimic_jax.policy.policy import Policy
    from forgetmimic_jax.robot.model import Robot
    from forgetmimic_jax.settings.config import Config

    References = Mapping[str, Mapping[str, float]]


@dataclass
class Options:
    """Turn tracking policies of other projects into a base to evaluate, to watch and to unlearn from.

    Layouts: wbc132 (wbc-mjlab), mjlab160 and mjlab154 (mjlab, BeyondMimic, unitree_rl_lab, unitree_rl_mjlab). What a
    policy sees and does is read by name from its ONNX metadata, deploy.yaml or config.yaml. Before anything is written,
    the policy is rolled out on its clip, and its actions are compared with the original's. Several policies become one.
    """

    files: tyro.conf.Positional[tuple[Path, ...]]
    """The policies: ONNX files, or checkpoints of rsl_rl (.pt)."""
    robot: str = "g1"
    """Robot under robots/."""
    library: Path | None = None
    """Folder of clips in the place of the policy's own; data/ROBOT by default, where it has none."""
    layout: str | None = None
    """Layout of a policy that does not say it; with several policies, of the one that they become."""
    action_mode: Literal["residual", "offset"] | None = None
    """What actions are added to, reference or default pose, where a policy does not say it; with several policies, of
    the one that they become."""
    joint_order: Literal["robot", "isaac"] | None = None
    """Order of the joints of a policy that does not say it; isaac: Isaac Lab's, breadth first."""
    fps: float | None = None
    """Frames per second of a motion file beside a policy whose name does not say it."""
    start: float = 0.0
    """First second of a policy's clip to take."""
    reference: Path | None = None
    """JSON or YAML with joint_error (rad) and reward that the roll-out must give to 0.01, also by clip."""
    episodes: int = 50
    """Episodes with reset noise, a clip; several policies are compared with the new one on them."""
    preset: Preset = "cpu"
    """Settings for further training: cpu for a laptop, paper for a GPU."""
    activation: str | None = None
    """Activation of a .pt's hidden layers; by default what params/agent.yaml beside it says."""
    std: float = 0.4
    """Standard deviation of the exploration noise, in units of action, where the file has none (an ONNX)."""
    seed: int = 0
    """Seed of the episodes, of the fresh critic, and of the network that several policies become."""
    output: Path | None = None
    """Folder for base/ and, with clips of the policies' own, library/; runs/import-ROBOT by default."""


def main(options: Options) -> None:
    """Read, roll out, compare and write."""
    from forgetmimic_jax.basics.console import closing, command_line
    from forgetmimic_jax.exchange.adopt import LIBRARY, read_reference, write_base
    from forgetmimic_jax.exchange.foreign import PolicyReading, read_policy
    from forgetmimic_jax.policy.gaussian import MAX_STD, MIN_STD
    from forgetmimic_jax.robot.model import load_robot
    from forgetmimic_jax.settings.config import preset
    from forgetmimic_jax.tracking.layouts import find_layout
    from forgetmimic_jax.training.folder import prepare_folder

    at_least(0, "--seed", options.seed)
    at_least(1, "--episodes", options.episodes)
    if not MIN_STD <= options.std <= MAX_STD:
        raise InputError(f"--std: found {options.std:g}; accepted: {MIN_STD:g} to {MAX_STD:g}")
    if not options.files:
        raise InputError("FILE: no policy named; accepted: ONNX files and checkpoints of rsl_rl")
    if options.layout is not None:
        find_layout(options.layout)
    output = options.output or Path("runs") / f"import-{options.robot}"
    prepare_folder(output, resume=False)
    references = read_reference(options.reference)
    robot = load_robot(options.robot)
    config = replace_given(preset(options.preset), robot=options.robot, library=options.library, seed=options.seed)
    reading = PolicyReading(
        activation=options.activation, fps=options.fps, start=options.start, own_clip=options.library is None
    )
    if len(options.files) == 1:
        reading = dataclasses.replace(
            reading, layout=options.layout, mode=options.action_mode, order=options.joint_order
        )
    policies = [read_policy(path, robot, config.physics.control_step, reading) for path in options.files]
    if len(policies) == 1:
        made = _one(options, policies[0], config, references)
    else:
        made = _several(options, policies, config, robot, references)
    base = write_base(output, made)
    files = {"base policy": base, **({"library": output / LIBRARY} if made.clips else {})}
    closing(files, command_line("evaluate", robot=options.robot, checkpoint=base))


def _one(options: Options, foreign: ForeignPolicy, config: Config, references: References) -> Adopted:
    """A policy as it is; prints what was read of it and how it did."""
    from forgetmimic_jax.basics.console import say, warn
    from forgetmimic_jax.exchange.adopt import adopt, check_reference, falls
    from forgetmimic_jax.exchange.imported import notes

    made = adopt(foreign, config, std=options.std, episodes=options.episodes, seed=options.seed)
    check_reference(options.reference, references, made.trial.clips)
    _say_read(foreign)
    _say_figures({"": made.trial.clips})
    say("\n".join([*made.facts, *notes(foreign.actor, options.std)]))
    if doubt := falls(foreign, made.trial.clips):
        warn(doubt)
    return made


def _several(
    options: Options, policies: Sequence[ForeignPolicy], config: Config, robot: Robot, references: References
) -> Adopted:
    """One policy of several, by regression; prints what was read of them, and how they and the new one did."""
    from forgetmimic_jax.basics.console import progress, say
    from forgetmimic_jax.exchange import experts
    from forgetmimic_jax.exchange.adopt import Adopted, adopt, check_reference, falls, own_setup
    from forgetmimic_jax.exchange.trial import try_out
    from forgetmimic_jax.training.checkpoint import Progress

    experts.check_clips(policies, options.library)
    wanted = experts.student_config(config, policies, robot, options.layout, options.action_mode)
    taught = [adopt(one, config, std=options.std, episodes=options.episodes, seed=options.seed) for one in policies]
    for foreign, one in zip(policies, taught, strict=True):
        if doubt := falls(foreign, one.trial.clips):
            raise InputError(f"{doubt}; a policy that falls teaches nothing")
    known = {name: tracked for one in taught for name, tracked in one.trial.clips.items()}
    check_reference(options.reference, references, known)
    for foreign, one in zip(policies, taught, strict=True):
        _say_read(foreign)
        say("\n".join(one.facts))
    setup = own_setup(wanted, [clip for one in taught for clip, _ in one.clips])
    teachers = [(experts.expert(one.setup, one.policy, setup), [place]) for place, one in enumerate(taught)]
    trials = []

    def is_enough(student: Policy) -> bool:
        trials.append(try_out(setup, student, episodes=options.episodes, seed=options.seed))
        return not experts.shortfalls(known, trials[-1].clips)

    most = experts.MERGING.rounds + experts.REPEATS * experts.MORE.rounds
    with progress("merge", most, at_most=True) as show:
        student, steps = experts.merge(setup, teachers, is_enough, show)
    trial = trials[-1]
    _say_figures({"experts": known, "new policy": trial.clips})
    shortfalls = experts.shortfalls(known, trial.clips)
    say("\n".join(shortfalls or ["The new policy is within 2 points of survival and 0.02 of reward of every expert."]))
    clips = tuple(pair for one in taught for pair in one.clips)
    return Adopted(setup, student, trial, clips, Progress(0, steps), ())


def _say_read(foreign: ForeignPolicy) -> None:
    """What was taken from where, and what had to be assumed."""
    _say_table(str(foreign.path), [("", "found", "from"), *foreign.rows])


def _say_figures(trials: Mapping[str, Mapping[str, Tracked]]) -> None:
    """The figures of every clip, of one policy after another."""
    from forgetmimic_jax.basics.console import say

    rows = [("clip", "episodes", "survival", "reward", "joint error")]
    for name, clips in trials.items():
        for clip, of in clips.items():
            whole = f"{of.seconds:.1f} of {of.horizon:.1f} s"
            shown = (("no noise", whole, of.reward, of.joint_error),
                     ("reset noise", f"{of.survival:.0%}", of.noisy_reward, of.noisy_joint_error))  # fmt: skip
            for episodes, survival, reward, error in shown:
                label = f"{clip} ({name})" if name else clip
                rows.append((label, episodes, survival, f"{reward:.3f}", f"{error:.3f} rad"))
    _say_table("Roll-outs", rows)
    say(
        "no noise: one episode from the first frame to the clip's end. reset noise: episodes of 10 s at most.\n"
        "reward: mean tracking reward while alive. joint error: mean over steps and joints.\n"
    )


def _say_table(title: str, rows: Sequence[Sequence[str]]) -> None:
    """Rows of text in columns, each as wide as it must be."""
    from forgetmimic_jax.basics.console import say

    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join(f"{cell:<{width}}" for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
    say("\n".join([title, *(f"  {line}" for line in lines), ""]))


if __name__ == "__main__":
    run_command(lambda: main(parse(Options, "import-policy")))
