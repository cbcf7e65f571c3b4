"""The trials behind unlearning's pace on a laptop: `python experiments/pace.py` writes the page from their evaluations.

One seed each, so only large differences count. A row's settings are all that differs from today's `PACE`; to try one
again: `make unlearn ITERATIONS=... ARGS="--set ..."`.
"""

from __future__ import annotations

import json
from pathlib import Path

from forgetmimic_jax.evaluation.tables import markdown_table, percent

HERE = Path(__file__).parent
RESULTS = HERE / "results" / "pace"
PAGE = HERE / "pace.md"

# File, settings, and whether today's code still makes it: an early step size fell from the first iteration on, and a
# share of the starts for the targets was tried and left out.
TRIALS = {
    "long": ("160 iterations", "num_steps=24 minibatches=12 epochs=4 learning_rate=1.5e-4, falling from the start"),
    "short": ("320 iterations", "minibatches=6 epochs=4 learning_rate=1.5e-4, falling from the start"),
    "shorter": ("240 iterations", "num_steps=8 minibatches=3"),
    "chosen": ("320 iterations", "none: today's pace"),
    "share": ("160 iterations", "falling from the start; a third of the starts for the targets"),
    "share_more": (
        *("160 iterations",),
        "minibatches=6 epochs=4 learning_rate=1.5e-4, falling from the start; half of the starts for the targets",
    ),
    "share_fixed": (
        *("120 iterations",),
        "num_steps=8 epochs=4 schedule=fixed learning_rate=1.5e-4; most of the starts for the targets",
    ),
}

TEXT = """# Unlearning's pace on a laptop

λ = 16 on the shipped G1 base, seed 0, 20 episodes a clip; intervals over the episodes. `python experiments/pace.py`
writes this page from `results/pace/`.

{table}
- Forgetting takes some hundred iterations, whatever their length: PPO's clip lets the policy go only so far in each. So
  iterations are short.
- What is kept pays for a short look-ahead: with 8 steps it lost more in half as many environment steps.
- A step size that falls from the start leaves the targets half-way; one that stays for half of the run does not, and
  what is kept settles in the second half.
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
        rows.append([settings, iterations, f"{steps / 1e6:.1f} M", *cells])
    base = document["base"]
    cells = [percent(base["target"]["success_rate"]), "", percent(base["kept"]["success_rate"]), ""]
    rows.insert(0, ["*the base*", "", "", *cells])
    header = ["settings", "", "steps", "target success", "target skill left", "kept success", "kept skill left"]
    PAGE.write_text(TEXT.format(table=markdown_table(header, rows)))
    print(f"page  {PAGE}")


if __name__ == "__main__":
    main()
