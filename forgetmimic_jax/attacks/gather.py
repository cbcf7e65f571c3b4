"""All attacks on one policy, one after another, and the document that they make."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

from forgetmimic_jax.attacks import (
    held_out,
    look_alikes,
    membership,
    near_duplicates,
    numerics,
    recovery,
    relearning,
    safety,
    splices,
)
from forgetmimic_jax.attacks.case import TRAINED, Case, Scale, originals
from forgetmimic_jax.attacks.document import (
    SCHEMA,
    Curve,
    EvidenceDocument,
    LookAlikes,
    Membership,
    NearDuplicates,
    Numerics,
    Originals,
    Recovery,
    Relearning,
    Splices,
)
from forgetmimic_jax.attacks.fine_tuning import FineTuning
from forgetmimic_jax.attacks.parts import Meter, Parts
from forgetmimic_jax.attacks.recovery import Workshop
from forgetmimic_jax.basics.console import progress
from forgetmimic_jax.basics.provenance import made_here, provenance
from forgetmimic_jax.evaluation.document import UnboundedResult

FULL = Scale(
    episodes=40, target_episodes=100, variant_episodes=40, kept_variant_episodes=8, hosts=4, relearning_iterations=300,
    held_out_iterations=100,
    seeds=3,
)  # fmt: skip


def costs(scale: Scale) -> dict[str, int]:
    """About how long each attack takes, in iterations of a training on a laptop."""
    simulated = scale.episodes / Scale.episodes
    trained = {
        "recovery": len(TRAINED) * scale.recovery_iterations,
        "relearning": 2 * scale.relearning_iterations,
        "held_out": 2 * scale.held_out_iterations,
    }
    rolled = {"originals": 60, "near_duplicates": 45, "splices": 10, "look_alikes": 5, "numerics": 35}
    rolled |= {"membership": 40, "safety": 15}
    return {name: max(1, round(simulated * cost)) for name, cost in rolled.items()} | {
        name: scale.seeds * cost for name, cost in trained.items()
    }


def conditions(case: Case, policy_hashes: dict[str, str]) -> dict[str, Any]:
    """What the parts are of."""
    return {
        "policies": policy_hashes,
        "library": case.setup.library_hash,
        "targets": list(case.targets),
        "seed": case.seed,
        "scale": dataclasses.asdict(case.scale),
        "code": provenance().code,
    }


def gather(
    case: Case, parts: Parts, *, method: str, control_method: str, policy_hashes: dict[str, str], train: bool = True
) -> EvidenceDocument:
    """Every attack that is not in the folder yet, then the document of all.

    Args:
        case: the policies.
        parts: of this case.
        method: of unlearning, by name.
        control_method: of the control, likewise.
        policy_hashes: of base, unlearned and control.
        train: also the attacks that train; without them they are absent from the document.
    """
    price = costs(case.scale)
    attacks: dict[str, tuple[Any, Callable[[], Any]]] = {
        "originals": (Originals, lambda: originals(case)),
        "near_duplicates": (NearDuplicates, lambda: near_duplicates.attack(case)),
        "splices": (Splices, lambda: splices.attack(case)),
        "look_alikes": (LookAlikes, lambda: look_alikes.attack(case)),
        "numerics": (Numerics, lambda: numerics.attack(case)),
        "membership": (dict[str, Membership], lambda: membership.attack(case)),
        "safety": (dict[str, UnboundedResult], lambda: safety.attack(case)),
    }
    if train:

        @functools.cache
        def workshop() -> Workshop:
            clips = [*case.clips.values(), *held_out.shown(case)]
            return Workshop(FineTuning(case.setup, clips), parts.policy, meter.tick)

        def relearn() -> Relearning:
            def curve(name: str, make: Callable[[], Curve]) -> Curve:
                return parts.part(name, Curve, make)

            return relearning.attack(case, workshop(), curve, to_the_end=case.scale.seeds > 1)

        attacks |= {
            "recovery": (Recovery, lambda: recovery.attack(case, workshop())),
            "relearning": (Relearning, relearn),
            "held_out": (Recovery, lambda: held_out.attack(case, workshop())),
        }
    total = sum(price[name] for name in attacks)
    found: dict[str, Any] = {}
    with progress("evidence", total) as show:
        meter = Meter(show, price)
        for name, (kind, make) in attacks.items():
            found[name] = parts.part(name, kind, make)
            meter.finished(name)
    return EvidenceDocument(
        schema=SCHEMA,
        robot=case.setup.robot.name,
        targets=list(case.targets),
        method=method,
        control_method=control_method,
        library_hash=case.setup.library_hash,
        policy_hashes=policy_hashes,
        episodes=case.scale.episodes,
        seeds=case.scale.seeds,
        made=made_here(),
        **found,
    )
