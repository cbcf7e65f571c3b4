"""Faults of one line, put into a copy of the code one at a time, to see that the tests named for each of them fail.

`make mutants` runs all of them and ends with a table; ARGS='--only NAME ...' runs some, ARGS=--list names them. The
exit code is 1 if a fault goes unnoticed, or if the line that it changes is no longer there. It is no part of
`make test`.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table


class Mutant(NamedTuple):
    """A fault: `old`, which occurs once in `file`, becomes `new`, and a test of the file `tests` is to fail."""

    name: str
    file: str
    tests: str
    breaks: str
    old: str
    new: str


# fmt: off
MUTANTS = (
    # Credit: a step belongs to the episode that it ends, not to the one that starts after it.
    Mutant("credit_clip", "forgetmimic_jax/ppo/collect.py", "tests/ppo/test_iteration.py",
           "An episode's last step counts for the clip of the next episode.",
           "clip=before.clip,",
           "clip=fresh.clip,"),
    Mutant("credit_reward", "forgetmimic_jax/ppo/collect.py", "tests/ppo/test_iteration.py",
           "The anti-reward of an episode's last step follows the next episode's clip.",
           "assets.is_target[before.clip], reward_key",
           "assets.is_target[fresh.clip], reward_key"),
    Mutant("credit_bin", "forgetmimic_jax/ppo/collect.py", "tests/ppo/test_iteration.py",
           "An episode's failure is credited to the bin of the next one.",
           "start_bin=before.start_bin,",
           "start_bin=fresh.start_bin,"),
    Mutant("credit_failure", "forgetmimic_jax/ppo/collect.py", "tests/ppo/test_iteration.py",
           "An ended episode's failure is that of the new one: always 1.",
           "after.tracking_sum, after.step, after.horizon",
           "fresh.tracking_sum, fresh.step, fresh.horizon"),
    Mutant("credit_steps", "forgetmimic_jax/ppo/collect.py", "tests/ppo/test_iteration.py",
           "An ended episode's length is that of the new one: always 0.",
           "steps=after.step,",
           "steps=fresh.step,"),
    # Trials.
    Mutant("task_resume", "forgetmimic_jax/studies/task.py", "tests/studies/test_executor.py",
           "A trial whose process was killed begins anew.",
           "resume = newest_checkpoint(task.folder) is not None",
           "resume = newest_checkpoint(task.folder) is None"),
    Mutant("task_threads", "forgetmimic_jax/studies/executor.py", "tests/studies/test_executor.py",
           "Each of several trials at a time takes all cores.",
           "max(1, cores() // jobs)",
           "max(1, cores() // 1)"),
    Mutant("task_gpu", "forgetmimic_jax/studies/executor.py", "tests/studies/test_executor.py",
           "All trials at a time take one GPU.",
           "for gpu in there:",
           "for gpu in there[:1] * len(there):"),
    Mutant("task_launcher", "forgetmimic_jax/studies/task.py", "tests/studies/test_executor.py",
           "A trial waits for the processes that its worker was started with.",
           "env={**without_others(os.environ), **more}",
           "env={**os.environ, **more}"),
    Mutant("seed_other_run", "forgetmimic_jax/training/folder.py", "tests/commands/test_cluster.py",
           "The folder of a run with other settings counts as that of the training that is asked for.",
           "if found not in accepted:",
           "if False:"),
    Mutant("evidence_scale", "forgetmimic_jax/evidence.py", "tests/commands/test_evidence_command.py",
           "Evidence of fewer trainings counts as that of --full.",
           "if (found.episodes, found.seeds) != (scale.episodes, scale.seeds):",
           "if False:"),
    Mutant("processes_alone", "forgetmimic_jax/training/devices.py", "tests/commands/test_devices.py",
           "Several processes without --devices train into one folder.",
           "if devices % processes:",
           "if devices > 1 and devices % processes:"),
    Mutant("task_mark", "forgetmimic_jax/studies/task.py", "tests/studies/test_executor.py",
           "Two programs run one trial in one folder.",
           "if host != platform.node() or not process.isdigit() or not _is_alive(int(process)):",
           "if True:"),
    Mutant("task_mark_start", "forgetmimic_jax/studies/task.py", "tests/studies/test_executor.py",
           "A mark that an ended process left stops a trial for good when another process has its number.",
           'if _start_of(int(process)) in ("", start) else None',
           "if True else None"),
    Mutant("task_failure", "forgetmimic_jax/studies/executor.py", "tests/studies/test_executor.py",
           "A trial that fails counts as finished.",
           "return future.result() if error is None else",
           "return None if error is None else"),
    # Starts.
    Mutant("target_share", "forgetmimic_jax/tracking/env.py", "tests/ppo/test_iteration.py",
           "A rollout's episodes start without the targets' share.",
           "failure_level, assets.is_target, assets.focus.starts)",
           "failure_level, None, assets.focus.starts)"),
    Mutant("first_frame", "forgetmimic_jax/tracking/rsi.py", "tests/ppo/test_iteration.py",
           "No start of a rollout is moved to the first frame of its clip.",
           "if config.first_frame:",
           "if False:"),
    Mutant("first_bin", "forgetmimic_jax/tracking/rsi.py", "tests/tracking/test_rsi.py",
           "A start that is moved to the first frame counts for the bin that it was drawn from.",
           "index, frame = jnp.where(first, 0, index), jnp.where(first, 0, frame)",
           "index, frame = index, jnp.where(first, 0, frame)"),
    Mutant("edit_noise", "forgetmimic_jax/ppo/collect.py", "tests/ppo/test_iteration.py",
           "States drawn without a simulator have the same reset noise in every batch.",
           "start_episodes(env, assets, episode_key, start",
           "start_episodes(env, assets, draw_key, start"),
    Mutant("reset_noise", "forgetmimic_jax/evaluation/rollout.py", "tests/evaluation/test_rollout.py",
           "Every rollout of an evaluation has other reset noise.",
           "self._begin(self._assets, jax.random.PRNGKey(self._seed))",
           "self._begin(self._assets, jax.random.PRNGKey(np.random.randint(1000)))"),
    Mutant("reset_turn", "forgetmimic_jax/tracking/randomise.py", "tests/tracking/test_randomise.py",
           "Reset noise turns the base about its own axes, not the world's.",
           "rotation.multiply(turn, reference.bodies.quat[:, root])",
           "rotation.multiply(reference.bodies.quat[:, root], turn)"),
    Mutant("failure_signal", "forgetmimic_jax/tracking/rsi.py", "tests/tracking/test_rsi.py",
           "An early death no longer counts as failure.",
           'divisor = horizon if config.failure_signal == "survival_weighted" else steps',
           "divisor = steps"),
    Mutant("failure_average", "forgetmimic_jax/tracking/rsi.py", "tests/tracking/test_rsi.py",
           "Failure levels are averaged once an iteration, not once an episode.",
           "keep = (1.0 - config.smoothing) ** count",
           "keep = 1.0 - config.smoothing"),
    Mutant("sampler_prior", "forgetmimic_jax/tracking/rsi.py", "tests/tracking/test_rsi.py",
           "The uniform part of the adaptive sampler favours clips of many bins.",
           "+ config.uniform_ratio * prior",
           "+ config.uniform_ratio * bins.valid / count"),
    # Advantages and branches.
    Mutant("gae_termination", "forgetmimic_jax/ppo/gae.py", "tests/ppo/test_gae.py",
           "A fall keeps the value of what would have followed.",
           "jnp.where(terminated, 0.0, next_value)",
           "next_value"),
    Mutant("gae_truncation", "forgetmimic_jax/ppo/gae.py", "tests/ppo/test_gae.py",
           "The advantage of the next episode leaks into one that its time ended.",
           "carry_on = 1.0 - (terminated | truncated)",
           "carry_on = 1.0 - terminated"),
    Mutant("gae_order", "forgetmimic_jax/ppo/update.py", "tests/ppo/test_iteration.py",
           "Falls are treated as the end of the clip, and the end of the clip as a fall.",
           "outcome.terminated,\n        outcome.truncated,",
           "outcome.truncated,\n        outcome.terminated,"),
    Mutant("branches_used", "forgetmimic_jax/ppo/update.py", "tests/ppo/test_iteration.py",
           "Branches start together but are never compared.",
           "if config.branches > 1:",
           "if config.branches > 1000:"),
    Mutant("branches_value", "forgetmimic_jax/ppo/update.py", "tests/ppo/test_iteration.py",
           "The critic learns the difference of branches, not what came.",
           "return advantage, value_target",
           "return advantage, advantage + outcome.value"),
    Mutant("branches_own", "forgetmimic_jax/ppo/gae.py", "tests/ppo/test_gae.py",
           "A branch is part of its own baseline.",
           ".sum(-1, keepdims=True) - grouped) / jnp.maximum(others, 1)",
           ".sum(-1, keepdims=True)) / jnp.maximum(others + 1, 1)"),
    Mutant("branches_ended", "forgetmimic_jax/ppo/gae.py", "tests/ppo/test_gae.py",
           "A branch leaves the comparison one step too early.",
           "(jnp.cumsum(done, axis=0) - done) == 0",
           "jnp.cumsum(done, axis=0) == 0"),
    # Losses and methods.
    Mutant("penalty_sign", "forgetmimic_jax/unlearning/arft.py", "tests/unlearning/test_arft.py",
           "The anti-reward pays for tracking the targets.",
           "- penalty * reward",
           "+ penalty * reward"),
    Mutant("kl", "forgetmimic_jax/policy/gaussian.py", "tests/policy/test_network.py",
           "The divergence of two Gaussians has their variances the wrong way round.",
           "variance_ratio = jnp.exp(2.0 * (log_std - new_log_std))",
           "variance_ratio = jnp.exp(2.0 * (new_log_std - log_std))"),
    Mutant("kl_base", "forgetmimic_jax/ppo/loss.py", "tests/unlearning/test_methods.py",
           "The KL to the base is the base's from the policy.",
           "kl_divergence(now.mean, now.log_std, batch.base.mean, batch.base.log_std)",
           "kl_divergence(batch.base.mean, batch.base.log_std, now.mean, now.log_std)"),
    Mutant("base_kl_mask", "forgetmimic_jax/ppo/loss.py", "tests/unlearning/test_methods.py",
           "The KL to the base counts the targets' steps too.",
           "weight = batch.weight * (batch.base_kl > 0)",
           "weight = batch.weight"),
    Mutant("kl_decremental", "forgetmimic_jax/unlearning/decremental.py", "tests/unlearning/test_methods.py",
           "Decremental unlearning keeps by the reversed divergence.",
           "keep = kl_divergence(now.mean, now.log_std, base.mean, base.log_std)",
           "keep = kl_divergence(base.mean, base.log_std, now.mean, now.log_std)"),
    Mutant("kl_policy_edit", "forgetmimic_jax/unlearning/policy_edit.py", "tests/unlearning/test_methods.py",
           "Policy editing keeps by the reversed divergence.",
           "keep = kl_divergence(now.mean, now.log_std, base.mean, base.log_std)",
           "keep = kl_divergence(base.mean, base.log_std, now.mean, now.log_std)"),
    Mutant("base_actor", "forgetmimic_jax/ppo/update.py", "tests/ppo/test_iteration.py",
           "The base's actor reads observations through the learner's normaliser.",
           "batch = make_batch(env.config, assets, transition, outcome.value",
           "learners = assets.base and assets.base.replace(actor_normalizer=state.policy.actor_normalizer)\n"
           "        batch = make_batch(env.config, assets.replace(base=learners), transition, outcome.value"),
    Mutant("base_critic", "forgetmimic_jax/ppo/update.py", "tests/ppo/test_iteration.py",
           "The base's critic reads observations through the learner's normaliser.",
           "batch = make_batch(env.config, assets, transition, outcome.value",
           "learners = assets.base and assets.base.replace(critic_normalizer=state.policy.critic_normalizer)\n"
           "        batch = make_batch(env.config, assets.replace(base=learners), transition, outcome.value"),
    # The step of the environment.
    Mutant("time_reward", "forgetmimic_jax/tracking/env.py", "tests/tracking/test_env.py",
           "A step is compared with the frame that it left.",
           "dataclasses.replace(state, bodies=bodies), ahead=1)",
           "dataclasses.replace(state, bodies=bodies), ahead=0)"),
    Mutant("time_targets", "forgetmimic_jax/tracking/env.py", "tests/tracking/test_env.py",
           "The PD targets are those of the frame that a step leaves.",
           "ahead=1)\n    action",
           "ahead=0)\n    action"),
    Mutant("time_observation", "forgetmimic_jax/tracking/env.py", "tests/tracking/test_layouts.py",
           "The policy sees the frame where it is, not the one that it is to reach.",
           "ahead=1),\n        physics",
           "ahead=0),\n        physics"),
    Mutant("encoder_bias", "forgetmimic_jax/tracking/env.py", "tests/tracking/test_env.py",
           "The encoders' bias moves the robot the wrong way.",
           "assets.robot, reference, action) - state.encoder_bias",
           "assets.robot, reference, action) + state.encoder_bias"),
    Mutant("acceleration", "forgetmimic_jax/tracking/env.py", "tests/tracking/test_env.py",
           "The joints' acceleration is that of the step before.",
           "physics=physics,\n    )",
           "physics=dataclasses.replace(physics, warmstart=state.physics.warmstart),\n    )"),
    Mutant("action_rate", "forgetmimic_jax/tracking/env.py", "tests/tracking/test_env.py",
           "The action rate compares an action with itself.",
           "last_action=state.last_action,\n        joint_target",
           "last_action=action,\n        joint_target"),
    Mutant("torque", "forgetmimic_jax/tracking/env.py", "tests/tracking/test_env.py",
           "The torque's cost leaves out what the action adds.",
           "joint_target=joint_target,",
           "joint_target=reference.joint_pos,"),
    Mutant("last_step", "forgetmimic_jax/tracking/env.py", "tests/tracking/test_env.py",
           "A fall in the last step also counts as the clip's end.",
           "truncated = (steps >= state.horizon) & ~terminated",
           "truncated = steps >= state.horizon"),
    Mutant("wrench_time", "forgetmimic_jax/tracking/env.py", "tests/tracking/test_env.py",
           "The wrench pulls towards the frame where the control step began.",
           "wrench = assist(env, assets, state, fraction)",
           "wrench = assist(env, assets, state)"),
    Mutant("wrench_weight", "forgetmimic_jax/tracking/wrench.py", "tests/tracking/test_wrench.py",
           "The wrench pushes the robot down by its weight.",
           "- robot.gravity)",
           "+ robot.gravity)"),
    # Conventions of orientations.
    Mutant("quaternion_w", "forgetmimic_jax/basics/rotation.py", "tests/basics/test_rotation.py",
           "First row of the product.",
           "aw * bw - ax * bx - ay * by - az * bz",
           "aw * bw + ax * bx - ay * by - az * bz"),
    Mutant("quaternion_x", "forgetmimic_jax/basics/rotation.py", "tests/basics/test_rotation.py",
           "Second row of the product.",
           "aw * bx + ax * bw + ay * bz - az * by",
           "aw * bx + ax * bw - ay * bz + az * by"),
    Mutant("quaternion_y", "forgetmimic_jax/basics/rotation.py", "tests/basics/test_rotation.py",
           "Third row of the product.",
           "aw * by - ax * bz + ay * bw + az * bx",
           "aw * by + ax * bz + ay * bw - az * bx"),
    Mutant("quaternion_z", "forgetmimic_jax/basics/rotation.py", "tests/basics/test_rotation.py",
           "Fourth row of the product.",
           "aw * bz + ax * by - ay * bx + az * bw",
           "aw * bz - ax * by + ay * bx + az * bw"),
    Mutant("rotate_direction", "forgetmimic_jax/basics/rotation.py", "tests/basics/test_rotation.py",
           "Vectors turn the other way: world to body instead of body to world.",
           "return vector + w * t + jnp.cross(xyz, t)",
           "return vector - w * t + jnp.cross(xyz, t)"),
    # Observation layouts.
    Mutant("layout_velocity", "forgetmimic_jax/tracking/layouts.py", "tests/tracking/test_layouts.py",
           "The reference's velocity is shown in the world's axes.",
           "rotation.rotate_inverse(of.bodies.quat[:, body], of.bodies.lin_vel[:, body])",
           "of.bodies.lin_vel[:, body]"),
    Mutant("layout_body", "forgetmimic_jax/tracking/layouts.py", "tests/tracking/test_layouts.py",
           "wbc-mjlab's gravity is the pelvis's, not the torso's.",
           "_gravity(m.reference, m.anchor)",
           "_gravity(m.reference, m.root)"),
    Mutant("layout_columns", "forgetmimic_jax/tracking/layouts.py", "tests/tracking/test_layouts.py",
           "The six numbers of the orientation stand column after column.",
           "columns.reshape(-1, 2, 3).swapaxes(1, 2).reshape(-1, 6)",
           "columns"),
    Mutant("layout_inverted", "forgetmimic_jax/tracking/layouts.py", "tests/tracking/test_layouts.py",
           "The orientation is the robot's seen from the reference.",
           "rotation.multiply(rotation.conjugate(here), there)",
           "rotation.multiply(rotation.conjugate(there), here)"),
    Mutant("layout_pelvis", "forgetmimic_jax/tracking/layouts.py", "tests/tracking/test_layouts.py",
           "The orientation is the pelvis's, not the torso's.",
           "here, there = m.bodies.quat[:, m.anchor], m.reference.bodies.quat[:, m.anchor]",
           "here, there = m.bodies.quat[:, m.root], m.reference.bodies.quat[:, m.root]"),
    Mutant("layout_gyro", "forgetmimic_jax/tracking/layouts.py", "tests/tracking/test_layouts.py",
           "The robot's angular velocity is in the world's axes.",
           "lambda m: m.physics.qvel[:, 3:6]",
           "lambda m: rotation.rotate(_base_quat(m), m.physics.qvel[:, 3:6])"),
    Mutant("layout_noise", "forgetmimic_jax/tracking/observation.py", "tests/tracking/test_layouts.py",
           "The encoders' bias is not seen.",
           "encoder_bias if term.encoder else",
           "0.0 * encoder_bias if term.encoder else"),
    Mutant("layout_order", "forgetmimic_jax/tracking/observation.py", "tests/tracking/test_layouts.py",
           "Joints are seen in the robot's order, not in the policy's.",
           "len(policy_joints))[..., policy_joints].reshape",
           "len(policy_joints)).reshape"),
    Mutant("action_order", "forgetmimic_jax/tracking/action.py", "tests/tracking/test_action.py",
           "Actions in another order of joints are sorted the wrong way round.",
           "action[:, np.argsort(robot.policy_joints)]",
           "action[:, robot.policy_joints]"),
    Mutant("action_offset", "forgetmimic_jax/tracking/action.py", "tests/tracking/test_action.py",
           "An action on the default pose is added to the reference.",
           'reference.joint_pos if mode == "residual" else robot.default_joint_pos',
           "reference.joint_pos"),
    Mutant("action_seen", "forgetmimic_jax/tracking/env.py", "tests/tracking/test_action.py",
           "The last action that is seen is scaled.",
           "last_action=action,\n",
           "last_action=assets.robot.action_scale * action,\n"),
    Mutant("action_gains", "forgetmimic_jax/robot/model.py", "tests/tracking/test_action.py",
           "The gains that a policy expects are not the model's.",
           "stiffness=action.stiffness.get(joint, stiffness),",
           "stiffness=stiffness,"),
    Mutant("export_body", "forgetmimic_jax/exchange/onnx_actor.py", "tests/exchange/test_onnx_actor.py",
           "An export names the torso for terms of the pelvis.",
           "{\"anchor\": robot.anchor, \"root\": robot.root}[layout.body]",
           "robot.anchor"),
    Mutant("export_order", "forgetmimic_jax/exchange/onnx_actor.py", "tests/exchange/test_onnx_actor.py",
           "An export has gains in the robot's order beside names in the policy's.",
           "np.asarray(arrays.stiffness)[order]",
           "np.asarray(arrays.stiffness)"),
    Mutant("import_gains", "forgetmimic_jax/exchange/sources.py", "tests/exchange/test_foreign.py",
           "Gains of deploy.yaml are read in the policy's order of joints.",
           "_table(f\"joint_{key}\", content[key], robot.joint_names, f\"{where}: {key}\")",
           "_table(f\"joint_{key}\", content[key], joints, f\"{where}: {key}\")"),
    Mutant("import_shift", "forgetmimic_jax/exchange/description.py", "tests/exchange/test_foreign.py",
           "The pose of the observation is taken for the action's offset.",
           "origin[joint] - pose[joint]",
           "pose[joint] - origin[joint]"),
    Mutant("import_root", "forgetmimic_jax/exchange/clips.py", "tests/exchange/test_foreign.py",
           "The first body of the clip inside a file is taken for the root, whatever its name.",
           "list(bodies).index(root) if bodies else 0",
           "0"),
    Mutant("import_digits", "forgetmimic_jax/exchange/description.py", "tests/exchange/test_foreign.py",
           "Two sources may differ in their numbers by a tenth.",
           "ROUNDING = 2e-3",
           "ROUNDING = 1e-1"),
    Mutant("expert_last_action", "forgetmimic_jax/exchange/experts.py", "tests/exchange/test_experts.py",
           "An expert sees the student's last action as its own.",
           "jnp.where(episodes.step[:, None] > 0, last_action, 0.0)",
           "episodes.last_action"),
    Mutant("deploy_gains", "forgetmimic_jax/exchange/deployers.py", "tests/exchange/test_deployers.py",
           "deploy.yaml has gains in the policy's order of joints.",
           "\"stiffness\": _numbers(arrays.stiffness),",
           "\"stiffness\": _numbers(arrays.stiffness, order),"),
    Mutant("run_best", "forgetmimic_jax/training/checkpoint.py", "tests/training/test_checkpoint.py",
           "A run's folder stands for its newest checkpoint, though it has a best policy.",
           "return best or newest_checkpoint(directory) or base",
           "return newest_checkpoint(directory) or best or base"),
    Mutant("ended_by", "forgetmimic_jax/evaluation/rollout.py", "tests/evaluation/test_rollout.py",
           "Bounds count that were broken after an episode had ended.",
           "(now & at[offset])",
           "at[offset]"),
    Mutant("carry_target", "forgetmimic_jax/training/carried_over.py", "tests/training/test_carried_over.py",
           "An action on the default pose means another joint target for the other robot.",
           '== "offset":',
           '== "neither":'),
    Mutant("layout_drawn", "forgetmimic_jax/ppo/collect.py", "tests/ppo/test_iteration.py",
           "States drawn without a simulator show the reference's bodies as the robot's.",
           "        episodes = tracking.refresh_bodies(env, episodes, jnp.ones((env.num_envs,), bool))\n",
           ""),
    Mutant("layout_matches", "forgetmimic_jax/training/checkpoint.py", "tests/training/test_checkpoint.py",
           "A policy of another layout of the same size is taken for one of this.",
           '"observation.layout", "action.mode"',
           '"action.mode"'),
    Mutant("align_height", "forgetmimic_jax/tracking/reference.py", "tests/tracking/test_reward.py",
           "Errors of height are aligned away.",
           "jnp.concatenate([anchor_pos[:, :2], ref_pos[:, 2:]], axis=-1)",
           "anchor_pos"),
    # Clips of other projects, and robots of vendors.
    Mutant("clip_turns", "forgetmimic_jax/motion/converting.py", "tests/motion/test_motion_files.py",
           "Turns of 2 pi stay in the joints.",
           "candidates = np.stack([joint_pos, joint_pos - TURN, joint_pos + TURN])",
           "candidates = np.stack([joint_pos, joint_pos, joint_pos])"),
    Mutant("clip_up", "forgetmimic_jax/motion/converting.py", "tests/motion/test_motion_files.py",
           "A world with y up is turned the wrong way.",
           "UPRIGHT = np.array([np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0])",
           "UPRIGHT = np.array([np.sqrt(0.5), -np.sqrt(0.5), 0.0, 0.0])"),
    Mutant("clip_names", "forgetmimic_jax/motion/columns.py", "tests/motion/test_motion_files.py",
           "Columns are taken by their places though they have names.",
           "        joint_names=tuple(joints.values()),\n",
           ""),
    Mutant("clip_shift", "forgetmimic_jax/motion/fit.py", "tests/motion/test_library.py",
           "One low frame lifts the whole clip.",
           "float(lasting.min()) + MAX_SINK",
           "float(lowest.min()) + MAX_SINK"),
    Mutant("clip_order", "forgetmimic_jax/motion/converting.py", "tests/motion/test_motion_files.py",
           "Isaac Lab's order is taken depth first.",
           "return breadth_first(robot) if",
           "return robot.joint_names if"),
    Mutant("clip_rate", "forgetmimic_jax/motion/comparing.py", "tests/motion/test_formats.py",
           "A rate of half is accepted though joint velocities say another.",
           "if abs(ratio - 1.0) > RATE_ERROR:",
           "if abs(ratio - 1.0) > 10.0:"),
    Mutant("clip_doubt", "forgetmimic_jax/motion/plausible.py", "tests/motion/test_plausible.py",
           "A reading that slides is no worse than one that stands.",
           " + slide / SLIDE",
           ""),
    Mutant("clip_jump", "forgetmimic_jax/motion/roughness.py", "tests/motion/test_motion_files.py",
           "A root that jumps is accepted.",
           "    if not len(bad):\n        return\n",
           "    return\n"),
    Mutant("clip_code", "forgetmimic_jax/motion/unpickle.py", "tests/motion/test_readers.py",
           "A pickle may call what it likes.",
           "if (module, name) not in self.ALLOWED:",
           'if (module, name) == ("nothing", "at all"):'),
    Mutant("robot_torque", "forgetmimic_jax/robot/proposal.py", "tests/robot/test_vendor.py",
           "A motor's torque limit is taken from nowhere but its force range.",
           "elif is_motor and model.actuator_ctrllimited[actuator]:",
           "elif False:"),
    Mutant("robot_degrees", "forgetmimic_jax/robot/vendor.py", "tests/robot/test_vendor.py",
           "Ranges of the YAML are taken for degrees in a file of degrees.",
           "np.degrees(limits) if spec.compiler.degree else list(limits)",
           "list(limits)"),
    Mutant("robot_knee", "forgetmimic_jax/robot/standing.py", "tests/robot/test_vendor.py",
           "Knees bend about their axis whatever way it points.",
           "turn * float(np.sign(axes[tree.model.joint(joint).id, 1]))",
           "turn"),
    Mutant("teacher_enough", "forgetmimic_jax/training/standing.py", "tests/training/test_standing.py",
           "A teacher that still falls learns no longer.",
           "if upright < TAUGHT and learning is not longer:",
           "if False:"),
    Mutant("teacher_resumed", "forgetmimic_jax/training/standing.py", "tests/training/test_standing.py",
           "A longer training of the teacher that was stopped ends early.",
           "learning = longer if found == longer.config else learning",
           "learning = learning"),
    # Evaluation.
    Mutant("success", "forgetmimic_jax/evaluation/metrics.py", "tests/evaluation/test_metrics.py",
           "A fall in the last step is a success.",
           "(rollout.length == rollout.horizon)",
           "(rollout.length >= rollout.horizon - 1)"),
    Mutant("survival_weight", "forgetmimic_jax/evaluation/metrics.py", "tests/evaluation/test_metrics.py",
           "What a policy misses after a fall costs nothing.",
           '"survival_weighted_tracking": tracked / rollout.horizon',
           '"survival_weighted_tracking": tracked / rollout.length'),
    Mutant("rate_interval", "forgetmimic_jax/evaluation/statistics.py", "tests/evaluation/test_statistics.py",
           "The interval of a success rate is an approximation.",
           'method="exact"',
           'method="wilson"'),
    Mutant("strata", "forgetmimic_jax/evaluation/statistics.py", "tests/evaluation/test_statistics.py",
           "The bootstrap no longer keeps each clip's share.",
           "members = np.flatnonzero(strata == stratum)",
           "members = np.arange(len(strata))"),
    Mutant("strata_size", "forgetmimic_jax/evaluation/statistics.py", "tests/evaluation/test_statistics.py",
           "Resamples weigh less than the sample.",
           "* (n / (n - 1.0))",
           ""),
    Mutant("verdict_lost_clip", "forgetmimic_jax/attacks/verdict.py", "tests/evaluation/test_verdict.py",
           "A kept clip that was lost hides in the mean of the others.",
           "if skill.high < KEPT_CLIP:",
           "if skill.high < -1.0:"),
    Mutant("verdict_negative", "forgetmimic_jax/evaluation/skill.py", "tests/evaluation/test_verdict.py",
           "A negative skill on one clip pays for another.",
           "sum(max(0.0, skill) for skill in skills)",
           "sum(skills)"),
    Mutant("verdict_below", "forgetmimic_jax/attacks/verdict.py", "tests/evaluation/test_verdict.py",
           "A policy below the zero-action baseline can be consistent with retraining.",
           "for clip, skill in targets.items() if skill.high < BELOW}",
           "for clip, skill in targets.items() if skill.high < -9.0}"),
    # What a policy does instead, and when a run stops.
    Mutant("stand_last_action", "forgetmimic_jax/unlearning/stand.py", "tests/unlearning/test_stand_method.py",
           "The teacher sees the last action against the clip's reference, not the stand's.",
           "jnp.where(episodes.step[:, None] == 0, 0.0, last_action)",
           "moment.last_action"),
    Mutant("stand_first_action", "forgetmimic_jax/unlearning/stand.py", "tests/unlearning/test_stand_method.py",
           "At the start of an episode the teacher sees a last action that no one took.",
           "jnp.where(episodes.step[:, None] == 0, 0.0, last_action)",
           "last_action"),
    Mutant("stand_taught", "forgetmimic_jax/unlearning/stand.py", "tests/unlearning/test_stand_method.py",
           "The taught action is against the frame that the robot is at, not the one to reach.",
           "reference = lookup(assets.library, episodes.clip, episodes.frame + 1)",
           "reference = lookup(assets.library, episodes.clip, episodes.frame)"),
    Mutant("stand_kl", "forgetmimic_jax/unlearning/stand.py", "tests/unlearning/test_methods.py",
           "The divergence to the teacher is the teacher's from the policy.",
           "kl_divergence(now.mean, now.log_std, taught, base.log_std)",
           "kl_divergence(taught, base.log_std, now.mean, now.log_std)"),
    Mutant("stand_place", "forgetmimic_jax/tracking/reference.py", "tests/tracking/test_stand_reference.py",
           "A reference that is moved to the robot keeps the direction of its velocities.",
           "lin_vel=rotation.rotate(turn[:, None], reference.bodies.lin_vel),",
           "lin_vel=reference.bodies.lin_vel,"),
    Mutant("reference_kept", "forgetmimic_jax/tracking/env.py", "tests/unlearning/test_stand_method.py",
           "The reference of a kept clip is replaced too.",
           "select_rows(assets.is_target[state.clip], instead_of_clip",
           "select_rows(assets.is_target[state.clip] | True, instead_of_clip"),
    Mutant("reference_step", "forgetmimic_jax/tracking/env.py", "tests/unlearning/test_stand_method.py",
           "A robot whose reference is the stand is rewarded for the clip.",
           "reference = reference_of(env, assets, dataclasses.replace(state, bodies=bodies), ahead=1)",
           "reference = lookup(assets.library, state.clip, state.frame + 1)"),
    Mutant("fall_onset", "forgetmimic_jax/tracking/stand.py", "tests/tracking/test_runs_on.py",
           "A robot that lies at the start falls with its first step.",
           "stood & (low(robot, after) | tilts)",
           "low(robot, after) | stood & tilts"),
    Mutant("lying_tilt", "forgetmimic_jax/tracking/stand.py", "tests/tracking/test_runs_on.py",
           "A robot that lies falls when the clip gets up.",
           "stood & (low(robot, after) | tilts)",
           "stood & low(robot, after) | tilts"),
    Mutant("runs_on_kept", "forgetmimic_jax/tracking/env.py", "tests/tracking/test_runs_on.py",
           "Kept clips run on after their end too.",
           "left += env.runs_on * assets.is_target[start.clip]",
           "left += env.runs_on"),
    Mutant("runs_on_bounds", "forgetmimic_jax/tracking/env.py", "tests/tracking/test_runs_on.py",
           "An episode of a target that runs on is still terminated by the bounds on tracking.",
           "{name: broken & ~is_target for name, broken in causes.items()}",
           "dict(causes)"),
    Mutant("stop_clips", "forgetmimic_jax/training/stopping.py", "tests/training/test_stopping.py",
           "A target below the baseline pays for another in the stop rule.",
           "mean_retained(skill.tolist())",
           "float(skill.mean())"),
    Mutant("evidence_clips", "forgetmimic_jax/attacks/performance.py", "tests/attacks/test_performance.py",
           "Evidence pools the targets.",
           "performance.of([name]), **given",
           "performance.of(clips), **given"),
    Mutant("stop_row", "forgetmimic_jax/training/stopping.py", "tests/training/test_stopping.py",
           "A run stops at the second look at the baseline, whatever was between.",
           "in_a_row = in_a_row + 1 if skill <= AT_BASELINE else 0",
           "in_a_row += skill <= AT_BASELINE"),
    Mutant("settle_kl", "forgetmimic_jax/training/stopping.py", "tests/training/test_stopping.py",
           "A run that settles holds the kept clips no more than before.",
           "else KEEP * self._base_kl",
           "else self._base_kl"),
    Mutant("stop_resume", "forgetmimic_jax/training/stopping.py", "tests/training/test_stopping.py",
           "A run that is resumed has forgotten what its stop rule saw.",
           "if resumed is not None and resumed.curriculum is not None:",
           "if False:"),
    Mutant("settle", "forgetmimic_jax/ppo/update.py", "tests/ppo/test_update.py",
           "A run that settles takes whole steps.",
           "focus.settle * learning_rate",
           "learning_rate"),
    # Pretraining.
    Mutant("average", "forgetmimic_jax/ppo/update.py", "tests/training/test_pretraining.py",
           "The averaged parameters are those of the newest iteration.",
           "old + (new - old) / iterations",
           "new"),
    Mutant("kept_average", "forgetmimic_jax/training/pretraining.py", "tests/training/test_pretraining.py",
           "Pretraining evaluates and keeps the newest parameters.",
           "position.state.averaged, self._curriculum",
           "position.state.policy, self._curriculum"),
    Mutant("expert", "forgetmimic_jax/training/curriculum.py", "tests/training/test_curriculum.py",
           "A distillation that fails loses the experts.",
           "self.expert(self.specialist) if self.specialist else self.best",
           "self.best"),
    Mutant("score", "forgetmimic_jax/training/curriculum.py", "tests/training/test_curriculum.py",
           "The score of a clip is its tracking alone.",
           "0.5 * (self.success + self.tracking)",
           "self.tracking"),
    # Devices.
    Mutant("shard_noise", "forgetmimic_jax/ppo/sharding.py", "tests/commands/test_devices.py",
           "All devices draw the same noise.",
           "own = jax.random.fold_in(state.key, jax.lax.axis_index(AXIS))",
           "own = state.key"),
    Mutant("shard_gradient", "forgetmimic_jax/ppo/update.py", "tests/commands/test_devices.py",
           "Every device takes its own gradient.",
           "gradient, metrics = average(jax.grad(loss_of, has_aux=True)(parameters, data))",
           "gradient, metrics = jax.grad(loss_of, has_aux=True)(parameters, data)"),
    Mutant("shard_advantage", "forgetmimic_jax/basics/shards.py", "tests/ppo/test_shards.py",
           "Advantages are normalised on each device.",
           "mean = average(values.mean(axis))",
           "mean = values.mean(axis)"),
    Mutant("shard_weight", "forgetmimic_jax/ppo/loss.py", "tests/ppo/test_shards.py",
           "A device without steps of targets counts as much as one with many.",
           "jnp.maximum(average(weight.sum()), 1.0 / shards())",
           "jnp.maximum(weight.sum(), 1.0)"),
    Mutant("shard_clips", "forgetmimic_jax/ppo/loss.py", "tests/ppo/test_shards.py",
           "Clips weigh the same on each device, not over all of them.",
           "size = total(jnp.zeros(groups).at[group.reshape(-1)].add(1.0))",
           "size = jnp.zeros(groups).at[group.reshape(-1)].add(1.0)"),
    Mutant("shard_sampler", "forgetmimic_jax/tracking/rsi.py", "tests/ppo/test_shards.py",
           "Failure levels learn the episodes of one device.",
           "return total(jax.ops.segment_sum(values, flat",
           "return (jax.ops.segment_sum(values, flat"),
    Mutant("shard_normalizer", "forgetmimic_jax/policy/normalizer.py", "tests/ppo/test_shards.py",
           "Normalisers count the steps of one device.",
           "count = jnp.float32(shards() * flat.shape[0])",
           "count = jnp.float32(flat.shape[0])"),
    Mutant("devices_divide", "forgetmimic_jax/settings/config.py", "tests/commands/test_devices.py",
           "Branches of one state may be on two devices.",
           "if groups % config.devices:",
           "if ppo.num_envs % config.devices:"),
    # Studies.
    Mutant("membership_twins", "experiments/membership.py", "tests/experiments/test_measures.py",
           "Clips and their mirror images are exchanged.",
           "attack_targets(rollout, twins[key], is_target)",
           "attack_targets(twins[key], rollout, is_target)"),
    Mutant("membership_clips", "forgetmimic_jax/evaluation/membership.py", "tests/experiments/test_measures.py",
           "The attack learns on the targets and is wanted about the kept clips.",
           "attack((clips[~is_target], images[~is_target]), (clips[is_target], images[is_target]))",
           "attack((clips[is_target], images[is_target]), (clips[~is_target], images[~is_target]))"),
    Mutant("relearning_base", "experiments/relearning.py", "tests/experiments/test_measures.py",
           "Relearning is measured against the unlearned policy, not the base.",
           'first["base"], lab.targets)',
           'first["unlearned"], lab.targets)'),
    Mutant("relearning_clips", "experiments/relearning.py", "tests/experiments/test_measures.py",
           "Relearning starts from kept clips only.",
           'watched = {"clips": "all", ',
           'watched = {"clips": "kept", '),
    Mutant("relearning_base_kl", "experiments/relearning.py", "tests/experiments/test_measures.py",
           "Relearning has a KL to the policy that it starts from.",
           '"schedule": "fixed", "base_kl": 0.0}',
           '"schedule": "fixed", "base_kl": 1.0}'),
    Mutant("unit_of_repeats", "forgetmimic_jax/evaluation/repeats.py", "tests/evaluation/test_repeats.py",
           "The interval over bases counts every seed as a base.",
           "means if len(of_base) > 1",
           "list(values.values()) if len(of_base) > 1"),
    Mutant("bases_share", "forgetmimic_jax/studies/claim.py", "tests/studies/test_claim.py",
           "A number that is only bounded has every seed of a base as a unit.",
           'units = nothing["n"]',
           "units = len(values)"),
    Mutant("overlap_sign", "experiments/overlap.py", "tests/experiments/test_findings.py",
           "What lies near a target loses more where it is far from it.",
           "rises, 0.0, evidence, below=False, main=True",
           "rises, 0.0, evidence, below=True, main=True"),
    Mutant("overlap_others", "experiments/overlap.py", "tests/experiments/test_findings.py",
           "A clip is compared with all kept clips, itself among them.",
           "for clip in kept if clip != neighbour",
           "for clip in kept"),
    # Pretraining a control.
    Mutant("left_out", "forgetmimic_jax/training/pretraining.py", "tests/training/test_pretraining.py",
           "A clip that is left out counts in the phases.",
           "if name not in left_out",
           "if name"),
    Mutant("left_out_starts", "forgetmimic_jax/tracking/rsi.py", "tests/training/test_pretraining.py",
           "A clip without a bin to start from makes every probability undefined.",
           "jnp.maximum(probabilities.sum(-1, keepdims=True), 1e-12)",
           "probabilities.sum(-1, keepdims=True)"),
    # Physics and signals: nothing waits forever.
    Mutant("lapack_order", "forgetmimic_jax/physics/mjx.py", "tests/physics/test_mjx.py",
           "Two factorisations of MJX's step may run at once, which two cores never end.",
           "jnp.where(jnp.isfinite(data.qacc).all(), damping, jnp.nan)",
           "damping"),
    Mutant("second_signal", "forgetmimic_jax/basics/signals.py", "tests/basics/test_signals.py",
           "A second Ctrl-C or SIGTERM ends nothing.",
           "if received == 2:",
           "if received == 3:"),
    # Evidence: attacks on an unlearned policy, and the verdict from them.
    Mutant("variant_speed", "forgetmimic_jax/attacks/near_duplicates.py", "tests/attacks/test_near_duplicates.py",
           "A faster copy of a clip is a slower one.",
           "fps=clip.fps * factor",
           "fps=clip.fps / factor"),
    Mutant("variant_amplitude", "forgetmimic_jax/attacks/near_duplicates.py", "tests/attacks/test_near_duplicates.py",
           "Amplitude is about zero angles, not about the clip's mean pose.",
           "mean + factor * (clip.joint_pos - mean)",
           "factor * clip.joint_pos"),
    Mutant("variant_blend", "forgetmimic_jax/attacks/near_duplicates.py", "tests/attacks/test_near_duplicates.py",
           "Joints of a blend are matched by place, not by name.",
           "theirs.joint_pos[:, order]",
           "theirs.joint_pos"),
    Mutant("splice_fade", "forgetmimic_jax/attacks/splices.py", "tests/attacks/test_splices.py",
           "What differs at a seam fades along a line, with a jump of the velocity.",
           "(1.0 - time**2 * (3.0 - 2.0 * time))[:, None]",
           "(1.0 - time)[:, None]"),
    Mutant("splice_cut", "forgetmimic_jax/attacks/splices.py", "tests/attacks/test_splices.py",
           "A second is inserted where it fits worst.",
           "cuts[np.argmin(into + out)]",
           "cuts[np.argmax(into + out)]"),
    Mutant("warping_diagonal", "forgetmimic_jax/attacks/warping.py", "tests/attacks/test_look_alikes.py",
           "A step in both motions counts once.",
           "total[:, row, column] + 2.0 * here",
           "total[:, row, column] + here"),
    Mutant("quantised_levels", "forgetmimic_jax/attacks/numerics.py", "tests/attacks/test_numerics.py",
           "Four bits have a level too many.",
           "2 ** (bits - 1) - 1",
           "2 ** (bits - 1)"),
    Mutant("quantised_scale", "forgetmimic_jax/attacks/numerics.py", "tests/attacks/test_numerics.py",
           "A layer has one scale for all outputs.",
           "jnp.abs(weights).max(axis=0)",
           "jnp.abs(weights).max()"),
    Mutant("content_window", "forgetmimic_jax/attacks/performance.py", "tests/attacks/test_performance.py",
           "Motion content of a part is of the episode up to its end.",
           "(steps >= first[:, None])",
           "(steps >= 0)"),
    Mutant("forgotten_mean", "forgetmimic_jax/attacks/verdict.py", "tests/attacks/test_evidence_verdict.py",
           "A mean of at most 20 % is forgotten, whatever its interval.",
           "own.high <= FORGOTTEN or (above and",
           "own.mean <= FORGOTTEN + 0.05 or (above and"),
    Mutant("forgotten_control", "forgetmimic_jax/attacks/verdict.py", "tests/attacks/test_evidence_verdict.py",
           "What the control does too counts as known.",
           "(above and above.high <= ALIKE)",
           "False"),
    Mutant("recovered_mean", "forgetmimic_jax/attacks/verdict.py", "tests/attacks/test_evidence_verdict.py",
           "A recovery counts by its mean.",
           "True if above.low > RECOVERED",
           "True if above.mean > RECOVERED"),
    Mutant("kept_variants", "forgetmimic_jax/attacks/verdict.py", "tests/attacks/test_evidence_verdict.py",
           "Near-duplicates of kept clips may be lost.",
           "return (True if lost else None), words",
           "return None, words"),
    Mutant("filter_elsewhere", "forgetmimic_jax/attacks/fakes.py", "tests/attacks/test_fakes.py",
           "The fake that falls on everything unfamiliar falls on what it knows.",
           "(known ^ self.elsewhere)",
           "known"),
    Mutant("relearning_settled", "forgetmimic_jax/attacks/relearning.py", "tests/attacks/test_parts.py",
           "The control's training ends when it has had half of a chance.",
           "curve.target_steps[-1] > steps_to_beat",
           "curve.target_steps[-1] > 0.5 * steps_to_beat"),
    Mutant("parts_of_another", "forgetmimic_jax/attacks/parts.py", "tests/attacks/test_parts.py",
           "Parts of another policy are taken for this one's.",
           "if theirs.get(name) != ours.get(name):",
           "if name not in theirs:"),
    # Episodes without terminations.
    Mutant("impact_last", "forgetmimic_jax/physics/impact.py", "tests/physics/test_impact.py",
           "Only the last physics step of a control step is looked at.",
           "largest = np.maximum(largest, force)",
           "largest = force"),
    Mutant("impact_feet", "forgetmimic_jax/physics/impact.py", "tests/physics/test_impact.py",
           "A foot on the floor is an impact.",
           "not_feet = [body for body in touching if body not in robot.pairs.feet]",
           "not_feet = touching"),
    Mutant("impact_speed", "forgetmimic_jax/physics/impact.py", "tests/physics/test_impact.py",
           "The speed of an impact is that of the last contact, not of the first.",
           "(largest <= CONTACT_FORCE) & (force > CONTACT_FORCE)",
           "force > CONTACT_FORCE"),
    Mutant("self_collision", "forgetmimic_jax/robot/model.py", "tests/physics/test_impact.py",
           "A robot that lies on the floor passes through itself.",
           "    spec, model = robot.spec.copy(), robot.model\n    _let_shapes_touch(spec)\n",
           "    spec, model = robot.spec.copy(), robot.model\n"),
    Mutant("held_frame", "forgetmimic_jax/tracking/reference.py", "tests/evaluation/test_unbounded.py",
           "The frame that is held after a clip's end keeps its velocities.",
           "return _at_rest_where(frame > last, library.at(clip, frame))",
           "return library.at(clip, frame)"),
    Mutant("next_clip", "forgetmimic_jax/motion/library.py", "tests/motion/test_library.py",
           "After a clip's end the next clip begins.",
           "self.start[clip] + jnp.minimum(frame, self.length[clip] - 1)",
           "self.start[clip] + frame"),
    Mutant("fall_of_clip", "forgetmimic_jax/tracking/stand.py", "tests/evaluation/test_unbounded.py",
           "A tilt is a fall even where the clip is tilted.",
           "return tilted(robot, bodies) & ~tilted(robot, clip)",
           "return tilted(robot, bodies)"),
    Mutant("fall_after_lean", "forgetmimic_jax/tracking/stand.py", "tests/tracking/test_runs_on.py",
           "A robot that still leans when the clip does so no longer never falls.",
           "~tilted_unlike_clip(robot, before, clip_before)",
           "~tilted_unlike_clip(robot, before, clip_after)"),
    Mutant("content_held", "forgetmimic_jax/evaluation/unbounded.py", "tests/evaluation/test_unbounded.py",
           "Motion content counts the held frame as a part of the clip.",
           "content = 1.0 - mean(happened.deviation, of_clip)",
           "content = 1.0 - mean(happened.deviation)"),
    Mutant("lying_start", "forgetmimic_jax/evaluation/unbounded.py", "tests/evaluation/test_unbounded.py",
           "A robot that starts lying counts as one that fell.",
           "stood = ~rollout.lying_at_start",
           "stood = rollout.lying_at_start == rollout.lying_at_start"),
    Mutant("fall_time", "forgetmimic_jax/evaluation/unbounded.py", "tests/evaluation/test_unbounded.py",
           "A fall is seen a control step before it happens.",
           "falls.argmax(axis=1) + 1)",
           "falls.argmax(axis=1))"),
    Mutant("impact_rate", "forgetmimic_jax/evaluation/unbounded.py", "tests/evaluation/test_unbounded.py",
           "An impact of exactly one body weight is above one.",
           '"impact_rate": (impact > 1.0)',
           '"impact_rate": (impact >= 1.0)'),
    Mutant("from_frame_0", "forgetmimic_jax/evaluation/unbounded.py", "tests/evaluation/test_unbounded.py",
           "Starts from frame 0 are all starts.",
           "members & (rollout.start_frame == 0), seed)",
           "members, seed)"),
    Mutant("quantile", "forgetmimic_jax/evaluation/statistics.py", "tests/evaluation/test_unbounded.py",
           "A quantile's interval does not follow the resamples.",
           "    resampled = quantile(weights)\n",
           "    resampled = quantile(np.ones_like(weights))\n"),
    Mutant("film_hold", "forgetmimic_jax/viewing/takes.py", "tests/viewing/test_takes.py",
           "A film of a target ends with the clip.",
           "stage.hold if name in targets else 0",
           "0"),
    Mutant("page_fall", "forgetmimic_jax/viewing/playback.py", "tests/viewing/test_playback.py",
           "The page forgets a fall when the robot gets up.",
           "if falls and self.fell[policy] is None:",
           "if falls:"),
    # Several processes: all go the way of the first.
    Mutant("agreed_alone", "forgetmimic_jax/training/devices.py", "tests/commands/test_devices.py",
           "Every process ends where its own evaluation says, and waits for ever for the others.",
           "return value if jax.process_count() == 1 else",
           "return value if True else"),
)
# fmt: on

TIME_LIMIT = 600  # s for the tests of one mutant
ROOT = Path(__file__).resolve().parents[1]
LEFT_OUT = shutil.ignore_patterns(".*", "runs", "build", "__pycache__", "*.egg-info")


def main(arguments: list[str] | None = None) -> int:
    """The command; returns its exit code."""
    parser = argparse.ArgumentParser(prog="make mutants", description="See which faults of one line the tests notice.")
    parser.add_argument("--list", action="store_true", help="name the mutants, and those that no longer fit the code")
    parser.add_argument("--only", nargs="+", metavar="NAME", help="try these alone")
    wanted = parser.parse_args(arguments)
    by_name = {mutant.name: mutant for mutant in MUTANTS}
    for name in wanted.only or ():
        if name not in by_name:
            parser.error(f"no mutant '{name}'; --list names them")
    chosen = [by_name[name] for name in wanted.only or by_name]
    console = Console(width=None if sys.stdout.isatty() else 140)
    if wanted.list:
        outdated = {mutant: message for mutant in chosen if (message := misfit(mutant, ROOT))}
        console.print(table({mutant: outdated.get(mutant, "") for mutant in chosen}))
        return 1 if outdated else 0
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that the copy is removed and the tests end
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        tree = Path(folder) / "copy"
        shutil.copytree(ROOT, tree, ignore=LEFT_OUT)
        unnoticed = try_all(chosen, tree, console)
    console.print(f"{len(chosen) - len(unnoticed)} of {len(chosen)} mutants were noticed")
    if unnoticed:
        console.print(table(unnoticed))
    return 1 if unnoticed else 0


def try_all(chosen: list[Mutant], tree: Path, console: Console) -> dict[Mutant, str]:
    """Each mutant in a copy of the working tree; returns those that no test noticed, and what happened instead."""
    columns = (TextColumn("{task.description}"), BarColumn(bar_width=20), MofNCompleteColumn())
    times = (TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn(compact=True))
    unnoticed = {}
    fails_anyway: dict[str, bool] = {}
    with Progress(*columns, *times, console=console) as bar:
        task = bar.add_task("", total=len(chosen))
        for mutant in chosen:
            bar.update(task, description=mutant.name)
            begin = time.monotonic()
            problem, killer = misfit(mutant, tree), ""
            if not problem:
                if mutant.tests not in fails_anyway:
                    fails_anyway[mutant.tests] = run_tests(tree, mutant.tests)[0] != 0
                if fails_anyway[mutant.tests]:
                    problem = f"{mutant.tests} fails without a mutant too"
                else:
                    problem, killer = try_one(mutant, tree)
            if problem:
                unnoticed[mutant] = problem
            message = f"{time.monotonic() - begin:4.0f} s  {mutant.name}: {problem or killer}"
            console.print(message, markup=False, highlight=False, soft_wrap=True)
            bar.advance(task)
    return unnoticed


def try_one(mutant: Mutant, tree: Path) -> tuple[str, str]:
    """Puts the mutant into the tree for as long as its tests run; returns what went wrong or '', and the failing test.

    Only a test that fails notices a mutant: one that breaks an import, or never ends, shows nothing.
    """
    path = tree / mutant.file
    text = path.read_text()
    path.write_text(text.replace(mutant.old, mutant.new))
    try:
        code, output = run_tests(tree, mutant.tests)
    finally:
        path.write_text(text)
    if code == 0:
        return "SURVIVED", ""
    if code is None:
        return f"no result within {TIME_LIMIT} s", ""
    failed = re.search(r"^(?:FAILED|ERROR) \S+?::(\S+)", output, re.MULTILINE)
    if code != 1 or failed is None:
        return "the tests could not run: " + output.strip().split("\n")[-1], ""
    return "", failed[1]


def misfit(mutant: Mutant, tree: Path) -> str:
    """Why the mutant does not fit the code, or ''."""
    for name in (mutant.file, mutant.tests):
        if not (tree / name).exists():
            return f"no file {name}"
    count = (tree / mutant.file).read_text().count(mutant.old)
    return "" if count == 1 else f"its text occurs {count} times in {mutant.file}, not once"


def run_tests(tree: Path, tests: str) -> tuple[int | None, str]:
    """Exit code and output of pytest, which stops at the first failure; None where it ran out of time."""
    options = ["-x", "-q", "--tb=no", "-rfE", "-p", "no:cacheprovider"]
    process = subprocess.Popen(
        [sys.executable, "-m", "pytest", *options, tests],
        cwd=tree,
        env={**os.environ, "PYTHONPATH": str(tree), "PYTHONDONTWRITEBYTECODE": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )
    try:
        output, _ = process.communicate(timeout=TIME_LIMIT)
        return process.returncode, output
    except subprocess.TimeoutExpired:
        return None, ""
    finally:
        if process.poll() is None:  # out of time, or interrupted: it ends with all that it started
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def table(rows: dict[Mutant, str]) -> Table:
    """Mutants, what each breaks, and what is to be said of it."""
    result = Table("mutant", "what it breaks", "tests", "", box=None, header_style="bold")
    for mutant, message in rows.items():
        result.add_row(mutant.name, mutant.breaks, Path(mutant.tests).name, message)
    return result


if __name__ == "__main__":
    sys.exit(main())
