"""The rows of metrics.jsonl."""

import numpy as np

from forgetmimic_jax.basics.files import read_rows
from forgetmimic_jax.training.log import Log


def test_a_row_is_the_mean_of_the_iterations_that_have_a_number_and_leaves_out_what_none_has(tmp_path):
    def metrics(iteration: int) -> dict[str, np.ndarray]:
        """Every third iteration simulates steps of targets, none any of kept clips."""
        return {
            "clip/steps": np.full(1, 8.0),
            "clip/probability": np.ones(1),
            "entropy": np.float32(iteration),
            "target/step_share": np.float32(iteration % 3 == 0),
            "target/lambda_crit": np.float32(np.nan if iteration % 3 else iteration),
            "kept/lambda_crit": np.float32(np.nan),
        }

    with Log(tmp_path, 0, 0) as log:
        for iteration in range(1, 13):
            log.add(metrics(iteration))
            if iteration in (1, 10, 12):
                log.write(iteration, 8 * iteration, ("run",))
    found = {row["iteration"]: row for row in read_rows(tmp_path / "metrics.jsonl")}
    assert "target/lambda_crit" not in found[1]
    assert found[1]["target/step_share"] == 0.0
    assert found[10]["target/lambda_crit"] == 6.0  # of 3, 6 and 9
    assert found[12]["target/lambda_crit"] == 12.0  # of 12 alone, without 11
    assert found[10]["entropy"] == 6.0  # of 2 to 10
    assert not any("kept/lambda_crit" in row for row in found.values())


def test_a_note_joins_the_row_and_its_clips(tmp_path):
    metrics = {"clip/steps": np.array([6.0, 2.0]), "clip/probability": np.array([0.5, 0.5])}
    note = {"phase": "lagging", "clips": {"walk": {"state": "mastered"}, "kick": {"state": "new"}}}
    with Log(tmp_path, 0, 0) as log:
        log.add(metrics)
        log.write(1, 8, ("walk", "kick"), note)
    (row,) = read_rows(tmp_path / "metrics.jsonl")
    assert row["phase"] == "lagging"
    assert row["clips"]["walk"] == {"state": "mastered", "probability": 0.5, "step_share": 0.75}
    assert row["clips"]["kick"] == {"state": "new", "probability": 0.5, "step_share": 0.25}
