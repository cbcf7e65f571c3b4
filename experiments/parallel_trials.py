"""Are several small trainings faster at once than one after the other? `python experiments/parallel_trials.py`.

Each is a process of its own, as a sweep's trials are, with as many threads as it likes. Run it with nothing else on the
cores (some five minutes on two); `--draw` rewrites the page from the JSON alone.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

from forgetmimic_jax.study import measured_page

HERE = Path(__file__).parent
RESULT = HERE / "results" / "parallel_trials.json"
PAGE = HERE / "parallel_trials.md"
JOBS, ROUNDS = (1, 2), 2
ITERATIONS, SETTLED = 20, 10  # of each training; those after the tenth count

TEXT = """# Several trainings at once

Fine-tuning of the shipped G1 base with the cpu preset on {cores} cores, as processes of their own, {rounds} alternating
rounds. `.venv/bin/python experiments/parallel_trials.py` measures it again, `--draw` rewrites this page from
`results/parallel_trials.json`.

| trainings at once | environment steps/s of all together, over one alone: median | lowest | highest |
|---|---|---|---|
{rows}

`--jobs` of the studies and sweeps is how many of their trials run at once.
"""


def rate(jobs: int) -> float:
    """Environment steps/s of `jobs` trainings together."""
    with tempfile.TemporaryDirectory() as folder:
        outputs = [Path(folder) / str(job) for job in range(jobs)]
        command = [sys.executable, "-m", "forgetmimic_jax.train", "--base", "data/g1/base", "--iterations"]
        command += [str(ITERATIONS), "--set", "evaluate_every=0", "--output"]
        running = [subprocess.Popen([*command, str(output)], stdout=subprocess.DEVNULL) for output in outputs]
        for process in running:
            if process.wait():
                raise SystemExit(f"{' '.join(command)}: exit code {process.returncode}")
        total = 0.0
        for output in outputs:
            rows = [json.loads(line) for line in (output / "metrics.jsonl").read_text().splitlines()]
            start, end = (next(row for row in rows if row["iteration"] == at) for at in (SETTLED, ITERATIONS))
            seconds = sum(row["seconds"] for row in rows if row["iteration"] > SETTLED)
            total += (end["environment_steps"] - start["environment_steps"]) / seconds
        return total


def measure() -> dict:
    """All together over one alone of the same round, for each number of trainings."""
    rounds = [[rate(jobs) for jobs in JOBS] for _ in range(ROUNDS)]
    ratios = {str(jobs): [found[place] / found[0] for found in rounds] for place, jobs in enumerate(JOBS)}
    return {"cores": os.cpu_count(), "rounds": ROUNDS, "ratios": ratios}


def page(found: dict) -> str:
    """The page of the stored numbers."""
    rows = [
        f"| {jobs} | {statistics.median(ratios):.2f} | {min(ratios):.2f} | {max(ratios):.2f} |"
        for jobs, ratios in found["ratios"].items()
    ]
    return TEXT.format(cores=found["cores"], rounds=found["rounds"], rows="\n".join(rows))


if __name__ == "__main__":
    measured_page(measure, page, RESULT, PAGE)
