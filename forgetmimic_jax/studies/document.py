"""The JSON of a study: the one source of its page, its figure and its claims.

{"schema", "study", "conditions": {...}, "made_by": [{"code", "commit", ..., "runs": [...]}], "failed": {trial: why},
"results": {...}}; `conditions` is what the results answer, `made_by` says which code and machine made which runs.

A run's `code` is the package's. The files in `experiments/` are no part of it: what they give a trial is in the trial's
name and in `conditions`, and the rest asks and shows, so that a page can be mended without running its trials again.
The `commit` beside it says which they were, with "+changes" where they were changed since.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.basics.files import write_atomically
from forgetmimic_jax.basics.provenance import provenance
from forgetmimic_jax.evaluation.repeats import Repeat

SCHEMA = 3
DECIDING = ("code", "jax", "mujoco")  # fields of `Provenance` that decide a run's numbers
DIGITS = 9  # significant ones of a number


class Known(NamedTuple):
    """What a study's JSON says of a trial: its name, its `variants.summary`, and what made it."""

    trial: str
    summary: Mapping[str, Any]
    made_by: Mapping[str, Any]


def read_document(path: Path) -> dict[str, Any] | None:
    """A study's JSON, if there is one.

    Raises:
        InputError: the file is damaged, or of an earlier version of the package.
    """
    try:
        document = json.loads(path.read_text()) if path.is_file() else None
    except ValueError as error:
        raise InputError(f"{path}: damaged: {error}; remove it to measure again") from None
    if document is not None and document.get("schema") != SCHEMA:
        raise InputError(
            f"{path}: schema: found {document.get('schema')}; accepted: {SCHEMA}; remove it to measure again"
        )
    return document


def write_document(path: Path, document: Mapping[str, Any]) -> None:
    """Write a study's JSON; numbers are rounded to `DIGITS` significant digits."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, ("".join(_json(_rounded(document))) + "\n").encode())


def run_name(label: str, repeat: Repeat | str) -> str:
    """A run in `made_by`."""
    return f"{label}, {repeat}"


def made_by(runs: Mapping[str, Mapping[str, Any]]) -> list[dict[str, Any]]:
    """What made each run, by `run_name`, as groups of runs with the same origin."""
    groups: list[dict[str, Any]] = []
    for name, origin in runs.items():
        group = next((group for group in groups if {**group, "runs": None} == {**origin, "runs": None}), None)
        if group is None:
            groups.append({**origin, "runs": [name]})
        else:
            group["runs"].append(name)
    return groups


def origin_of(trial: Path) -> dict[str, Any]:
    """What made a finished trial: what its evaluation says, or this process if the code is this process's."""
    said = json.loads((trial / "evaluation.json").read_text()).get("made")
    if said:
        return said
    here, code = dataclasses.asdict(provenance()), trial.name.rpartition("-")[2]
    return here if code == here["code"] else {"code": code}


def same_bases(document: Mapping[str, Any], conditions: Mapping[str, Any]) -> bool:
    """Whether a stored run could stand beside a new one: the same policy is a base of both."""
    before, now = ({base["policy"] for base in of["bases"]} for of in (document["conditions"], conditions))
    return bool(before & now)


def check_same_code(path: Path, document: Mapping[str, Any], *, mix: bool) -> None:
    """A study may only add runs to those of its JSON if the same code made them, or if the user mixes them.

    Code is the package's, with the versions of JAX and MuJoCo.

    Raises:
        InputError: other code made them.
    """
    here = dataclasses.asdict(provenance())
    others = [
        group for group in document["made_by"] if any(group.get(name, here[name]) != here[name] for name in DECIDING)
    ]
    if not others:
        return
    codes = " and ".join(code_text(group) + _versions(group) for group in others)
    if not all(group["code"] for group in others):
        raise InputError(
            f"{path}: made by {codes}, which this study cannot continue; choose another --output, or remove the file "
            "to measure again"
        )
    if not mix:
        raise InputError(
            f"{path}: made by {codes}, and this is code {here['code']}{_versions(here)}; --mix-commits puts their "
            "runs into one table, another --output keeps them apart"
        )


def code_text(group: Mapping[str, Any]) -> str:
    """The code of a group of `made_by` in words."""
    commit = f"commit {group['commit'][:7]}" if "commit" in group else "commit unknown"
    return f"code {group['code']} ({commit})" if group["code"] else f"older code (stored with {commit})"


def _versions(group: Mapping[str, Any]) -> str:
    return f" with JAX {group['jax']} and MuJoCo {group['mujoco']}" if {"jax", "mujoco"} <= group.keys() else ""


def known_trials(folder: Path) -> dict[str, Known]:
    """What the studies in a folder say of the trials of their variants, by the trial's name."""
    known = {}
    for path in sorted(folder.glob("*.json")):
        document = _study(path)
        if document is None:
            continue
        origins = {run: group for group in document["made_by"] for run in group["runs"]}
        for label, variant in document["results"].get("variants", {}).items():
            for repeat, name in variant["trials"].items():
                origin = {key: value for key, value in origins[run_name(label, repeat)].items() if key != "runs"}
                known[name] = Known(name, variant["runs"][repeat], origin)
    return known


def _study(path: Path) -> dict[str, Any] | None:
    """A study's JSON; None for any other file."""
    try:
        document = json.loads(path.read_text())
    except ValueError as error:
        raise InputError(f"{path}: damaged: {error}; remove it to measure again") from None
    return document if isinstance(document, dict) and "study" in document and document["schema"] == SCHEMA else None


def _rounded(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _rounded(of) for name, of in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(of) for of in value]
    return float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value


def _json(value: Any, indent: str = "") -> Iterator[str]:
    """JSON with one line for each object or list that holds none."""
    inner = list(value.values()) if isinstance(value, dict) else value if isinstance(value, list) else []
    if not any(isinstance(of, dict | list) for of in inner):
        yield json.dumps(value, ensure_ascii=False, allow_nan=False)
        return
    is_dict = isinstance(value, dict)
    names = [f"{json.dumps(name, ensure_ascii=False)}: " for name in value] if is_dict else [""] * len(inner)
    yield "{" if is_dict else "["
    for place, (name, of) in enumerate(zip(names, inner, strict=True)):
        yield f"{',' if place else ''}\n{indent} {name}"
        yield from _json(of, f"{indent} ")
    yield f"\n{indent}{'}' if is_dict else ']'}"
