"""An exported policy at work in plain MuJoCo: one robot, sensors, onnxruntime, PD targets. No JAX in the loop.

What the policy sees and what its actions ask for is worked out by `exchange.deployed`, from the file's own metadata.
What the robot did is judged afterwards by the tracking reward and the terminations of the evaluation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from forgetmimic_jax.evaluation.metrics import Rollout
from forgetmimic_jax.exchange.deployed import Deployed
from forgetmimic_jax.exchange.onnx_actor import OnnxActor
from forgetmimic_jax.motion.library import Frames, MotionLibrary
from forgetmimic_jax.physics import BodyState
from forgetmimic_jax.physics.engine import contact_sensor_columns
from forgetmimic_jax.robot.model import Robot
from forgetmimic_jax.settings.config import Config
from forgetmimic_jax.tracking import reward
from forgetmimic_jax.tracking.env import EnvState
from forgetmimic_jax.tracking.reference import align_to_anchor, lookup
from forgetmimic_jax.tracking.termination import terminations

_BODIES = ("pos", "quat", "lin_vel", "ang_vel", "contact_force")


@dataclass(frozen=True)
class Record:
    """What a policy saw and did in its episodes, one after another."""

    rollout: Rollout
    observations: np.ndarray  # f32[step, features]
    actions: np.ndarray  # f32[step, joint]


def run_episodes(
    actor: OnnxActor,
    robot: Robot,
    library: MotionLibrary,
    config: Config,
    start: EnvState,
    *,
    progress: Callable[[int, int], None] = lambda episodes, steps: None,
) -> Record:
    """Every episode of `start`, from its state to the end of its horizon, falls or not.

    Args:
        actor: the policy.
        robot: whose model is stepped.
        library: the clips to track.
        config: of the physics, the reward and the bounds that end an episode.
        start: the episodes (`Evaluator.start`).
        progress: called after each episode with the number of episodes and control steps done.
    """
    numbers = range(len(library.names))
    references = [jax.tree.map(lambda values: values.astype(np.float64), library.clip(number)) for number in numbers]
    clips, frames, horizons = np.asarray(start.clip), np.asarray(start.frame), np.asarray(start.horizon)
    deployed = Deployed(actor, robot)
    episodes: list[dict[str, np.ndarray]] = []
    for clip, frame, horizon, qpos, qvel in zip(
        clips, frames, horizons, np.asarray(start.physics.qpos), np.asarray(start.physics.qvel), strict=True
    ):
        ahead = jax.tree.map(lambda values: values[frame + 1 : frame + 1 + horizon], references[clip])  # noqa: B023
        episodes.append(_run_episode(deployed, ahead, config.physics.substeps, qpos, qvel))
        progress(len(episodes), sum(len(episode["action"]) for episode in episodes))
    steps = {name: np.concatenate([episode[name] for episode in episodes]) for name in episodes[0]}
    tracked = np.concatenate([frame + 1 + np.arange(horizon) for frame, horizon in zip(frames, horizons, strict=True)])
    normalized, broken = _judge(config, robot, library, np.repeat(clips, horizons), tracked, steps)

    rewards = np.zeros((len(clips), horizons.max()), np.float32)
    lengths = horizons.copy()
    ends = np.cumsum(horizons)
    for episode, (begin, end) in enumerate(zip(ends - horizons, ends, strict=True)):
        rewards[episode, : end - begin] = normalized[begin:end]
        fallen = np.flatnonzero(broken[begin:end])
        if fallen.size:  # the step that breaks a bound does not count, but an episode lasts at least one
            lengths[episode] = max(1, fallen[0])
    rollout = Rollout(clip=clips, start_frame=frames, horizon=horizons, length=lengths, tracking_reward=rewards)
    return Record(rollout, steps["observation"], steps["action"])


def _run_episode(
    deployed: Deployed, reference: Frames, substeps: int, qpos: np.ndarray, qvel: np.ndarray
) -> dict[str, np.ndarray]:
    """The states [step, ...] that the policy leads the robot through, and what it saw and did."""
    model, data = deployed.model, mujoco.MjData(deployed.model)
    data.qpos[:], data.qvel[:] = qpos, qvel
    mujoco.mj_fwdPosition(model, data)
    action = np.zeros(len(deployed.joints), np.float32)
    key_bodies = deployed.robot.key_body_ids
    forces = contact_sensor_columns(deployed.robot)
    steps = []
    for i in range(len(reference.joint_pos)):
        frame = jax.tree.map(lambda values: values[i], reference)  # noqa: B023
        observation = deployed.observation(data, frame, action)
        action = deployed.actor(observation)
        data.ctrl[:] = deployed.joint_target(frame, action)
        mujoco.mj_step(model, data, substeps)
        force = -data.sensordata[forces]
        mujoco.mj_fwdPosition(model, data)  # the bodies, where the last substep left the joints
        mujoco.mj_fwdVelocity(model, data)
        velocity = np.zeros((len(key_bodies), 6))
        for body, row in zip(key_bodies, velocity, strict=True):
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, body, row, 0)
        steps.append(
            {
                "observation": observation,
                "action": action,
                "qpos": data.qpos.copy(),
                "qvel": data.qvel.copy(),
                "pos": data.xpos[key_bodies],
                "quat": data.xquat[key_bodies],
                "lin_vel": velocity[:, 3:],
                "ang_vel": velocity[:, :3],
                "contact_force": force,
            }
        )
    return {name: np.stack([step[name] for step in steps]).astype(np.float32) for name in steps[0]}


def _judge(
    config: Config,
    robot: Robot,
    library: MotionLibrary,
    clip: np.ndarray,
    frame: np.ndarray,
    steps: dict[str, np.ndarray],
) -> tuple[np.ndarray, np.ndarray]:
    """Normalised tracking reward f[step] and whether a bound is broken bool[step]: steps take the environments' place.

    Args:
        config: of the reward and the bounds.
        robot: names and indices.
        library: the clips tracked.
        clip: i[step].
        frame: i[step] the frame that was to be reached.
        steps: the states reached.
    """
    reference = lookup(library, jnp.asarray(clip), jnp.asarray(frame))
    bodies = BodyState(**{name: jnp.asarray(steps[name]) for name in _BODIES})
    anchor = robot.anchor
    aligned = align_to_anchor(reference, anchor, bodies.pos[:, anchor], bodies.quat[:, anchor])
    joint_pos, joint_vel = jnp.asarray(steps["qpos"][:, 7:]), jnp.asarray(steps["qvel"][:, 6:])
    kernels = reward.tracking_kernels(reward.Pair(reference, aligned, bodies, joint_pos, joint_vel, anchor))
    causes = terminations(config.termination, reference, aligned, bodies, robot)
    normalized = reward.tracking_reward(kernels, config.reward)[1]
    return np.asarray(normalized), np.asarray(jnp.stack(list(causes.values())).any(0))
