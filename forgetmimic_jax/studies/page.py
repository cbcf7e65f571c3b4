"""The page of a study in Markdown, from its JSON alone."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from forgetmimic_jax.studies.claim import corrected, findings_table
from forgetmimic_jax.studies.document import code_text
from forgetmimic_jax.studies.lab import watched_episodes
from forgetmimic_jax.studies.study import Study

LAPTOP = (
    "- With the cpu preset unlearning is KL-regularised towards the base on the kept clips, weighs all clips the same "
    "and takes half of the starts from the targets. The paper does none of this, and neither do rows called plain PPO."
)
OVER_BASES = (
    "- In square brackets: the 95 % interval over the n bases (Student's t), where a base's number is the mean over "
    "its seeds. The base is the unit; one base has no interval."
)
OVER_SEEDS = (
    "- In square brackets: the 95 % interval over the n seeds of one base (Student's t). The seed is the unit, and the "
    "interval does not say what other bases would give; one seed has no interval."
)
WORDS = (
    "A claim *holds* where the whole 95 % interval of its number is on the right side of the bound, *does not hold* "
    "where it is on the wrong side, and is *open* between. The words are corrected for the number of claims (Holm; the "
    "main claim and the further findings apart), so a claim may be open although its own interval clears the bound. "
    "One run has no interval: its word only says to which side the number points."
)


def page(study: Study, document: Mapping[str, Any]) -> str:
    """The whole page."""
    lines = [
        f"# {study.title} ({size(document)})",
        "",
        f"{'Ours, not in the paper' if study.ours else 'The paper'}: {study.claim}",
        "",
        *conditions(study, document),
        "",
        study.body(document),
        "## What it says of the claim",
        "",
        findings_table(corrected(study.findings(document))),
        WORDS,
        "",
        f"![{study.title}]({study.name}.png)",
        "",
    ]
    return "\n".join(lines)


def conditions(study: Study, document: Mapping[str, Any]) -> Iterator[str]:
    """What the numbers were made with, a list item each."""
    conditions = document["conditions"]
    variants = document["results"].get("variants", {}).values()
    own_targets = any("targets" in variant["options"] for variant in variants)
    targets = "" if own_targets else f"; targets: {', '.join(conditions['targets'])}"
    episodes = watched_episodes(conditions["episodes"]) if study.watches else conditions["episodes"]
    steps = " and ".join(dict.fromkeys(f"{base['environment_steps']:,}" for base in conditions["bases"]))
    yield f"- Robot {conditions['robot']}; {size(document)}; bases trained for {steps} environment steps{targets}."
    yield (
        f"- {conditions['iterations']:,} iterations a run with the {conditions['preset']} preset, {episodes} episodes "
        "a clip."
    )
    yield from origins(document)
    if conditions["preset"] == "cpu":
        yield LAPTOP
    yield OVER_BASES if len(conditions["bases"]) > 1 else OVER_SEEDS
    for name, reason in document["failed"].items():
        yield f"- Failed: `{name}`: {reason}"


def size(document: Mapping[str, Any]) -> str:
    """How many bases a study has, and how many runs of each kind from each of them."""
    bases, seeds = len(document["conditions"]["bases"]), document["conditions"]["seeds"]
    return f"{bases} base{'s' * (bases > 1)} × {seeds} seed{'s' * (seeds > 1)}"


def origins(document: Mapping[str, Any]) -> Iterator[str]:
    """Which code and machine made the runs; where several did, which made which run."""
    groups = document["made_by"]
    older = [group["commit"][:7] for group in groups if not group["code"]]
    if older:
        yield f"- Made by older code (stored with commit {', '.join(older)}): today's code may give other numbers."
    for group in groups:
        if not group["code"]:
            continue
        machine = ""
        if "processor" in group:
            machine = f", Python {group['python']}, JAX {group['jax']}, MuJoCo {group['mujoco']}"
            machine += f", {group['cores']} cores of {group['processor']}"
        which = f": {_runs(group['runs'])}" if len(groups) > 1 else ""
        yield f"- Made by {code_text(group)}{machine}{which}."


def _runs(names: list[str]) -> str:
    """'λ = 8 (base 0, seeds 0, 1); λ = 16 (base 0, seed 0)' from the names of runs."""
    seeds: dict[tuple[str, str], list[str]] = {}
    for name in names:
        label, base, seed = name.rsplit(", ", 2)
        seeds.setdefault((label, base), []).append(seed.removeprefix("seed "))
    return "; ".join(
        f"{label} ({base}, seed{'s'[: len(of) - 1]} {', '.join(of)})" for (label, base), of in seeds.items()
    )
