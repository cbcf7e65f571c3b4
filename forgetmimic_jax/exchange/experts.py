"""Several policies, each of its own clips, become one: regression of a fresh network on what each would do.

The regression is `training.distil`. Here is what makes a foreign policy a teacher: it sees its own layout, in its own
order of joints, and its joint targets are put in the student's terms. The robot's gains must be one and the same.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from forgetmimic_jax.basics.console import Show
from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.exchange.foreign import ForeignPolicy
from forgetmimic_jax.exchange.trial import Tracked
from forgetmimic_jax.policy.policy import Policy
from forgetmimic_jax.ppo.state import init_state
from forgetmimic_jax.robot.model import Robot, RobotArrays
from forgetmimic_jax.settings.config import ActionConfig, Config, ObservationConfig
from forgetmimic_jax.tracking.action import to_action, to_joint_target
from forgetmimic_jax.tracking.env import Assets, EnvState, make_assets, make_environment
from forgetmimic_jax.tracking.layouts import Moment, find_layout
from forgetmimic_jax.tracking.observation import actor_observation
from forgetmimic_jax.tracking.reference import lookup
from forgetmimic_jax.tracking.setup import Setup
from forgetmimic_jax.training.distil import DistilConfig, begin, make_round
from forgetmimic_jax.training.teaching import make_teaching

GAINS = 0.02  # share by which two policies' gains may differ: two of a project's digits
STUDENT_LAYERS = (512, 256, 128)
STUDENT_STD = 0.4  # in units of action: of the regression's loss, and of the exploration that fine-tuning starts with
ROBOTS = 512
MERGING = DistilConfig(rounds=112, noise_rounds=16, normalizer_rounds=48)  # 16 rounds a share of the experts
MORE = DistilConfig(rounds=48, expert_share=(0.0,), noise_rounds=0, normalizer_rounds=0)  # of a student that is behind
REPEATS = 4  # of MORE, at most


@struct.dataclass
class Expert:
    """A policy that observes the student's episodes by itself: a `training.teaching.Teacher`."""

    policy: Policy
    robot: RobotArrays  # with the policy's own default pose and scale
    layout: str = struct.field(pytree_node=False)
    mode: Literal["residual", "offset"] = struct.field(pytree_node=False)
    joints: tuple[int, ...] = struct.field(pytree_node=False)  # the robot's, in the policy's order
    student_mode: Literal["residual", "offset"] = struct.field(pytree_node=False)
    student_joints: tuple[int, ...] = struct.field(pytree_node=False)
    anchor: int = struct.field(pytree_node=False)
    root: int = struct.field(pytree_node=False)

    def action(self, assets: Assets, episodes: EnvState, observation: Array, noise_key: Array | None) -> Array:
        """Actions [env, joint] in the student's terms.

        The last action that it sees is the one of its own that stands for the robots' last joint targets.
        """
        reached = lookup(assets.library, episodes.clip, episodes.frame)
        ahead = lookup(assets.library, episodes.clip, episodes.frame + 1)
        last_target = to_joint_target(self.student_mode, assets.robot, reached, episodes.last_action)
        last_action = to_action(self.mode, self.robot, reached, last_target)
        moment = Moment(
            robot=self.robot,
            reference=ahead,
            physics=episodes.physics,
            bodies=episodes.bodies,
            last_action=jnp.where(episodes.step[:, None] > 0, last_action, 0.0),
            anchor=self.anchor,
            root=self.root,
        )
        joints = np.array(self.joints)
        action = self.policy.mean_action(actor_observation(find_layout(self.layout), joints, moment))
        joint_target = to_joint_target(self.mode, self.robot, ahead, action[:, np.argsort(joints)])
        in_students_terms = to_action(self.student_mode, assets.robot, ahead, joint_target)
        return in_students_terms[:, np.array(self.student_joints)]


def expert(setup: Setup, policy: Policy, student: Setup) -> Expert:
    """A policy under its own setup as a teacher of a student under another, both of the same robot and gains."""
    return Expert(
        policy=policy,
        robot=setup.robot.arrays,
        layout=setup.config.observation.layout,
        mode=setup.config.action.mode,
        joints=tuple(map(int, setup.robot.policy_joints)),
        student_mode=student.config.action.mode,
        student_joints=tuple(map(int, student.robot.policy_joints)),
        anchor=student.robot.anchor,
        root=student.robot.root,
    )


def student_config(
    config: Config, policies: Sequence[ForeignPolicy], robot: Robot, layout: str | None, mode: str | None
) -> Config:
    """The settings of the policy that several become: the layout and mode named or common, the robot's own pose.

    Args:
        config: of the preset.
        policies: the experts.
        robot: without any policy's tables.
        layout: that the student is to see; None: that of all of them.
        mode: of the student's actions; None: that of all of them.

    Raises:
        InputError: layouts or modes that differ where none is named, or gains that differ.
    """
    layouts = sorted({policy.description.layout.name for policy in policies})
    modes = sorted({policy.description.action.mode for policy in policies})
    choices = (("--layout", layout, layouts), ("--action-mode", mode, modes))
    open_ones = [(flag, " and ".join(found)) for flag, given, found in choices if given is None and len(found) > 1]
    if open_ones:
        flags, found = zip(*open_ones, strict=True)
        raise InputError(f"{' and '.join(flags)}: the policies have {', '.join(found)}; name that of the new policy")
    gains = {name: _gains(name, policies, robot) for name in ("stiffness", "damping")}
    action = ActionConfig(mode or modes[0], **gains)  # type: ignore[arg-type]
    contact = max(policy.config(config).termination.contact_force for policy in policies)
    return dataclasses.replace(
        config,
        observation=ObservationConfig(layout or layouts[0]),
        action=action,
        termination=dataclasses.replace(config.termination, contact_force=contact),
        ppo=dataclasses.replace(config.ppo, actor_layers=STUDENT_LAYERS, initial_std=STUDENT_STD),
    )


