"""The short trials behind the cpu preset: `python experiments/base_policy.py` redraws base_policy.md and its figure."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

from forgetmimic_jax.basics.files import read_rows
from forgetmimic_jax.motion import quality
from forgetmimic_jax.motion.library import DATA_DIR, read_library, read_manifest
from forgetmimic_jax.robot.model import load_robot

matplotlib.use("Agg")
import matplotlib.pyplot as plt

HERE = Path(__file__).parent
RESULTS = HERE / "results" / "base_policy"
BASE = DATA_DIR / "g1" / "base"
# What each trial changed with --set, beside the settings all of them share.
SHARED = "ppo.gae_lambda=0.95 ppo.entropy_cost=0.002"
TRIALS = {
    "std_0.5_randomised": "ppo.initial_std=0.5 ppo.learning_rate=2e-4 noise.enabled=true",
    "std_0.5": "ppo.initial_std=0.5 ppo.learning_rate=2e-4",
    "std_1.0": "ppo.initial_std=1.0 ppo.learning_rate=3e-4",
    "std_1.0_8_steps": "ppo.initial_std=1.0 ppo.learning_rate=4e-4 ppo.num_steps=8 ppo.minibatches=2",
    "branches_from_scratch": "shipped library, ppo.branches=4 ppo.num_envs=512 ppo.num_steps=8 ppo.gae_lambda=0.7 "
    "ppo.entropy_cost=0.006 ppo.schedule=adaptive ppo.target_kl=0.015",
}
OTHER_ROBOT = {"h2_fresh": "a random policy", "h2_carried_over": "the G1's policy, carried over"}
AT = (200_000, 400_000, 600_000, 800_000)
TEXT = """# What makes the base train faster: trials

One seed each, on cores shared with other work, so environment steps are compared and not time.

## From scratch

Mean episode length (control steps, exploration noise included) on the twelve G1 clips by environment steps. All but the
last row: a first version of the clip library (later refined) with `{shared}`;
those with `initial_std=0.5` ran before the root-velocity and torque terms of the reward were corrected. A difference
of a step or two means nothing.

{table}

![episode length](results/base_policy/trials.png)

A wider exploration noise helps most (a joint hardly moves under narrow noise at 50 Hz, so little is learned from it),
although the noise itself shortens the episodes counted here; randomisation costs nothing measurable this early; half
the rollout with the same number of gradient steps a sample changes little; nor do branches, this early. Correlated
noise was tried as well and tracked worse at twice the KL, so it is not in the code.

## Going on from a trained policy

Each row sets out from the one named, with Adam reset. Evaluations of 6 episodes a clip without noise: mean
survival-weighted tracking (success) at the environment steps since the start.

{further}

- *Branches* (several rollouts from one state, each other's baseline: [the gradient's noise](gradient_noise.md))
  with a shorter GAE and half the step size: the first four million steps gained more than twice what *plain* did,
  then the figure wandered. The sampler was by then giving two thirds of its starts to four clips that did not
  move (dance_a, spin, cartwheel, backflip), and 1 % of the steps to each of punch and kick, which are short.
- *A prior over clips* mends that: punch and getup_faceup rose at once.
- *One epoch* instead of four is 1.4 times as fast on the clock, but was the worse policy after as many steps.
- The KL of an iteration grows as the policy's noise narrows (a fixed step size moves a narrower policy by more of its
  noise). At a KL of 0.08 evaluations wander by 0.03; a smaller step size settles them. Hence the preset's schedule.
