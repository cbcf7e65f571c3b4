"""Stand instead: on a target clip the policy does what its teacher does where the reference is a stand.

Ours; near to it are DAgger (Ross et al. 2011, "A Reduction of Imitation Learning and Structured Prediction to No-Regret
Online Learning") and policy distillation (Rusu et al. 2016). The teacher is the base, after training on standing where
it needs that (training/standing.py). Its observation has the stand reference in the place of the clip's, all that is
measured on the robot stays, and the last action is that of the same joint targets against the stand reference. On
target steps KL(π ‖ N(teacher's action, σ_base)), on kept steps KL(π ‖ π_base). No reward is used. The states are those
that the policy visits: only a fall terminates an episode of a target clip, which runs on after the clip's end.
`unlearn.instead` may also name a kept clip.
"""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
from jax import Array

from forgetmimic_jax.policy.gaussian import entropy, kl_divergence
from forgetmimic_jax.ppo.loss import Batch, Prediction, mean
from forgetmimic_jax.settings.config import Config
from forgetmimic_jax.tracking.action import in_robot_order, to_action, to_joint_target
from forgetmimic_jax.tracking.env import Assets, Environment, EnvState, instead_of_clip, moment_of
from forgetmimic_jax.tracking.layouts import Moment
from forgetmimic_jax.tracking.observation import actor_observation, in_policy_order
from forgetmimic_jax.tracking.reference import lookup
from forgetmimic_jax.tracking.stand import STAND
from forgetmimic_jax.unlearning.method import SHORT, Method, Pace


def teacher_moment(env: Environment, assets: Assets, episodes: EnvState) -> Moment:
    """The robot as it is, beside the reference to follow instead, with the last action in the terms of the latter."""
    mode, moment = env.config.action.mode, moment_of(env, assets, episodes)
    sent = to_joint_target(
        mode, assets.robot, lookup(assets.library, episodes.clip, episodes.frame), episodes.last_action
    )
    last_action = to_action(mode, assets.robot, instead_of_clip(env, assets, episodes, ahead=0), sent)
    return dataclasses.replace(
        moment,
        reference=instead_of_clip(env, assets, episodes, ahead=1),
        last_action=jnp.where(episodes.step[:, None] == 0, 0.0, last_action),
    )


def taught_action(env: Environment, assets: Assets, episodes: EnvState) -> Array:
    """The teacher's action [env, joint] in the policy's terms: the one that sends the same joint targets."""
    mode, robot, moment = env.config.action.mode, env.robot, teacher_moment(env, assets, episodes)
    assert assets.teacher is not None
    action = assets.teacher.mean_action(actor_observation(env.layout, robot.policy_joints, moment))
    joint_target = to_joint_target(mode, assets.robot, moment.reference, in_robot_order(robot, action))
    reference = lookup(assets.library, episodes.clip, episodes.frame + 1)
    return in_policy_order(to_action(mode, assets.robot, reference, joint_target), robot.policy_joints)


def regression(config: Config, batch: Batch, now: Prediction, iteration: Array) -> tuple[Array, dict[str, Array]]:
    """Towards the teacher and value 0 on target steps, towards the base on kept ones."""
    base, taught, weight = batch.base, batch.transition.taught, config.unlearn.settings["keep"]
    assert base is not None
    assert taught is not None
    on_target, kept = batch.weight * batch.is_target, batch.weight * ~batch.is_target
    learn = mean(kl_divergence(now.mean, now.log_std, taught, base.log_std), on_target)
    keep = mean(kl_divergence(now.mean, now.log_std, base.mean, base.log_std), kept)
    policy_term = learn + weight * keep
    value_term = mean(now.value**2, on_target) + mean((now.value - base.value) ** 2, kept)
    loss = policy_term + config.ppo.value_cost * value_term
    metrics = {"policy_loss": policy_term, "value_loss": value_term, "entropy": entropy(now.log_std)}
    return loss, metrics | {"teacher_kl": learn, "base_kl": keep}


# A regression: the number of gradient steps decides, they may be large, and a rollout serves many of them.
SHORT_REGRESSION = {**SHORT, "branches": 1, "minibatches": 12, "epochs": 4, "learning_rate": 1.5e-3}
# A user starts a clip at its first frame, and that frame may be the hardest of all.
PACE = Pace({"cpu": 100, "paper": 400}, {"cpu": SHORT_REGRESSION}, {"cpu": 0.5}, first_frame=0.5)
METHOD = Method(
    loss=regression,
    teach=taught_action,
    runs_on=1.0,
    settings={"keep": 4.0, "stand_iterations": 160.0},
    pace=PACE,
    instead=STAND,
)
