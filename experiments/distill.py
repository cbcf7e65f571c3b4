"""One policy from several: `python -m experiments.distill OUTPUT --student CHECKPOINT --teachers CLIP=CHECKPOINT ...`.

Every clip has a teacher: the specialist named for it, or else the student as it was. The student lives the episodes,
more and more of them by its own actions (DAgger: Ross et al. 2011), and its actor and critic are regressed on what the
teacher of the clip would do and expect there. `--found` adds to a teacher's actions what `feasibility.py` found for its
clip, and so makes the first policy that survives what no noise around the old one would have hit on.
"""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from experiments.feasibility import RESULT, straight_lines
from forgetmimic_jax.basics.errors import InputError, nearest, run_command

ENVIRONMENTS, STEPS, EPISODE = 512, 24, 80  # a round's, and at most of an episode
EPOCHS, MINIBATCHES, LEARNING_RATE = 4, 24, 3e-4  # the step size falls to 0 over the second half
FIRST_SHARE, ALONE = 0.8, 0.6  # of environments that a teacher moves at first; share of the rounds until none is
ACTION_STD = 0.15  # of the noise on every action lived, so that mistakes and their correction are seen
CLIP_SHARE = 0.5  # of the episodes for the clips with a named teacher


@dataclass
class Options:
    """Regress one policy on the teachers of its clips."""

    output: tyro.conf.Positional[Path]
    """Where the new checkpoint goes."""
    student: Path
    """The checkpoint to start from, and the teacher of every clip without another."""
    teachers: Annotated[tuple[str, ...], tyro.conf.arg(metavar="CLIP=CHECKPOINT")] = ()
    """Specialists."""
    found: Annotated[tuple[str, ...], tyro.conf.arg(metavar="CLIP")] = ()
    """Clips whose teacher acts with what feasibility.py found for them on top."""
    search: Path = RESULT
    """What feasibility.py found."""
    rounds: int = 80
    """Of 512 environments × 24 steps."""
    seed: int = 0


def correction(search: Path, clip: str, cycle: int) -> np.ndarray:
    """What the search adds to the actions of a clip, [frame of the cycle, joint]."""
    clips = json.loads(search.read_text())["clips"]
    if "knots" not in clips.get(clip, {}):
        raise InputError(f"--found: {search} has nothing for '{clip}'; {nearest(clip, clips)}")
    of = clips[clip]
    knots = np.asarray(of["knots"])
    added = np.zeros((cycle, knots.shape[1]))
    added[(of["start"] + np.arange(of["window"])) % cycle] = straight_lines(len(knots), of["window"]) @ knots
    return added


