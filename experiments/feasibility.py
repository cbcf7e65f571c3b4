"""Could the robot do what the policy fails to do? `python experiments/feasibility.py [CHECKPOINT]`.

Every clip from its first frame, without reset noise: where the policy falls first. There a search that knows the future
takes over: the cross-entropy method on what is added to the policy's actions over the steps around the fall, as knots
joined by straight lines. What it finds is possible for this robot and these bounds; where it finds nothing, a search
of this size did not, which is a hint and no proof. `--draw` rewrites the page from the stored numbers alone.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from forgetmimic_jax.study import measured_page, named_policy

HERE = Path(__file__).parent
RESULT = HERE / "results" / "feasibility.json"
PAGE = HERE / "feasibility.md"
BEFORE, WINDOW, KNOT = 25, 45, 4  # control steps: before the fall, searched, between two knots
ROLLOUTS, ELITES, ROUNDS = 384, 48, 60
STARTING_STD, LEAST_STD, KEEP = 1.5, 0.15, 0.3  # of what is added, in units of action; share of the old estimate

TEXT = """# Could the robot do what the policy fails to do?

Every clip of the G1 from its first frame, without reset noise, by the mean actions of `{policy}`
({environment_steps:,} environment steps). Where it falls, a search that knows the future takes over {before} steps
earlier: the cross-entropy method ({rounds} rounds of {rollouts} rollouts of {window} control steps) on what is added to
the policy's actions, for tracking reward and for not falling; seed 0.
`python experiments/feasibility.py CHECKPOINT` measures it again (some three minutes a clip on two cores), `--draw`
rewrites this page from `results/feasibility.json`.

| clip | the policy falls at frame | searched from | the policy lives | the search lives | tracking of both |
|---|---|---|---|---|---|
{rows}

*Lives*: control steps of those searched; *tracking*: mean tracking reward over them, 0 after a fall. Clips that are not
in the table are lived through. What a search finds, the robot can do; where it finds nothing, the motion may be beyond
the motors or the bounds, or the search too small.
"""


def without_reset_noise(config):
    """The evaluation's settings with every episode starting exactly on the reference."""
    from forgetmimic_jax.evaluation.rollout import evaluation_config

    names = ("position", "orientation", "linear_velocity", "angular_velocity")
    nothing = {f"reset_{name}": (0.0, 0.0, 0.0) for name in names} | {"reset_joint_position": 0.0}
    config = evaluation_config(config)
    return dataclasses.replace(config, noise=dataclasses.replace(config.noise, **nothing))


def measure(checkpoint_path: Path) -> dict:
    """First falls, and a search at each."""
    import jax
    import jax.numpy as jnp

    from forgetmimic_jax import checkpoint, runner
    from forgetmimic_jax.evaluation.rollout import Evaluator, act, begin_episodes
    from forgetmimic_jax.tracking import env as tracking

    info = checkpoint.read_info(checkpoint_path)
    config = without_reset_noise(dataclasses.replace(info.config, base=str(checkpoint_path)))
    setup = runner.make_setup(config)
    policy = checkpoint.load_policy(checkpoint_path, runner.template(setup))
    names, lengths, assets = setup.library.names, np.asarray(setup.library.length), setup.assets

    env = tracking.make_environment(config, setup.robot, ROLLOUTS, noisy=False)

    def roll(state, knots, steps: int):
        """Steps lived and mean tracking, each [rollout], of knots [rollout, knot, joint]."""
        places = jnp.linspace(0, knots.shape[1] - 1, steps)
        low = jnp.minimum(places.astype(int), knots.shape[1] - 2)
        share = (places - low)[:, None, None]
        added = jnp.moveaxis(knots, 1, 0)
        added = (1 - share) * added[low] + share * added[low + 1]

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

    rolled = jax.jit(roll, static_argnums=2)
    alone = Evaluator(config, setup.robot, setup.library, episodes=1, seed=0).rollout(policy)  # each from frame 0
    found = {}
    for clip in np.flatnonzero(alone.length < alone.horizon):
        fall = int(alone.length[clip])
        start = max(0, fall - BEFORE)
        steps = min(WINDOW, int(lengths[clip]) - 1 - start)
        state = begin_episodes(
            env, assets, jax.random.PRNGKey(0), jnp.full(ROLLOUTS, clip), jnp.full(ROLLOUTS, start, jnp.int32)
        )
        rng = np.random.default_rng(0)
        mean = np.zeros((max(2, steps // KNOT), setup.robot.num_joints))
        std = np.full_like(mean, STARTING_STD)
        history = []
        for _ in range(ROUNDS):
            knots = mean + std * rng.standard_normal((ROLLOUTS, *mean.shape))
            knots[0] = mean
            lived, tracked = (np.asarray(x) for x in rolled(state, jnp.asarray(knots, jnp.float32), steps))
            history.append((float(lived[0]), float(tracked[0])))
            best = knots[np.argsort(-(lived / steps + tracked))[:ELITES]]
            mean = KEEP * mean + (1 - KEEP) * best.mean(0)
            std = np.maximum(KEEP * std + (1 - KEEP) * best.std(0), LEAST_STD)
        found[names[clip]] = {"fall": fall, "start": start, "steps": steps, "rounds": history}
        print(f"{names[clip]}: the policy lives {history[0][0]:.0f} of {steps} steps, the search {history[-1][0]:.0f}")
    return {
        "policy": "/".join(checkpoint_path.parts[-3:]),
        "environment_steps": info.environment_steps,
        "clips": found,
    }


def page(found: dict) -> str:
    """The page of the stored numbers."""
    rows = []
    for name, clip in found["clips"].items():
        (policy_lives, policy_tracks), (lives, tracks) = clip["rounds"][0], clip["rounds"][-1]
        rows.append(
            f"| {name} | {clip['fall']} | {clip['start']} | {policy_lives:.0f} of {clip['steps']} | "
            f"{lives:.0f} of {clip['steps']} | {policy_tracks:.2f}, {tracks:.2f} |"
        )
    return TEXT.format(
        **{name: found[name] for name in ("policy", "environment_steps")},
        before=BEFORE,
        rounds=ROUNDS,
        rollouts=ROLLOUTS,
        window=WINDOW,
        rows="\n".join(rows),
    )


if __name__ == "__main__":
    measured_page(lambda: measure(named_policy()), page, RESULT, PAGE)