- *Level* stands still whatever the step size: λ = 0.7 has brought the policy to where its own gradient vanishes, which
  is not where the true one does ([the gradient's bias](gradient_noise.md)). *Short*, which trusts the critic sooner
  still, is the worse policy. *Long* and *longer* pay for a truer direction with noise, and improve again.

## Clips that were not learned

dance_a, spin and backflip had hardly moved in tens of millions of steps. One reason was the library. *Missing* is
the acceleration that no contact with the floor gives (the largest mean over 0.2 s, force and moment together),
*torque* the load of the worst motor but the wrists' over its limit (the largest mean over 0.1 s): two columns of
`make motions ARGS=check`. Success and tracking: 100 episodes a clip, the base shipped with the earlier library, the
one *before* the targets' share below, and the one shipped now.

{clips}

- *Earlier* (commit {earlier}): dance_a bends its waist with twice the torque that the motor has, the backflip with
  three times; the spin takes off from ankles that would have to be twice as strong. Soles that carried the body while
  they pivoted were taken for swinging ones, so the robot left the floor early and had to leap higher.
- *Now* the refinement has both as residuals. Missing fell most where it was largest, and no motor but the wrists' is
  asked for more than it has or hardly so; the limbs' directions are on average {turned:.1f} degrees further from the
  human's, {turned_most}'s most ({degrees_most:.1f}).
- In the few million steps since, that was not enough. Spin and backflip mostly ended about their take-off and dance_a
  in the first half of its cycle, with an end effector out of its height. Of no use there, in a million steps or two
  each: an end-effector bound of 0.45 m in training, and twice the exploration noise. Nor that the others held them
  back: with an anchor (`ppo.anchor`) on every other clip and a free hand for these, two million steps gained the kick a
  tenth and four million more nothing (stage 16 of the base).
- With the assistive wrench (steadied: [method.md](../docs/method.md#assistive-wrench)) all of them but the backflip are
  lived through at once, and none is learned: its gain follows the failures, a little of it is enough for a success, so
  a little of it stays, and without it the policy is worse than before. No better, in two million steps: without it in
  half the episodes.
- What they lacked was **their share of the steps**. Adaptive sampling gives a clip that fails half the time hardly
  twice the starts of one that does not, and its episodes are short, so the kick had some 6 % of the steps. *Before* is
  the base of stage 16; *now* three quarters of the starts are those of kick, spin and dance_a
  (`sampling.target_share`), the others held by the anchor: stages 17 to 19 and 23 to
  26.
- The backflip lacked **a first success**. [A search](feasibility.md) finds take-off, flight and landing once it tries
  actions far from the policy's, more than four units where exploration noise goes 0.3. The policy learned what the
  search adds by regression (`distill.py`), which alone let one episode in twenty through, and four million steps of
  PPO made two in five of that: stages 20 and 21. Both lines of training were then distilled into one policy, which kept
  what either could: stage 22. Four million steps more, and the backflip succeeded four times in five.
- **Specialists** are cheap: two trainings of three clips each, side by side from the same policy, then one policy of
  both (stages 25 to 27). Every one of the six clips gained, and the others stayed, for the student teaches itself.

So look at both columns before training on clips of your own.

## From one robot to another

The H2 on its eight clips with the cpu preset: mean episode length as above, by where it starts.

{other_robot}

`make pretrain ROBOT=h2 BASE=data/g1/base` carries the G1's policy over joint by joint, by name: inputs and outputs go
to the joint's new place, the head's start at 0, and the statistics of the observations move with height and pose. It
falls about as soon as a random policy at first, and is after 0.2 M steps where the other is not after 0.8 M. The bound
on the contact force grows with the mass: at 2000 N, six times the G1's weight, the H2 could not run.
"""
GOING_ON = {
    "plain": ("base of 6.0 M steps", "`num_envs=256 num_steps=16 gae_lambda=0.9 learning_rate=2e-4`"),
    "branches": (
        "*plain* after 3.8 M",
        "`num_envs=512 num_steps=8 branches=4 gae_lambda=0.7 learning_rate=1e-4`, from 5.0 M `6e-5 entropy_cost=0.006`",
    ),
    "prior": (
        "*branches* after 6.8 M",
        "the same, `learning_rate=1e-4 sampling.prior=clips sampling.uniform_ratio=0.3`, from 1.3 M `4e-5`",
    ),
    "one_epoch": ("*branches* after 6.8 M", "as *prior*, `epochs=1 learning_rate=3e-4`"),
    "level": ("*prior* after 3.8 M", "the same, `schedule=adaptive_iteration target_kl=0.03`"),
    "short": ("*level* after 4.8 M", "as *level*, `num_envs=1024 num_steps=4 branches=8 gae_lambda=0.5`"),
    "long": (
        "*level* after 4.8 M",
        "as *level*, `num_steps=24 minibatches=12 gae_lambda=0.95 learning_rate=5e-5`, falling linearly over the run",
    ),
    "longer": ("*long* after 4.1 M", "as *long*, `num_envs=256 num_steps=48 gae_lambda=0.97 learning_rate=4e-5`"),
}
LONG_ITERATIONS = {"long": 12_288, "longer": 12_288}  # environment steps; the other trials' have 4,096


def going_on() -> str:
    """The second table, from the stored evaluations."""
    rows = ["| trial | from | settings | evaluations |", "|---|---|---|---|"]
    for name, (start, settings) in GOING_ON.items():
        evaluations = read_rows(RESULTS / f"going_on_{name}.jsonl")
        steps_per_iteration = LONG_ITERATIONS.get(name, 4096)
        cells = [
            f"{row['iteration'] * steps_per_iteration / 1e6:.1f} M: {row['survival_weighted_tracking']:.2f} "
            f"({row['success_rate']:.0%})"
            for row in evaluations
        ]
        rows.append(f"| {name.replace('_', ' ')} | {start} | {settings} | {', '.join(cells)} |")
    return "\n".join(rows)


def clips() -> str:
    """The third table: what each clip asks for beyond what there is, and how often the base does it, then and now."""
    robot, earlier = load_robot("g1"), _earlier()["clips"]
    before = json.loads((RESULTS / "before_target_share.json").read_text())["clips"]
    done = json.loads((BASE / "evaluation.json").read_text())["policies"]["base"]["clips"]
    rows = [
        "| clip | missing, m/s²: earlier | now | torque: earlier | now "
        "| success: earlier | before | now | tracking: earlier | before | now |",
        "|---" * 11 + "|",
    ]
    measures = {clip.name: quality.measure(robot, clip) for clip in read_library(robot, BASE.parent)}
    for name in sorted(measures, key=lambda name: -earlier[name]["motor_load"]):
        then, now = earlier[name], measures[name]
        success, tracking = (done[name][metric]["mean"] for metric in ("success_rate", "survival_weighted_tracking"))
        cells = (
            f"{then['missing_acceleration']:.1f}",
            f"{now.missing_acceleration or 0.0:.1f}",
            f"{then['motor_load']:.0%}",
            f"{now.motor_load or 0.0:.0%}",
            *(f"{rate:.0%}" for rate in (then["success_rate"], before[name]["success_rate"], success)),
            *(
                f"{value:.2f}"
                for value in (*(c[name]["survival_weighted_tracking"] for c in (earlier, before)), tracking)
            ),
        )
        rows.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(rows)


def turned() -> dict[str, float]:
    """Degrees that each clip's limbs are further from the human's than in the earlier library."""
    now, earlier = read_manifest(BASE.parent)["clips"], _earlier()["clips"]
    return {name: entry["direction_error_deg"] - earlier[name]["direction_error_deg"] for name, entry in now.items()}


def _earlier() -> dict[str, Any]:
    """By clip: `quality.measure` and the base's evaluation, both at the commit it names."""
    return json.loads((RESULTS / "earlier_library.json").read_text())


def lengths(first: str, trials: dict[str, str]) -> str:
    """Mean episode length by environment steps, a row a stored curve."""
    rows = [f"| {first} | " + " | ".join(f"{steps / 1e6:.1f} M" for steps in AT) + " |", "|---" * (len(AT) + 1) + "|"]
    for name, label in trials.items():
        steps, length = curve(name)
        cells = [f"{np.interp(at, steps, length):.1f}" if at <= steps[-1] else "" for at in AT]
        rows.append(f"| {label} | " + " | ".join(cells) + " |")
    return "\n".join(rows)


def curve(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Environment steps and mean episode length of a stored trial."""
    rows = read_rows(RESULTS / f"{name}.jsonl")
    return np.array([row["environment_steps"] for row in rows]), np.array([row["episode_length"] for row in rows])


def main() -> None:
    """Write base_policy.md and trials.png from the stored curves."""
    for name in TRIALS:
        steps, length = curve(name)
        plt.plot(steps / 1e6, length, label=name)
    plt.xlabel("environment steps (millions)")
    plt.ylabel("mean episode length (control steps)")
    plt.legend()
    plt.savefig(RESULTS / "trials.png", dpi=110, bbox_inches="tight")
    degrees = turned()
    most = max(degrees, key=degrees.__getitem__)
    text = TEXT.format(
        shared=SHARED,
        table=lengths("settings", {name: f"`{settings}`" for name, settings in TRIALS.items()}),
        other_robot=lengths("start", OTHER_ROBOT),
        further=going_on(),
        clips=clips(),
        earlier=_earlier()["commit"],
        turned=np.mean(list(degrees.values())),
        turned_most=most,
        degrees_most=degrees[most],
    )
    (HERE / "base_policy.md").write_text(text)
    print(f"table   {HERE / 'base_policy.md'}\nfigure  {RESULTS / 'trials.png'}")


if __name__ == "__main__":
    main()
