"""How noisy and how biased the policy gradient is under each λ of GAE: `python experiments/gradient_noise.py`.

From each of many states the policy meets, BRANCHES rollouts set out with different action noise. The spread of their
advantages inside such a group is what the actions did; the spread of the groups' means is the critic's error in the
state, which says nothing about actions. The gradient in the actor's parameters is then taken batch by batch for every
look-ahead and λ. Products of different batches' gradients hold no noise, so their means tell the true gradient's
square, and the angle to the gradient of λ = 1 with the longest look-ahead, which leans on the critic least.
`--draw` rewrites the page from the stored numbers alone.
"""

from __future__ import annotations

import dataclasses
import operator
from pathlib import Path

import numpy as np

from forgetmimic_jax.studies.study import measured_page, named_policy

HERE = Path(__file__).parent
RESULT = HERE / "results" / "gradient_noise.json"
PAGE = HERE / "gradient_noise.md"
ENVIRONMENTS, BRANCHES, STEPS, BATCHES = 1024, 16, 40, 40
USED = 4  # first steps of a rollout whose actions the gradient is of: 4,096 samples a batch
LAMBDAS = (0.5, 0.7, 0.8, 0.9, 0.95, 1.0)
LOOK_AHEADS = (4, 8, 16, STEPS)

TEXT = """# The policy gradient's noise and bias

The policy `{policy}` ({environment_steps:,} environment steps, trained with λ = {trained_lambda:g}): {groups} states it
meets in training, {branches} rollouts of {steps} control steps from each; seed 0.
`.venv/bin/python experiments/gradient_noise.py CHECKPOINT` measures it again (some ten minutes on two cores), `--draw`
rewrites this page from `results/gradient_noise.json`.

## Noise: the first step's advantage

| λ of GAE | variance | critic's error in it | saved by branches |
|---|---|---|---|
{noise}

- *The critic's error in it*: the part of the variance between states; the rest is between the rollouts of one state.
- *Saved by branches*: by which factor the variance falls when a rollout is measured against the others of its state
  (`ppo.branches`), which leaves the gradient unbiased.

## Bias: the gradient in the actor's parameters

Of the actions of a rollout's first {used} steps, {samples:,} samples a batch, {batches} batches, branches centred.

| look-ahead | λ | signal | cosine | efficiency |
|---|---|---|---|---|
{bias}

- *Look-ahead*: control steps before the critic's value stands for the rest.
- *Signal*: the share of the mean gradient's square in a batch gradient's square, in thousandths.
- *Cosine*: between the mean gradient and that of λ = 1 with the longest look-ahead.
- *Efficiency*: the share of a batch gradient's square along the latter, signed, in thousandths: what training can use.

A small λ has the stronger signal and the wrong direction. The critic explains nearly all of what differs between the
states of a clip, and hardly anything of what a few steps of noise change in one; only a fall tells. A policy trained
with a small λ comes to rest where that biased gradient vanishes, and the variance, by which λ = 0.7 over 8 steps was
once chosen for the `cpu` preset, does not show it. Hence its long rollouts with a λ near 1.
"""


