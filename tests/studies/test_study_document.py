"""A study's JSON, and who made what it says."""

import dataclasses
import json

import pytest

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.basics.provenance import provenance
from forgetmimic_jax.studies.document import (
    check_same_code,
    known_trials,
    made_by,
    origin_of,
    read_document,
    same_bases,
    write_document,
)

HERE = dataclasses.asdict(provenance())
VERSIONS = f" with JAX {HERE['jax']} and MuJoCo {HERE['mujoco']}"
OTHER = {**HERE, "code": "0123abcd", "commit": "f" * 40}


def document(groups: list[dict], variants: dict | None = None) -> dict:
    return {
        "schema": 3,
        "study": "s",
        "conditions": {},
        "made_by": groups,
        "failed": {},
        "results": {"variants": variants},
    }


def test_a_document_comes_back_with_nine_digits_and_a_line_for_each_innermost_table(tmp_path):
    content = document([], {"λ = 8": {"runs": {"0": {"x": 1 / 3, "y": [2.0, 1e6 / 7.0]}}}})
    path = tmp_path / "new" / "s.json"
    write_document(path, content)
    (found,) = read_document(path)["results"]["variants"].values()
    assert found == {"runs": {"0": {"x": 0.333333333, "y": [2.0, 142857.143]}}}
    assert json.loads(path.read_text()) == read_document(path)
    lines = [line.strip() for line in path.read_text().splitlines()]
    assert '"conditions": {},' in lines
    assert '"y": [2.0, 142857.143]' in lines
    assert read_document(tmp_path / "gone.json") is None


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "damaged: "),
        ('{"schema": 1, "study": "s"}', "schema: found 1; accepted: 3; remove it to measure again"),
    ],
)
def test_a_document_of_another_kind_is_refused(tmp_path, text, message):
    (tmp_path / "s.json").write_text(text)
    with pytest.raises(InputError, match=message):
        read_document(tmp_path / "s.json")


def test_runs_of_one_origin_are_one_group():
    runs = {"a, seed 0": HERE, "a, seed 1": OTHER, "b, seed 0": HERE}
    assert made_by(runs) == [{**HERE, "runs": ["a, seed 0", "b, seed 0"]}, {**OTHER, "runs": ["a, seed 1"]}]


def test_a_trials_origin_is_what_its_evaluation_says_or_this_process_for_its_own_code(tmp_path):
    for name, content in (("t-" + HERE["code"], {}), ("t-0123abcd", {}), ("t-9", {"made": OTHER})):
        (tmp_path / name).mkdir()
        (tmp_path / name / "evaluation.json").write_text(json.dumps(content))
    assert origin_of(tmp_path / f"t-{HERE['code']}") == HERE
    assert origin_of(tmp_path / "t-0123abcd") == {"code": "0123abcd"}
    assert origin_of(tmp_path / "t-9") == OTHER


def test_runs_of_other_code_are_only_added_to_where_the_user_mixes_them(tmp_path):
    path = tmp_path / "s.json"
    check_same_code(path, document([HERE]), mix=False)
    check_same_code(path, document([HERE, OTHER]), mix=True)
    with pytest.raises(InputError) as refused:
        check_same_code(path, document([HERE, OTHER]), mix=False)
    assert str(refused.value) == (
        f"{path}: made by code 0123abcd (commit fffffff){VERSIONS}, and this is code {HERE['code']}{VERSIONS}; "
        "--mix-commits puts their runs into one table, another --output keeps them apart"
    )
    with pytest.raises(InputError, match=rf"made by code {HERE['code']} .* with JAX 0.4.1 and MuJoCo"):
        check_same_code(path, document([HERE, {**HERE, "jax": "0.4.1"}]), mix=False)
    older = {"code": "", "commit": "abc1234" + 33 * "0"}
    for mix in (False, True):
        with pytest.raises(InputError, match=r"made by older code \(stored with commit abc1234\), which this"):
            check_same_code(path, document([older]), mix=mix)


def test_a_stored_run_can_stand_beside_new_ones_where_a_base_is_the_same():
    stored = {"conditions": {"bases": [{"policy": "aa"}, {"policy": "bb"}]}}
    assert same_bases(stored, {"bases": [{"policy": "bb"}, {"policy": "cc"}]})
    assert not same_bases(stored, {"bases": [{"policy": "cc"}]})


def test_what_is_no_study_says_nothing_of_trials(tmp_path):
    (tmp_path / "list.json").write_text("[1]")
    (tmp_path / "other.json").write_text('{"results": [1]}')
    (tmp_path / "old.json").write_text('{"schema": 1, "study": "old", "results": {}}')
    variants = {"a": {"runs": {"base 0, seed 0": {"x": 1}}, "trials": {"base 0, seed 0": "trial"}}}
    write_document(tmp_path / "new.json", document([{**OTHER, "runs": ["a, base 0, seed 0"]}], variants))
    assert known_trials(tmp_path) == {"trial": ("trial", {"x": 1}, OTHER)}
