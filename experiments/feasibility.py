"""Could the robot do what the policy fails to do? `python experiments/feasibility.py [CHECKPOINT]`.

Every clip from its first frame, without reset noise: where the policy falls first. There a search that knows the future
takes over: the cross-entropy method on what is added to the policy's actions over the steps around the fall, as knots
joined by straight lines. What it finds is possible for this robot and these bounds; where it finds nothing, a search
of this size did not, which is a hint and no proof. It goes on under reset noise, for what `distill.py` is to teach must
not hang on one state. `--draw` rewrites the page from the stored numbers alone.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from forgetmimic_jax.studies.study import measured_page, named_policy

HERE = Path(__file__).parent
RESULT = HERE / "results" / "feasibility.json"
PAGE = HERE / "feasibility.md"
BEFORE, WINDOW, AFTER, KNOT = 25, 45, 30, 4  # control steps: before the fall, searched, to live after, between knots
ROLLOUTS, ROUNDS, ELITES = 384, 45, 48
NOISY_ROUNDS, NOISY_ELITES = 30, 96  # luck counts for less among more of them
STARTING_STD, LEAST_STD, KEEP = 1.5, 0.15, 0.3  # of what is added, in units of action; share of the old estimate

TEXT = """# Could the robot do what the policy fails to do?

Every clip of the G1 from its first frame, without reset noise, by the mean actions of `{policy}`
({environment_steps:,} environment steps). Where it falls, a search that knows the future takes over {before} steps
earlier: the cross-entropy method ({rounds} rounds of {rollouts} rollouts) on what is added to the policy's actions
over {window} control steps, for tracking reward and for not falling, then and in the {after} steps after them. It
goes on for {noisy_rounds} rounds whose every rollout has other reset noise. Seed 0.
`.venv/bin/python experiments/feasibility.py CHECKPOINT` measures it again (some five minutes a clip on two cores),
`--draw` rewrites this page from `results/feasibility.json`.

| clip | policy falls at frame | searched from | policy lives | search lives | tracking of both | under noise |
|---|---|---|---|---|---|---|
{rows}

*Lives*: control steps of those searched and after, the longest of the search's last exact round; *tracking*: mean
tracking reward over them, 0 after a fall; *under noise*: share of {rollouts} rollouts with reset noise that what was
found lives through without looking. Clips that are not in the table are lived through. What a search finds, the robot
can do; where it finds nothing, the motion may be beyond the motors or the bounds, or the search too small.
"""


def without_reset_noise(config):
    """The evaluation's settings with every episode starting exactly on the reference."""
    from forgetmimic_jax.evaluation.rollout import evaluation_config

    names = ("position", "orientation", "linear_velocity", "angular_velocity")
    nothing = {f"reset_{name}": (0.0, 0.0, 0.0) for name in names} | {"reset_joint_position": 0.0}
    config = evaluation_config(config)
    return dataclasses.replace(config, noise=dataclasses.replace(config.noise, **nothing))


def straight_lines(knots: int, steps: int) -> np.ndarray:
    """Weights [step, knot] of the knots, evenly spread over the steps, in what is added at each step."""
    places = np.linspace(0, knots - 1, steps)
    return np.stack([np.interp(places, np.arange(knots), one) for one in np.eye(knots)], axis=-1)


