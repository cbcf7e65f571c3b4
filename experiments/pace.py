"""The trials behind unlearning's pace on a laptop: `python -m experiments.pace` writes the page from their evaluations.

A seed or a few each, so only large differences count. To try one again: `make unlearn ITERATIONS=... ARGS="--set ..."`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from experiments.validity import at_length
from forgetmimic_jax.evaluation.tables import markdown_table, percent
from forgetmimic_jax.unlearn import ITERATIONS

HERE = Path(__file__).parent
RESULTS = HERE / "results" / "pace"
VALIDITY = HERE / "results" / "g1" / "validity.json"
PAGE = HERE / "pace.md"

# By file: iterations and what differs from today's pace.
SHARE = {
    "none": (320, "target_share=0"),
    "forty_per_cent": (200, "target_share=0.4"),
    "forty_per_cent_seed_1": (200, "the same"),
    "forty_per_cent_seed_2": (200, "the same"),
}
SHARE_SHIPPED = {
    "forty_per_cent": (200, "target_share=0.4"),
    "half": (200, "nothing"),
    "sixty_per_cent": (200, "target_share=0.6"),
}
DISTILLED = {
    "default": (200, "nothing"),
    "default_seed_1": (200, "nothing"),
    "longer": (500, "nothing"),
}
# Without a share of the starts for the targets.
SHIPPED = {
    "shorter": (240, "nothing"),
    "shorter_faster_seed_1": (240, "learning_rate=4e-4"),
    "shorter_epochs_seed_1": (240, "epochs=4"),
    "today": (320, "nothing"),
    "today_seed_1": (320, "nothing"),
}
TRIALS = {
    "plain": (320, "no anchor, clips weigh by their steps"),
    "equal": (320, "no anchor, learning_rate=1e-4"),
    "equal_slower": (320, "no anchor, learning_rate=4e-5"),
    "held_only": (320, "clips weigh by their steps"),
    "held_slow": (320, "learning_rate=1e-4 ¹"),
    "held_less": (320, "anchor=0.03, learning_rate=2e-4 ¹"),
    "held": (320, "nothing ¹"),
    "half": (160, "nothing"),
    "half_faster_seed_1": (160, "learning_rate=4e-4"),
}
# No anchor, and clips weigh by their steps. A step size that falls from the first iteration on is no longer an option.
EARLIER = {
    "long": (160, "num_steps=24 minibatches=12 epochs=4 learning_rate=1.5e-4, falling from the start"),
    "short": (320, "minibatches=6 epochs=4 learning_rate=1.5e-4, falling from the start"),
    "shorter": (240, "num_steps=8 minibatches=3 learning_rate=2e-4"),
    "slower": (320, "learning_rate=2e-4, not rising at the start"),
    "slower_seed_1": (320, "the same"),
    "share": (160, "learning_rate=2e-4, falling from the start; a third of the starts for the targets"),
    "chosen": (320, "nothing"),
    "control": (320, "`--method finetune --clips all`, so no anti-reward"),
}

TEXT = """# Unlearning's pace on a laptop

λ = 16, 20 episodes a clip; intervals over the episodes. `.venv/bin/python -m experiments.pace` writes this page from
`results/pace/`.

## Share of the starts

On the base of 88.2 M steps.

{share}
On the shipped base of 103.0 M steps.

{share_shipped}
- The better a base is, the more there is to forget: these punch and kick every time. On the one of 88.2 M steps 320
  iterations of uniform starts leave a quarter of the skill, mostly the punch's: of the steps of iterations 10 to 50,
  {none_first:.0f} % are the targets', and {none_last:.0f} % of the last 50, for their clips are short and the policy
  soon falls in them.
- With half of the starts (`sampling.target_share`), on the shipped base, they have {share_first:.0f} and
  {share_last:.0f} %, 200 iterations do, and what is kept hardly pays more for it: the anchor holds it whatever its
  share of the steps is. Between two and three fifths one seed tells no difference from noise.
