"""The short trials behind the cpu preset: `python experiments/base_policy.py` redraws base_policy.md and its figure."""

from __future__ import annotations

import json
from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt

HERE = Path(__file__).parent
RESULTS = HERE / "results" / "base_policy"
# What each trial changed with --set, beside the settings all of them share.
SHARED = "ppo.gae_lambda=0.95 ppo.entropy_cost=0.002"
TRIALS = {
    "std_0.5_randomised": "ppo.initial_std=0.5 ppo.learning_rate=2e-4 noise.enabled=true",
    "std_0.5": "ppo.initial_std=0.5 ppo.learning_rate=2e-4",
    "std_1.0": "ppo.initial_std=1.0 ppo.learning_rate=3e-4",
    "std_1.0_8_steps": "ppo.initial_std=1.0 ppo.learning_rate=4e-4 ppo.num_steps=8 ppo.minibatches=2",
}
AT = (200_000, 400_000, 600_000, 800_000)
TEXT = """# What makes the base train faster: first trials

Mean episode length (control steps, exploration noise included) of single short trials on the twelve G1 clips, seed 0,
by environment steps. The trials with `initial_std=0.5` ran before the root-velocity and torque terms of the reward were
corrected. One seed each and a first version of the clip library (later refined), so a difference of a step
or two means nothing. All with the cpu preset and `{shared}`.
Curves: `results/base_policy/`; this page and its figure: `python experiments/base_policy.py`.

{table}

![episode length](results/base_policy/trials.png)

What they say: a wider exploration noise helps most (a joint hardly moves under narrow noise at 50 Hz, so little is
learned from it), although the noise itself shortens the episodes counted here; randomisation costs nothing measurable
this early; half the rollout with the same number of gradient steps a sample changes little. Noise correlated from step
to step was tried as well and tracked worse at twice the KL, so it is not in the code.
"""


def main() -> None:
    """Write base_policy.md and trials.png from the stored curves."""
    rows = ["| settings | " + " | ".join(f"{steps / 1e6:.1f} M" for steps in AT) + " |", "|---" * (len(AT) + 1) + "|"]
    for name, settings in TRIALS.items():
        curve = [json.loads(line) for line in (RESULTS / f"{name}.jsonl").read_text().splitlines()]
        steps = np.array([row["environment_steps"] for row in curve])
        length = np.array([row["episode_length"] for row in curve])
        plt.plot(steps / 1e6, length, label=name)
        cells = [f"{np.interp(at, steps, length):.1f}" if at <= steps[-1] else "" for at in AT]
        rows.append(f"| `{settings}` | " + " | ".join(cells) + " |")
    plt.xlabel("environment steps (millions)")
    plt.ylabel("mean episode length (control steps)")
    plt.legend()
    plt.savefig(RESULTS / "trials.png", dpi=110, bbox_inches="tight")
    (HERE / "base_policy.md").write_text(TEXT.format(shared=SHARED, table="\n".join(rows)))
    print(f"table   {HERE / 'base_policy.md'}\nfigure  {RESULTS / 'trials.png'}")


if __name__ == "__main__":
    main()