def cycle_of(joint_pos: np.ndarray) -> int:
    """Frames after which a clip's joint angles [frame, joint] come again; all of them, if they never do."""
    for cycle in range(10, len(joint_pos) // 2):
        if np.abs(joint_pos[cycle:] - joint_pos[:-cycle]).max() < 1e-3:
            return cycle
    return len(joint_pos)


def distill(options: Options) -> None:
    """The command."""
    import jax
    import jax.numpy as jnp
    import optax

    from forgetmimic_jax.basics.console import closing, progress
    from forgetmimic_jax.evaluation.rollout import act
    from forgetmimic_jax.policy import network
    from forgetmimic_jax.policy.network import normalize
    from forgetmimic_jax.ppo.state import init_state, make_actor, make_critic
    from forgetmimic_jax.settings.config import UnlearnConfig
    from forgetmimic_jax.tracking import env as tracking
    from forgetmimic_jax.training import checkpoint, runner

    if options.output.exists():
        raise InputError(f"{options.output}: exists already; choose another, or remove it")
    runner.check_writable(options.output)
    info = checkpoint.read_info(options.student)
    config = info.config
    config = dataclasses.replace(
        config,
        base=None,
        max_episode_steps=EPISODE,
        unlearn=UnlearnConfig(),
        ppo=dataclasses.replace(config.ppo, num_envs=ENVIRONMENTS, branches=1),
        sampling=dataclasses.replace(config.sampling, clips="all", target_share=0.0),
        wrench=dataclasses.replace(config.wrench, max_gain=0.0),
    )
    setup = runner.make_setup(config)
    env, assets, library, shapes = setup.env, setup.assets, setup.library, runner.template(setup)
    actor, critic = make_actor(config, setup.robot.num_joints), make_critic(config)

    def load(path: Path) -> Any:
        of = checkpoint.read_info(path)
        checkpoint.check_matches(of, setup.robot, library, setup.library_hash, config)
        return checkpoint.load_policy(path, shapes)

    for teacher in options.teachers:
        if not all(teacher.partition("=")):
            raise InputError(f"--teachers: found '{teacher}'; accepted: CLIP=CHECKPOINT")
    named = dict(teacher.partition("=")[::2] for teacher in options.teachers)
    runner.check_targets(tuple({*named, *options.found}), library.names)
    student = load(options.student)
    paths = sorted(set(named.values()))
    policies = [student, *(load(Path(path)) for path in paths)]
    teacher_of = jnp.asarray([1 + paths.index(named[name]) if name in named else 0 for name in library.names])
    shifts = {}
    for name in options.found:
        clip = library.names.index(name)
        cycle = cycle_of(np.asarray(library.joint_pos[clip, : int(library.length[clip])]))
        shifts[clip] = jnp.asarray(correction(options.search, name, cycle), jnp.float32)
    special = np.isin(library.names, [*named, *options.found])
    share = np.where(special, CLIP_SHARE / max(special.sum(), 1), (1 - CLIP_SHARE * special.any()) / (~special).sum())
    valid = np.asarray(assets.bins.valid)
    probabilities = jnp.asarray(valid / valid.sum(1, keepdims=True) * share[:, None], jnp.float32)
    gains = jnp.zeros_like(probabilities)

    def taught(policies, episodes, actor_obs, critic_obs):
        """The action [env, joint] and value [env] of each episode's teacher."""
        mine = teacher_of[episodes.clip]
        actions = jnp.stack([act(env, policy, actor_obs) for policy in policies])
        values = jnp.stack(
            [network.value(critic, p.critic, normalize(p.critic_normalizer, critic_obs)) for p in policies]
        )
        action = jnp.take_along_axis(actions, mine[None, :, None], 0)[0]
        for clip, added in shifts.items():
            action += jnp.where((episodes.clip == clip)[:, None], added[episodes.frame % len(added)], 0.0)
        return action, jnp.take_along_axis(values, mine[None], 0)[0]

    @jax.jit
    def live(assets, policies, parameters, episodes, key, share):
        """A round: the observations and lessons [step, env] and whether the episodes died there."""
        by_teacher = jax.random.uniform(jax.random.fold_in(key, 0), (env.num_envs, 1)) < share

        def one_step(episodes, key):
            observe_key, action_key, step_key, reset_key = jax.random.split(key, 4)
            actor_obs, critic_obs = tracking.observe(env, assets, episodes, observe_key)
            lesson = taught(policies, episodes, actor_obs, critic_obs)
            seen = normalize(student.actor_normalizer, actor_obs)
            action = jnp.where(by_teacher, lesson[0], network.distribution(actor, parameters[0], seen)[0])
            action += ACTION_STD * jax.random.normal(action_key, action.shape)
            after, result = tracking.step(env, assets, episodes, action, step_key)
            done = result.terminated | result.truncated
            fresh = tracking.reset_where(env, assets, after, done, reset_key, probabilities, gains)
            privileged = normalize(student.critic_normalizer, critic_obs)
            return fresh, ((seen, privileged, *lesson), result.terminated)

        return jax.lax.scan(one_step, episodes, jax.random.split(key, STEPS))

    optimizer = optax.chain(optax.clip_by_global_norm(config.ppo.max_gradient_norm), optax.scale_by_adam())
    std = jnp.exp(student.actor["params"]["log_std"])

    @jax.jit
    def learn(parameters, optimizer_state, lessons, key, learning_rate):
        seen, privileged, action, value = (x.reshape(-1, *x.shape[2:]) for x in lessons)

        def loss(parameters, at):
            mean = network.distribution(actor, parameters[0], seen[at])[0]
            # Squares are the Kullback-Leibler divergence; far away the loss is linear, for a search's lessons are far.
            wrong = optax.huber_loss((mean - action[at]) / std).sum(-1).mean()
            return wrong + ((network.value(critic, parameters[1], privileged[at]) - value[at]) ** 2).mean(), wrong

        def minibatch(carry, at):
            parameters, optimizer_state = carry
            gradient, wrong = jax.grad(loss, has_aux=True)(parameters, at)
            updates, optimizer_state = optimizer.update(gradient, optimizer_state)
            return (jax.tree.map(lambda p, u: p - learning_rate * u, parameters, updates), optimizer_state), wrong

        def epoch(carry, key):
            return jax.lax.scan(minibatch, carry, jax.random.permutation(key, len(value)).reshape(MINIBATCHES, -1))

        (parameters, optimizer_state), wrong = jax.lax.scan(
            epoch, (parameters, optimizer_state), jax.random.split(key, EPOCHS)
        )
        return parameters, optimizer_state, wrong[-1].mean()

    state = init_state(env, assets, jax.random.PRNGKey(options.seed), student)
    everywhere = jnp.ones((env.num_envs,), bool)
    key, start_key = jax.random.split(state.key)
    episodes = tracking.reset_where(env, assets, state.env, everywhere, start_key, probabilities, gains)
    parameters = (student.actor, student.critic)
    optimizer_state = optimizer.init(parameters)
    with progress("distill", options.rounds) as report:
        for done in range(1, options.rounds + 1):
            key, live_key, learn_key = jax.random.split(key, 3)
            share = max(0.0, FIRST_SHARE * (1.0 - done / (ALONE * options.rounds)))
            learning_rate = LEARNING_RATE * min(1.0, 2.0 * (1.0 - (done - 1) / options.rounds))
            episodes, (lessons, died) = live(assets, policies, parameters, episodes, live_key, share)
            parameters, optimizer_state, wrong = learn(parameters, optimizer_state, lessons, learn_key, learning_rate)
            report(
                done, done * ENVIRONMENTS * STEPS, {"divergence": float(wrong), "deaths_per_step": float(died.mean())}
            )
    level = checkpoint.load_failure_level(options.student, shapes)
    policy = dataclasses.replace(student, actor=parameters[0], critic=parameters[1])
    checkpoint.save_checkpoint(
        options.output,
        dataclasses.replace(state, policy=policy, failure_level=level),
        info.config,
        setup.robot,
        library,
        setup.library_hash,
        environment_steps=info.environment_steps + options.rounds * ENVIRONMENTS * STEPS,
        resumable=False,
    )
    closing({"policy": options.output}, f"make evaluate ROBOT={config.robot} CHECKPOINT={options.output}")


if __name__ == "__main__":
    given = tyro.cli(Options, prog="python -m experiments.distill", config=(tyro.conf.FlagCreatePairsOff,))
    run_command(lambda: distill(given))