- 200 iterations are what the studies compare variants at. With one seed of three a punch still ends there now and then,
  and what is left goes on falling, so `make unlearn` takes longer ([length](#length-on-the-shipped-base)).
- By default the other samplers keep the share that their rule gives, so that they can be compared; `comparison` has
  uniform starts without the share too. The trials below were without it.

## Length, on the shipped base

`make unlearn` and nothing else; a mean over the episodes of one seed each.

{length}
- Asked of the default were no target success and a target tracking under a tenth of the kept clips'. 480 iterations
  reach the first with every seed and the second with two of three; with one the robot still stands ten steps of a
  target. Longer runs are through with that one too, and what is kept does not pay for it.
- The default is about as long as two slow cores allow in a quarter of an hour.
- Beyond 200 iterations what falls is no longer the skill: the robot does less than one without a policy
  ([what the studies say](README.md#what-they-say)).

## Distilling

`METHOD=distill` on the shipped base: a fresh policy, the anchor at 1 and more epochs and mini-batches.

{distill}
- What is kept is nearly there after 200 iterations; the spin and dance_a, then in some four of five, take longer.
- The better it does what is kept, the more of the targets it can, which it never lived.

## Length

On the base of 54.3 M steps, shipped before this one.

{shipped}
- At 240 iterations more of the targets is left than at 320, whatever is done to hurry; larger steps and more epochs are
  paid for by the kept clips. So the default was 320.

## Anchor and equal clips

On the base of 52.3 M steps, after stage 15 of the shipped one's 27.

{table}
¹ The anchor held the actions' mean and not yet their spread.

- Targets are short clips, whose episodes get shorter as they are forgotten. In the run *nothing ¹* {first:.0f} % of the
  steps are theirs in iterations 10 to 50, {last:.0f} % in the last 50; a loss that is a mean over steps hardly hears
  them. To move them at all the step size had to be large, and at that size the noise of everything else wears down what
  is kept, the cartwheel first.
- *Equal clips* (`ppo.equal_clips`): every clip weighs the same in the losses. A third of the step size then forgets
  more, and what is kept still wears down; at a smaller one the kick stays half-way and the cartwheel goes all the same.
- *Anchor* (`ppo.anchor`): a tenth of KL(π ‖ π_base) on the kept clips' steps joins the loss. What is kept then stays
  where it was, and the step size can be large again. A weaker one holds less; with a small step size it is the targets
  that stay.
- Without equal clips the anchor keeps as well, and forgets less.
- Half of the length nearly does here; on the base above, whose kick is better, it does not.

## Lengths and step sizes, without anchor and equal clips

On the base of 33.5 M steps and its clips, both since replaced ([base_policy.md](base_policy.md)).

{earlier}
- Forgetting takes some hundred iterations, whatever their length: PPO's clip lets the policy go only so far in each. So
  iterations are short.
- What is kept pays for a short look-ahead: with 8 steps it lost more in half as many environment steps.
- A step size that falls from the start leaves the targets half-way; one that stays for half of the run does not, and
  what is kept settles in the second half. At 2e-4 that depended on the seed.
- At this pace fine-tuning alone, without any anti-reward, wore the policy down as much as forgetting did.
"""


def table(folder: Path, trials: Mapping[str, tuple[int, str]]) -> str:
    """A row a trial, under the base's own on the episodes of each seed."""
    documents = {name: json.loads((folder / f"{name}.json").read_text()) for name in trials}
    bases = {document["seed"]: document["base"] for document in documents.values()}
    rows = []
    for seed, base in bases.items():
        target, kept = (percent(base[group]["success_rate"]) for group in ("target", "kept"))
        rows.append(["*the base*", str(seed), "", target, "", kept, ""])
    for name, (iterations, settings) in trials.items():
        document = documents[name]
        policy, budget = (
            document["policy"],
            f"{iterations} iterations, {document['environment_steps'] / 1e6:.1f} M steps",
        )
        cells = [percent(policy[group][metric]) for group in ("target", "kept") for metric in ("success_rate", "skill")]
        rows.append([settings, str(document["seed"]), budget, *cells])
    header = ["other than today", "seed", "budget", "target success", "target skill left", "kept success"]
    return markdown_table([*header, "kept skill left"], rows)


def length_table() -> str:
    """A row a run of `make unlearn`, by its iterations and seed."""
    runs = {int(iterations): of for iterations, of in json.loads((RESULTS / "length.json").read_text()).items()}
    variants = json.loads(VALIDITY.read_text())["results"]["variants"]
    runs[ITERATIONS["cpu"]] = variants[at_length("λ = 16")]["seeds"]
    rows = []
    for iterations, seeds in sorted(runs.items()):
        for seed, run in seeds.items():
            target, kept = run["policy"]["target"], run["policy"]["kept"]
            ratio = run["policy"]["survival_weighted_degradation_ratio"]
            cells = [f"{target['survival_weighted_tracking']:.3f}", f"{target['episode_length']:.0f}", f"{ratio:.3f}"]
            success = [f"{100 * of['success_rate']:.0f} %" for of in (target, kept)]
            rows.append([str(iterations), seed, success[0], *cells, success[1], f"{100 * kept['skill']:.0f} %"])
    header = ["iterations", "seed", "target success", "target tracking", "target steps", "ratio of tracking"]
    return markdown_table([*header, "kept success", "kept skill left"], rows)


def main() -> None:
    """Write the page."""
    tables = {"table": table(RESULTS, TRIALS), "length": length_table()}
    tables |= {
        name: table(RESULTS / name.replace("_", "/"), of)
        for name, of in (
            *(("share", SHARE), ("share_shipped", SHARE_SHIPPED), ("distill", DISTILLED)),
            *(("shipped", SHIPPED), ("earlier", EARLIER)),
        )
    }
    shares: dict[str, float] = {}
    for key, file in (("", "held"), ("none_", "share/none"), ("share_", "share/shipped/half")):
        of_steps = json.loads((RESULTS / f"{file}.json").read_text())["target_step_share"]
        shares |= {f"{key}first": 100 * np.mean(of_steps[1:6]), f"{key}last": 100 * np.mean(of_steps[-5:])}
    PAGE.write_text(TEXT.format(**tables, **shares))
    print(f"page  {PAGE}")


if __name__ == "__main__":
    main()
