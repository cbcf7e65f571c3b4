import json
import os
import subprocess
import sys

from forgetmimic_jax.basics.provenance import cores

LIMIT = 900  # s, far above what compilation takes here: only a run that waits forever needs longer
DEVICES = min(2, cores())  # of the training; the evaluation is on one
# LAPACK shares a batch out among XLA's threads from 15 matrices of the G1's size on.
ENVIRONMENTS, EPISODES = 16 * DEVICES, 6


def test_a_whole_run_with_mjx_on_a_cpu_ends(base_run, tmp_path):
    """On two cores it once waited forever, in training and in evaluation."""
    output = tmp_path / "run"
    settings = [f"ppo.num_envs={ENVIRONMENTS}", "ppo.num_steps=4", "ppo.minibatches=2"]
    command = [
        *(sys.executable, "-m", "forgetmimic_jax.unlearn", "--physics", "mjx", "--iterations", "2"),
        *(
            "--devices",
            DEVICES,
            "--base",
            base_run.checkpoint(4),
            "--targets",
            "turn",
            "--episodes",
            EPISODES,
            "--output",
            output,
        ),
        *("--set", *settings),
    ]
    done = subprocess.run(
        list(map(str, command)),
        env=os.environ | {"JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
        timeout=LIMIT,
    )
    assert done.returncode == 0, done.stderr
    document = json.loads((output / "evaluation.json").read_text())
    assert document["policies"].keys() == {"base", "unlearned", "zero_action"}
    for policy in document["policies"].values():
        assert policy["kept"]["success_rate"]["n"] == 2 * EPISODES
