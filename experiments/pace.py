"""The trials behind unlearning's pace on a laptop: `python experiments/pace.py` writes the page from their evaluations.

A seed or a few each, so only large differences count. A row's settings are all that differs from today's `PACE`; to
try one again: `make unlearn ITERATIONS=... ARGS="--set ..."`.
"""

from __future__ import annotations

import json
from pathlib import Path

from forgetmimic_jax.evaluation.tables import markdown_table, percent

HERE = Path(__file__).parent
RESULTS = HERE / "results" / "pace"
PAGE = HERE / "pace.md"

# By file: iterations and settings. Some are no longer an option: a step size that falls from the first iteration on,
# and a share of the starts for the targets.
TRIALS = {
    "long": ("160", "num_steps=24 minibatches=12 epochs=4 learning_rate=1.5e-4, falling from the start"),
    "short": ("320", "minibatches=6 epochs=4 learning_rate=1.5e-4, falling from the start"),
    "shorter": ("240", "num_steps=8 minibatches=3 learning_rate=2e-4"),
    "slower": ("320", "learning_rate=2e-4, not rising at the start"),
    "slower_seed_1": ("320", "the same, seed 1"),
    "no_rise": ("320", "the step size not rising at the start"),
    "no_rise_seed_1": ("320", "the same, seed 1"),
    "no_rise_seed_2": ("320", "the same, seed 2"),
    "control": ("320", "the same, seed 0, without the anti-reward (`--method finetune --clips all`)"),
    "chosen": ("320", "none: today's pace"),
    "share": ("160", "learning_rate=2e-4, falling from the start; a third of the starts for the targets"),
    "share_more": ("160", "minibatches=6 epochs=4 learning_rate=1.5e-4, falling from the start; half of the starts"),
    "share_fixed": ("120", "num_steps=8 epochs=4 schedule=fixed learning_rate=1.5e-4; most of the starts"),
}

TEXT = """# Unlearning's pace on a laptop

λ = 16 on the G1 base of 33.5 M steps and its clips, both since replaced ([base_policy.md](base_policy.md)); seed 0
where no other is named, 20 episodes a clip; intervals over the episodes.
`python experiments/pace.py` writes this page from `results/pace/`.

{table}
- Forgetting takes some hundred iterations, whatever their length: PPO's clip lets the policy go only so far in each. So
  iterations are short.
- What is kept pays for a short look-ahead: with 8 steps it lost more in half as many environment steps.
- A step size that falls from the start leaves the targets half-way; one that stays for half of the run does not, and
  what is kept settles in the second half. At 2e-4 that depended on the seed.
- At this pace fine-tuning alone, without any anti-reward, wears the policy down as much as forgetting does, the
  cartwheel first: what the kept clips lose is the price of the pace, and not of the anti-reward.
- More starts for the targets make it faster, at a price for what is kept. The paper draws clips uniformly, and so do
  we: with a share of our own the samplers could not be compared.
"""


def main() -> None:
    """Write the page."""
    rows = []
    for name, (iterations, settings) in TRIALS.items():
        document = json.loads((RESULTS / f"{name}.json").read_text())
        policy, steps = document["policy"], document["environment_steps"]
        cells = [percent(policy["target"]["success_rate"]), percent(policy["target"]["skill"])]
        cells += [percent(policy["kept"]["success_rate"]), percent(policy["kept"]["skill"])]
        rows.append([settings, f"{iterations} iterations, {steps / 1e6:.1f} M steps", *cells])
    base = document["base"]
    cells = [percent(base["target"]["success_rate"]), "", percent(base["kept"]["success_rate"]), ""]
    rows.insert(0, ["*the base*", "", *cells])
    header = ["settings", "budget", "target success", "target skill left", "kept success", "kept skill left"]
    PAGE.write_text(TEXT.format(table=markdown_table(header, rows)))
    print(f"page  {PAGE}")


if __name__ == "__main__":
    main()
