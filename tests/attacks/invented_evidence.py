"""Made-up evidence: a policy that is consistent with retraining, for a test to change one number of."""

import copy
from typing import Any

import msgspec

from forgetmimic_jax.attacks.document import SCHEMA, EvidenceDocument
from forgetmimic_jax.basics.provenance import Provenance


def estimate(mean: float, reach: float = 0.02) -> dict[str, float]:
    """A mean and an interval that reaches as far on both sides."""
    return {"mean": mean, "low": mean - reach, "high": mean + reach, "n": 20}


def numbers(skill: float, content: float, above: float | None = None, reach: float = 0.02) -> dict[str, Any]:
    """Skill and motion content, both by `above` above another policy's."""
    found: dict[str, Any] = {"skill": estimate(skill, reach), "content": estimate(content, reach)}
    if above is not None:
        found |= {"skill_above": estimate(above, reach), "content_above": estimate(above, reach)}
    return found


def compared(unlearned: float, control: float) -> dict[str, Any]:
    """Base, unlearned policy and control, whose skill is their motion content too."""
    return {
        "base": numbers(1.0, 0.95),
        "unlearned": numbers(unlearned, unlearned, unlearned - control),
        "control": numbers(control, control),
    }


def curve(steps: float) -> dict[str, list[float]]:
    """Tracking that rises over 0.9 of the base's after `steps` target steps, and stays there."""
    return {
        "iterations": [0.0, 10.0, 20.0, 30.0],
        "tracking": [0.1, 0.1, 0.75, 0.75],
        "target_steps": [0.0, steps / 2, steps, 1.5 * steps],
    }


PLAIN: dict[str, Any] = {
    "schema": SCHEMA,
    "robot": "g1",
    "targets": ["punch"],
    "method": "arft",
    "control_method": "distill",
    "library_hash": "library",
    "policy_hashes": {"base": "b", "unlearned": "u", "control": "c"},
    "episodes": 20,
    "seeds": 1,
    "made": msgspec.to_builtins(Provenance("code", "commit", "3.12", "0.7", "3.3", "processor", 2)),
    "originals": {
        "targets": {"punch": compared(0.05, 0.25)},
        "kept": {clip: compared(0.95, 0.93) for clip in ("walk", "run")},
    },
    "near_duplicates": {
        "families": {f"punch, {family}": compared(0.05, 0.25) for family in ("speed", "mirrored")},
        "variants": {"punch_speed_0.75": compared(0.0, 0.2), "punch_mirrored": compared(0.15, 0.3)},
        "dropped": {},
        "kept": {"speed": compared(0.9, 0.85)},
    },
    "recovery": {
        "iterations": 100,
        "before": {"punch": compared(0.05, 0.25)},
        "after": {"punch": compared(0.2, 0.3)},
    },
    "relearning": {
        "base": {"0": 0.8},
        "starts": {"unlearned": {"0": curve(60_000)}, "control": {"0": curve(100_000)}},
    },
    "numerics": {
        "before": {"punch": compared(0.05, 0.25)},
        "changes": {"int4": {"punch": {"unlearned": numbers(0.08, 0.08, 0.03)}}},
        "kept": {"int4": estimate(0.9)},
        "kept_before": estimate(0.92),
    },
}


def evidence(**changes: Any) -> EvidenceDocument:
    """The plain evidence with other values at dotted places: `recovery__after__unlearned=...`; None removes one."""
    content = copy.deepcopy(PLAIN)
    for place, value in changes.items():
        *sections, name = place.split("__")
        table = content
        for section in sections:
            table = table[section]
        if value is None:
            del table[name]
        else:
            table[name] = value
    return msgspec.convert(content, EvidenceDocument)
