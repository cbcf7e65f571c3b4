"""Are several small trainings faster at once than one after the other? `python experiments/parallel_trials.py`.

As processes of their own, as a sweep's trials are, each with as many threads as it likes; or vmapped into one. Run it
with nothing else on the cores (some seven minutes on two); `--draw` rewrites the page from the JSON alone.
"""

from __future__ import annotations

import dataclasses
import os
import statistics
import subprocess
import sys
import time
from pathlib import Path

from forgetmimic_jax.studies.study import measured_page

HERE = Path(__file__).parent
RESULT = HERE / "results" / "parallel_trials.json"
PAGE = HERE / "parallel_trials.md"
ARMS = {"one": (1, 1), "two processes": (2, 1), "two vmapped": (1, 2)}  # processes, members
ROUNDS = 2
ITERATIONS, SETTLED = 40, 10  # of each training; those after the tenth count

TEXT = """# Several trainings at once

`make unlearn` of the shipped G1 on {cores} cores: iterations {settled} to {iterations} of trainings that start at once,
{rounds} alternating rounds. `.venv/bin/python experiments/parallel_trials.py` measures it again (on quiet cores, some
seven minutes), `--draw` rewrites this page from `results/parallel_trials.json`.

| trainings at once | environment steps/s of all together, over one alone: median | lowest | highest |
|---|---|---|---|
{rows}

Vmapped, one program makes both policies' iterations and the physics of one member after the other. Sweeps and studies
run processes: `--jobs` is how many. One that fails or is stopped leaves the others alone.
"""


def train(members: int) -> float:
    """Environment steps/s of an unlearning run, or of several with other seeds vmapped into one."""
    import jax
    import jax.numpy as jnp

    from forgetmimic_jax import unlearn
    from forgetmimic_jax.ppo.update import make_iteration
    from forgetmimic_jax.training import runner

    config = unlearn.config_of_new_run(unlearn.Options())
    setup = runner.with_base(runner.make_setup(config))
    iterate = make_iteration(setup.env)
    states = [
        runner.start_state(dataclasses.replace(setup, config=dataclasses.replace(config, seed=seed)))
        for seed in range(members)
    ]
    state = states[0]
    if members > 1:
        state = jax.tree.map(lambda *leaves: jnp.stack(leaves), *states)
        iterate = jax.jit(jax.vmap(iterate, in_axes=(None, 0)), donate_argnums=1)
    for iteration in range(ITERATIONS):
        if iteration == SETTLED:
            start = time.perf_counter()
        state, metrics = iterate(setup.assets, state)
        jax.block_until_ready(metrics)
    steps = members * (ITERATIONS - SETTLED) * config.ppo.num_envs * config.ppo.num_steps
    return steps / (time.perf_counter() - start)


def rate(processes: int, members: int) -> float:
    """Environment steps/s of all processes together."""
    command = [sys.executable, __file__, "--members", str(members)]
    running = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(processes)]
    printed = [process.communicate()[0] for process in running]
    if any(process.returncode for process in running):
        raise SystemExit(f"{' '.join(command)} failed")
    return sum(float(text.split()[-1]) for text in printed)


def measure() -> dict:
    """Each arm over one alone of the same round."""
    rounds = [{arm: rate(*of) for arm, of in ARMS.items()} for _ in range(ROUNDS)]
    ratios = {arm: [found[arm] / found["one"] for found in rounds] for arm in ARMS}
    return {"cores": os.cpu_count(), "rounds": ROUNDS, "iterations": [SETTLED, ITERATIONS], "ratios": ratios}


def page(found: dict) -> str:
    """The page of the stored numbers."""
    rows = [
        f"| {arm} | {statistics.median(ratios):.2f} | {min(ratios):.2f} | {max(ratios):.2f} |"
        for arm, ratios in found["ratios"].items()
    ]
    settled, iterations = found["iterations"]
    told = {"settled": settled + 1, "iterations": iterations, "rows": "\n".join(rows)}
    return TEXT.format(cores=found["cores"], rounds=found["rounds"], **told)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--members"]:
        print(train(int(sys.argv[2])))
    else:
        measured_page(measure, page, RESULT, PAGE)
