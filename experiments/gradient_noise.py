"""What is noise in a policy gradient of the shipped base, and what removes it: `python experiments/gradient_noise.py`.

From each of many states the policy meets, BRANCHES rollouts set out with different action noise. The spread of their
advantages inside such a group is what the actions did; the spread of the groups' means is the critic's error in the
state, which says nothing about actions. A group's own estimate of the gradient of the first action's mean, split into
halves that share no rollout, tells the true gradient's square and the angle between the gradients of two λ.
`--draw` rewrites the page from the stored numbers alone.
"""

from __future__ import annotations

import dataclasses
import json
import operator
import sys
from pathlib import Path

import numpy as np

HERE = Path(__file__).parent
RESULT = HERE / "results" / "gradient_noise.json"
PAGE = HERE / "gradient_noise.md"
BRANCHES, STEPS, ROUNDS, SETTLING = 16, 32, 40, 4
LAMBDAS = (0.0, 0.3, 0.5, 0.7, 0.8, 0.9, 0.95, 1.0)
GROUP, ROLLOUT = 4, 8  # the cpu preset's branches and num_steps

TEXT = """# Where the noise of a policy gradient comes from

The shipped base (`data/g1/base`, {environment_steps:,} environment steps): {groups} states it meets in training,
{branches} rollouts of {steps} control steps from each; seed 0. `python experiments/gradient_noise.py` measures it again
(some minutes on two cores), `--draw` rewrites this page from `results/gradient_noise.json`.

| λ of GAE | variance | critic's error in it | cosine | saved by branches | by branches and λ |
|---|---|---|---|---|---|
{rows}

- *Variance*: of the first step's advantage, over all rollouts. *The critic's error in it*: the part between states; the
  rest is between the rollouts of one state.
- *Cosine*: between the gradients (of the first action's mean) with this λ and with λ = 1.
- *Saved by branches*: by which factor the variance falls when a rollout is measured against the others of its state.
- Empty: the square of that gradient is not above its noise in this many states.
- *By branches and λ*: by which factor fewer samples give the same accuracy along the gradient of λ = 1, against plain
  PPO with λ = 0.9.

Over a rollout of {rollout} steps in groups of {group}, as in the cpu preset, branches part and the gain shrinks: the
mean variance falls from {raw:.4f} to {centred:.4f} (λ = {preset_lambda:g}); plain PPO with λ = 0.9 has {plain:.4f}.
Plain PPO is `ppo.branches=1`, which the `paper` preset keeps.
"""


def measure() -> dict:
    """Roll out and take the moments."""
    import jax
    import jax.numpy as jnp

    from forgetmimic_jax import checkpoint, runner
    from forgetmimic_jax.ppo.gae import centre_branches, generalized_advantages
    from forgetmimic_jax.ppo.update import collect

    base = runner.base_folder("g1")
    info = checkpoint.read_info(base)
    ppo = dataclasses.replace(info.config.ppo, num_envs=256, num_steps=STEPS, branches=1)
    sampling = dataclasses.replace(info.config.sampling, rule="frozen")
    setup = runner.make_setup(dataclasses.replace(info.config, base=str(base), ppo=ppo, sampling=sampling))
    roll_out = jax.jit(lambda assets, state: collect(setup.env, assets, state))
    state = runner.start_state(setup)
    preset_lambda = info.config.ppo.gae_lambda
    products, within, between, rollout = [], [], [], []
    for round_ in range(SETTLING + ROUNDS):
        # Every group starts where one rollout of the round before ended, a new one each time.
        chosen = np.repeat((round_ + np.arange(0, ppo.num_envs, BRANCHES)) % ppo.num_envs, BRANCHES)
        if round_ >= SETTLING:
            state = dataclasses.replace(state, env=jax.tree.map(operator.itemgetter(chosen), state.env))
        state, trajectory = roll_out(setup.assets, state)
        if round_ < SETTLING:
            continue

        t = trajectory
        parts = (t.reward, t.value, t.next_value, t.terminated, t.truncated, ppo.discount)
        noise = np.asarray(trajectory.action - trajectory.mean)[0]
        noise = (noise / noise.std(0)).reshape(-1, BRANCHES, noise.shape[-1])
        first = np.stack([np.asarray(generalized_advantages(*parts, value)[0])[0] for value in LAMBDAS])
        first = first.reshape(len(LAMBDAS), -1, BRANCHES)
        centred = (first - first.mean(-1, keepdims=True)) * BRANCHES / (BRANCHES - 1)
        gradient = centred[..., None] * noise  # [λ, group, branch, joint]
        one, other = gradient[:, :, ::2].mean(2), gradient[:, :, 1::2].mean(2)
        product = np.einsum("agj,bgj->ab", one, other) / first.shape[1]
        products.append((product + product.T) / 2)
        within.append(first.var(-1, ddof=1).mean(-1))
        between.append(first.mean(-1).var(-1, ddof=1) - within[-1] / BRANCHES)
        done = trajectory.terminated | trajectory.truncated
        ours, plain = (generalized_advantages(*parts, value)[0][:ROLLOUT] for value in (preset_lambda, 0.9))
        parted = centre_branches(ours, done[:ROLLOUT], GROUP)
        rollout.append([float(jnp.var(x)) for x in (ours, parted, plain)])
    raw, centred, plain = np.mean(rollout, axis=0).tolist()
    return {
        "environment_steps": info.environment_steps,
        "groups": ROUNDS * ppo.num_envs // BRANCHES,
        "branches": BRANCHES,
        "steps": STEPS,
        "lambda": LAMBDAS,
        "within": np.mean(within, axis=0).tolist(),
        "between": np.mean(between, axis=0).tolist(),
        "products": np.mean(products, axis=0).tolist(),
        "rollout": {"steps": ROLLOUT, "group": GROUP, "lambda": preset_lambda, "raw": raw, "centred": centred,
                    "plain": plain},
    }  # fmt: skip


def number(value: float, digits: int) -> str:
    """A cell; empty where the gradient does not stand out from its noise."""
    return "" if np.isnan(value) else f"{value:.{digits}f}"


def page(found: dict) -> str:
    """The page of the stored numbers."""
    within, between = np.array(found["within"]), np.array(found["between"])
    products = np.array(found["products"])
    square = np.diag(products)
    length = np.sqrt(np.where(square > 0, square, np.nan))
    cosine = products[:, -1] / (length * length[-1])
    projection = products[:, -1] / length[-1]
    plain = found["lambda"].index(0.9)
    total = within + between
    saved = (projection**2 / within) / (projection[plain] ** 2 / total[plain])
    rows = [
        f"| {value:g} | {total[i]:.4f} | {between[i] / total[i]:.0%} | {number(cosine[i], 2)} | "
        f"{total[i] / within[i]:.1f} | {number(saved[i], 1)} |"
        for i, value in enumerate(found["lambda"])
    ]
    rollout = found["rollout"]
    return TEXT.format(
        **{name: found[name] for name in ("environment_steps", "groups", "branches", "steps")},
        **{name: rollout[name] for name in ("raw", "centred", "plain", "group")},
        rows="\n".join(rows),
        rollout=rollout["steps"],
        preset_lambda=rollout["lambda"],
    )


def main() -> None:
    """Measure, unless told to draw only; write the numbers and the page."""
    if "--draw" not in sys.argv[1:]:
        RESULT.write_text(json.dumps(measure(), indent=1) + "\n")
    PAGE.write_text(page(json.loads(RESULT.read_text())))
    print(f"numbers  {RESULT}\npage     {PAGE}")


if __name__ == "__main__":
    main()
