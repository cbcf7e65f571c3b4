"""The rows of experiments/README.md."""

from experiments import claims
from forgetmimic_jax.evaluation.repeats import Repeat
from forgetmimic_jax.studies.claim import answer
from forgetmimic_jax.studies.conduct import RESULTS
from forgetmimic_jax.studies.document import read_document, write_document
from forgetmimic_jax.studies.page import findings_of, page


def test_each_study_is_a_row_and_one_that_is_not_measured_is_named(tmp_path):
    def group(success: float, skill: float) -> dict:
        return {"success_rate": success, "survival_weighted_tracking": success, "skill": skill, "episodes": 4000}

    runs = {
        str(Repeat(0, seed)): {
            "policy": {"target": group(0.0, 0.1 + 0.01 * seed), "kept": group(0.9, 1.0)},
            "base": {"target": group(1.0, 1.0), "kept": group(0.9, 1.0)},
        }
        for seed in range(3)
    }
    results = {"variants": {"λ = 16": {"options": {}, "trials": {}, "runs": runs}}}
    (tmp_path / "g1").mkdir()
    document = {"schema": 3, "study": "validity", "conditions": {"bases": [{}], "seeds": 3}, "results": results}
    write_document(tmp_path / "g1" / "validity.json", document)
    text = claims.table(tmp_path)
    header, _, row = text.splitlines()[:3]
    assert header == "| the paper's claim | here | what was measured | the paper's number | runs of each kind | study |"
    assert row == (
        "| With λ = 16 the targets are forgotten and the other clips are kept. | **holds** | With λ = 16, 0 % [0, 0] "
        "of the target episodes succeed, 11 % [9, 13] of the skill is retained, and the success rate on the other "
        "clips changes by 0 % [-1, 1] against the base. | 0 % of the target episodes succeed; kept success from 74 to "
        "68 % in its table, above 85 % in its text | 1 base × 3 seeds | [validity](results/g1/validity.md) |"
    )
    assert "Not measured yet: g1/comparison, g1/penalty," in text


MEASURED = [name for name in claims.STUDIES if (RESULTS / f"{name}.json").is_file()]


def test_the_readme_has_a_row_for_every_study_of_the_stored_numbers():
    text = claims.README.read_text()
    block = claims.BLOCK.search(text)
    assert block
    assert block[0].count("results/") == len(MEASURED) >= 10
    assert claims.BLOCK.sub(lambda block: f"{block[1]}{claims.table()}{block[2]}", text) == text, "run `make tables`"


def test_the_stored_pages_are_those_of_the_stored_numbers_and_say_what_made_them():
    for name in MEASURED:
        study = claims.STUDIES[name]
        document = read_document(RESULTS / f"{name}.json")
        text = (RESULTS / f"{name}.md").read_text()
        assert page(study, document) == text, "run `make tables`"
        assert "\n- Made by " in text
        found = answer(study.claim, findings_of(study, document))
        runs = 1 if name.endswith("generality") else 3  # it rolls out bases alone, and one is shipped
        assert found.n == runs or found.word == "not measured"