def check_clips(policies: Sequence[ForeignPolicy], library: Path | None) -> None:
    """InputError unless every policy comes with a clip of its own, of another name than the others'."""
    if library is not None:
        raise InputError(
            "--library: found with several policies; accepted with one: each of several needs its own clip"
        )
    names: dict[str, Path] = {}
    for policy in policies:
        if policy.clip is None:
            raise InputError(f"{policy.path}: no clip in it, and not one .csv or .npz beside it; a policy that is to "
                             f"become one with others needs its clip")  # fmt: skip
        if policy.clip.name in names:
            raise InputError(f"{policy.path}: its clip is called {policy.clip.name}, as that of "
                             f"{names[policy.clip.name]}; rename one of the files")  # fmt: skip
        names[policy.clip.name] = policy.path


def shortfalls(experts: Mapping[str, Tracked], student: Mapping[str, Tracked]) -> list[str]:
    """A sentence for every clip on which the student is more than 2 points of survival or 0.02 of reward behind."""
    lines = []
    for clip, expert in experts.items():
        found = student[clip]
        if expert.survival - found.survival > MERGING.success_tolerance + 1e-9:
            lines.append(f"{clip}: survival {found.survival:.0%}, the expert's is {expert.survival:.0%}.")
        if expert.noisy_reward - found.noisy_reward > MERGING.reward_tolerance:
            lines.append(f"{clip}: reward {found.noisy_reward:.3f}, the expert's is {expert.noisy_reward:.3f}.")
    return lines


def _gains(name: Literal["stiffness", "damping"], policies: Sequence[ForeignPolicy], robot: Robot) -> dict[str, float]:
    """The table of gains that all policies share; empty if it is the robot's own."""
    own = dict(zip(robot.joint_names, map(float, getattr(robot.arrays, name)), strict=True))
    tables: list[Mapping[str, float]] = [own | getattr(policy.description.action, name) for policy in policies]
    for policy, table in zip(policies, tables, strict=True):
        for joint in robot.joint_names:
            if abs(table[joint] - tables[0][joint]) > GAINS * abs(tables[0][joint]):
                raise InputError(
                    f"{policy.path}: {name}: {joint}: {table[joint]:.4g}, but {policies[0].path} has "
                    f"{tables[0][joint]:.4g}; policies of one base need the same gains"
                )
    same = all(abs(tables[0][joint] - own[joint]) <= GAINS * abs(own[joint]) for joint in own)
    return {} if same else dict(tables[0])


def merge(
    student: Setup,
    experts: Sequence[tuple[Expert, Sequence[int]]],
    is_enough: Callable[[Policy], bool],
    progress: Show = lambda done, steps, metrics: None,
) -> tuple[Policy, int]:
    """Regress a fresh policy on experts, each with the clips of the student's library that it teaches.

    DAgger (Ross et al. 2011): the experts' share of the steps falls from 1 to 0, every state is labelled by the expert
    of its clip. Starts are spread over the clips, with reset noise. A student that is not enough then learns on its own
    states alone, for `MORE.rounds` at a time.

    Args:
        student: robot, clips and settings of the new policy.
        experts: with the indices of their clips.
        is_enough: whether a student is as good as its experts.
        progress: called after each round with the rounds and control steps done and the round's metrics.

    Returns:
        The policy, and the control steps that it took.

    Raises:
        InputError: the regression's loss is not finite.
    """
    env = make_environment(student, ROBOTS, noisy=False)
    assets = make_assets(student)
    key = jax.random.PRNGKey(student.config.seed)
    fresh = jax.jit(lambda assets, key: init_state(env, assets, key).policy)(assets, key)
    teaching = make_teaching(assets, experts)
    state = begin(env, assets, teaching, fresh, key)
    first, more = (MERGING, make_round(env, MERGING)), (MORE, make_round(env, MORE))
    done = steps = 0
    for config, one_round in (first, *(more,) * REPEATS):
        state = dataclasses.replace(state, round=jnp.zeros((), jnp.int32))
        for _ in range(config.rounds):
            state, metrics = one_round(assets, teaching, state)
            done, steps = done + 1, steps + ROBOTS * config.steps
            shown = {name: float(value) for name, value in metrics.items()}
            _check_finite(shown, done)
            progress(done, steps, shown)
        if is_enough(state.student):
            break
    return state.student, steps


def _check_finite(metrics: Mapping[str, float], done: int) -> None:
    for name, value in metrics.items():
        if not math.isfinite(value):
            raise InputError(
                f"regression on the policies: {name}: found {value} in round {done}; accepted: finite numbers; does "
                f"each policy alone give sound figures (import-policy FILE)?"
            )