def measure(checkpoint_path: Path) -> dict:
    """Roll out and take the moments."""
    import jax
    import jax.flatten_util
    import jax.numpy as jnp

    from forgetmimic_jax.policy import network
    from forgetmimic_jax.ppo.gae import centre_branches, generalized_advantages
    from forgetmimic_jax.ppo.state import make_actor
    from forgetmimic_jax.ppo.update import collect
    from forgetmimic_jax.training import checkpoint, runner

    info = checkpoint.read_info(checkpoint_path)
    ppo = dataclasses.replace(info.config.ppo, num_envs=ENVIRONMENTS, num_steps=STEPS, branches=BRANCHES, minibatches=1)
    sampling = dataclasses.replace(info.config.sampling, rule="frozen")
    config = dataclasses.replace(info.config, base=str(checkpoint_path), ppo=ppo, sampling=sampling)
    setup = runner.make_setup(config)
    actor = make_actor(config, setup.robot.num_joints)
    variants = [(ahead, value) for ahead in LOOK_AHEADS for value in LAMBDAS]

    @jax.jit
    def one_batch(assets, state):
        state, t = collect(setup.env, assets, state)
        done = t.terminated | t.truncated
        seen = network.normalize(state.policy.actor_normalizer, t.actor_observation[:USED])
        parts = (t.reward, t.value, t.next_value, t.terminated, t.truncated)

        def gradient(ahead: int, value: float):
            reward, values, following, terminated, truncated = (part[:ahead] for part in parts)
            advantage, _ = generalized_advantages(reward, values, following, terminated, truncated, ppo.discount, value)
            advantage = centre_branches(advantage, done[:ahead], BRANCHES)[:USED]

            def surrogate(parameters):
                return (
                    network.log_prob(t.action[:USED], *network.distribution(actor, parameters, seen)) * advantage
                ).mean()

            inner = jax.grad(surrogate)(state.policy.actor)["params"]
            return jax.flatten_util.ravel_pytree({name: x for name, x in inner.items() if name != "log_std"})[0]

        first = jnp.stack([generalized_advantages(*parts, ppo.discount, value)[0][0] for value in LAMBDAS])
        return state, jnp.stack([gradient(*variant) for variant in variants]), first

    state = runner.start_state(setup)
    rng = np.random.default_rng(0)
    truth = variants.index((STEPS, 1.0))
    total, square, own = np.zeros(1), np.zeros(1), np.zeros(1)
    within, between = [], []
    for batch in range(1 + BATCHES):
        state, gradients, first = one_batch(setup.assets, state)
        # New leaders each time, so that a group sets out from where any rollout of the batch before ended.
        order = rng.permutation(ENVIRONMENTS)
        state = dataclasses.replace(state, env=jax.tree.map(operator.itemgetter(order), state.env))
        if batch == 0:  # the starts' reset noise is no state that the policy meets
            continue
        gradients = np.asarray(gradients, np.float64)
        total, square = total + gradients, square + (gradients**2).sum(-1)
        own = own + gradients @ gradients[truth]
        groups = np.asarray(first).reshape(len(LAMBDAS), -1, BRANCHES)
        within.append(groups.var(-1, ddof=1).mean(-1))
        between.append(groups.mean(-1).var(-1, ddof=1) - within[-1] / BRANCHES)
    pairs = BATCHES * (BATCHES - 1)
    signal, along = ((total**2).sum(-1) - square) / pairs, (total @ total[truth] - own) / pairs
    return {
        "policy": "/".join(checkpoint_path.parts[-3:]),
        "environment_steps": info.environment_steps,
        "trained_lambda": info.config.ppo.gae_lambda,
        "within": np.mean(within, axis=0).tolist(),
        "between": np.mean(between, axis=0).tolist(),
        "variants": variants,
        "square": (square / BATCHES).tolist(),
        "signal": signal.tolist(),
        "along_truth": along.tolist(),
    }


def page(found: dict) -> str:
    """The page of the stored numbers."""
    within, between = np.array(found["within"]), np.array(found["between"])
    total = within + between
    noise = [
        f"| {value:g} | {total[i]:.4f} | {between[i] / total[i]:.0%} | {total[i] / within[i]:.1f} |"
        for i, value in enumerate(LAMBDAS)
    ]
    truth = found["variants"].index([STEPS, 1.0])
    square, signal, along = (np.array(found[name]) for name in ("square", "signal", "along_truth"))
    with np.errstate(invalid="ignore"):
        cosine = along / np.sqrt(signal * signal[truth])
    efficiency = np.sign(along) * along**2 / signal[truth] / square
    bias = [
        f"| {ahead} | {value:g} | {1e3 * signal[i] / square[i]:.1f} | {cosine[i]:.2f} | {1e3 * efficiency[i]:.1f} |"
        for i, (ahead, value) in enumerate(found["variants"])
    ]
    return TEXT.format(
        **{name: found[name] for name in ("policy", "environment_steps", "trained_lambda")},
        groups=BATCHES * ENVIRONMENTS // BRANCHES,
        branches=BRANCHES,
        steps=STEPS,
        used=USED,
        samples=USED * ENVIRONMENTS,
        batches=BATCHES,
        noise="\n".join(noise),
        bias="\n".join(bias),
    )


if __name__ == "__main__":
    measured_page(lambda: measure(named_policy()), page, RESULT, PAGE)