def measure(checkpoint_path: Path) -> dict:
    """First falls, and a search at each."""
    import jax
    import jax.numpy as jnp

    from forgetmimic_jax.evaluation.rollout import Evaluator, act, begin_episodes, evaluation_config
    from forgetmimic_jax.tracking import env as tracking
    from forgetmimic_jax.training import checkpoint, runner

    info = checkpoint.read_info(checkpoint_path)
    config = dataclasses.replace(info.config, base=None)
    setup = runner.make_setup(config)
    policy = checkpoint.load_policy(checkpoint_path, runner.template(setup))
    names, lengths, assets = setup.library.names, np.asarray(setup.library.length), setup.assets

    def roller(config):
        """roll(clip, start, knots [rollout, knot, joint], steps searched, steps in all, key)."""
        env = tracking.make_environment(config, setup.robot, ROLLOUTS, noisy=False)

        def roll(clip, start, knots, window: int, steps: int, key):
            """Steps lived and mean tracking, each [rollout]."""
            state = begin_episodes(env, assets, key, jnp.full(ROLLOUTS, clip), jnp.full(ROLLOUTS, start, jnp.int32))
            state = tracking.refresh_bodies(env, state, jnp.ones(ROLLOUTS, bool))
            added = jnp.einsum("sk,rkj->srj", straight_lines(knots.shape[1], window).astype(np.float32), knots)
            added = jnp.concatenate([added, jnp.zeros((steps - window, *added.shape[1:]))])

            def one_step(carry, added):
                state, alive, lived, tracked = carry
                action = act(env, policy, tracking.observe(env, assets, state, None)[0]) + added
                state, result = tracking.step(env, assets, state, action, jax.random.PRNGKey(0))
                alive = alive & ~result.terminated
                tracked = tracked + jnp.where(alive, result.reward.normalized_tracking, 0.0)
                return (state, alive, lived + alive, tracked), None

            zeros = jnp.zeros(ROLLOUTS)
            (_, _, lived, tracked), _ = jax.lax.scan(one_step, (state, zeros == 0, zeros, zeros), added)
            return lived, tracked / steps

        return jax.jit(roll, static_argnums=(3, 4))

    quiet = without_reset_noise(config)
    exact, noisy = roller(quiet), roller(evaluation_config(config))
    alone = Evaluator(quiet, setup.robot, setup.library, episodes=1, seed=0).rollout(policy)  # each from frame 0
    found = {}
    for clip in np.flatnonzero(alone.length < alone.horizon):
        fall, last = int(alone.length[clip]), int(lengths[clip]) - 1
        start = max(0, fall - BEFORE)
        window = min(WINDOW, last - start)
        steps = min(WINDOW + AFTER, last - start)

        def lives(roll, knots, seed, clip=clip, start=start, window=window, steps=steps):
            rolled = roll(clip, start, jnp.asarray(knots, jnp.float32), window, steps, jax.random.PRNGKey(seed))
            return tuple(np.asarray(x) for x in rolled)

        rng = np.random.default_rng(0)
        mean = np.zeros((max(2, window // KNOT), setup.robot.num_joints))
        std = np.full_like(mean, STARTING_STD)
        history = []
        for number in range(ROUNDS + NOISY_ROUNDS):
            knots = mean + std * rng.standard_normal((ROLLOUTS, *mean.shape))
            if number < ROUNDS:
                knots[0] = mean
            lived, tracked = lives(exact if number < ROUNDS else noisy, knots, number)
            if number == 0:
                policy_alone = float(lived[0]), float(tracked[0])
            if number < ROUNDS:
                longest = np.argmax(lived / steps + tracked)
                history.append((float(lived[longest]), float(tracked[longest])))
            order = np.argsort(-(lived / steps + tracked))
            best = knots[order[: ELITES if number < ROUNDS else NOISY_ELITES]]
            mean = KEEP * mean + (1 - KEEP) * best.mean(0)
            std = np.maximum(KEEP * std + (1 - KEEP) * best.std(0), LEAST_STD)
        lived, _ = lives(noisy, np.repeat(mean[None], ROLLOUTS, 0), ROUNDS + NOISY_ROUNDS)
        found[names[clip]] = {
            "fall": fall,
            "start": start,
            "window": window,
            "steps": steps,
            "policy": policy_alone,
            "rounds": history,
            "lived_under_noise": float(np.mean(lived >= steps)),
            "knots": np.round(mean, 3).tolist(),
        }
        print(
            f"{names[clip]}: the policy lives {policy_alone[0]:.0f} of {steps} steps, the search {history[-1][0]:.0f}"
        )
    return {
        "policy": "/".join(checkpoint_path.parts[-3:]),
        "environment_steps": info.environment_steps,
        "clips": found,
    }


def page(found: dict) -> str:
    """The page of the stored numbers."""
    rows = []
    for name, clip in found["clips"].items():
        (policy_lives, policy_tracks), (lives, tracks) = clip["policy"], clip["rounds"][-1]
        rows.append(
            f"| {name} | {clip['fall']} | {clip['start']} | {policy_lives:.0f} of {clip['steps']} | {lives:.0f} of "
            f"{clip['steps']} | {policy_tracks:.2f}, {tracks:.2f} | {100 * clip['lived_under_noise']:.0f} % |"
        )
    return TEXT.format(
        **{name: found[name] for name in ("policy", "environment_steps")},
        before=BEFORE,
        rounds=ROUNDS,
        noisy_rounds=NOISY_ROUNDS,
        rollouts=ROLLOUTS,
        window=WINDOW,
        after=AFTER,
        rows="\n".join(rows),
    )


if __name__ == "__main__":
    measured_page(lambda: measure(named_policy()), page, RESULT, PAGE)
