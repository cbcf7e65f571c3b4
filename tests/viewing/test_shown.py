"""What `play` and `video` show without a checkpoint: what is shipped for the robot."""

from pathlib import Path

import pytest

from forgetmimic_jax.evaluation.document import read_evaluation
from forgetmimic_jax.training.checkpoint import policy_hash, read_info
from forgetmimic_jax.training.start import base_folder, shipped_policies
from forgetmimic_jax.viewing.options import Shown

RESULTS = Path(__file__).resolve().parents[2] / "experiments" / "results"


def test_the_g1_is_shown_with_its_base_and_with_the_policies_that_forgot():
    assert list(Shown().load().policies) == ["base", "arft", "stand"]


@pytest.mark.parametrize(("method", "results"), [("arft", "unlearn_g1"), ("stand", "unlearn_g1_stand")])
def test_the_shipped_policies_are_those_of_the_readme_s_numbers(method: str, results: str):
    document = read_evaluation(RESULTS / results / "evaluation.json")
    folders = {"base": base_folder("g1"), "unlearned": base_folder("g1").with_name(f"unlearned-{method}")}
    assert document.policy_hashes == {name: policy_hash(read_info(folder)) for name, folder in folders.items()}
    assert folders["unlearned"] in shipped_policies("g1", "unlearned")
    assert not (folders["unlearned"] / "run").exists()  # nothing to resume from: it is small
