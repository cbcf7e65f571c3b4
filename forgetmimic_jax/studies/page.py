"""The page of a study in Markdown, from its JSON alone."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from forgetmimic_jax.studies.claim import Finding, corrected, findings_table
from forgetmimic_jax.studies.document import code_text
from forgetmimic_jax.studies.lab import watched_episodes
from forgetmimic_jax.studies.study import Study

LAPTOP = (
    "- With the cpu preset unlearning is KL-regularised towards the base on the kept clips, weighs all clips the same "
    "and takes half of the starts from the targets. The paper does none of this, and neither do rows called plain PPO."
)
OVER_BASES = (
    "- In square brackets: the 95 % interval over the n bases (Student's t), where a base's number is the mean over "
    "its seeds. The base is the unit; one base has no interval. Where n counts seeds, the number is of one base alone: "
    "its interval is over those seeds, says nothing of the other bases and decides nothing."
)
OVER_SEEDS = (
    "- In square brackets: the 95 % interval over the n seeds of one base (Student's t). The seed is the unit, and the "
    "interval does not say what other bases would give; one seed has no interval."
)
OVER_TRAININGS = (
    "- In square brackets: the 95 % interval over the n seeds (Student's t), each of which is a whole training; one "
    "seed has no interval."
)
WITHOUT_SPREAD = (
    "- A spread of 0 is no certainty: the interval of a rate, or of a difference of two rates, is never narrower than "
    "that of all its episodes together, and any other number that is the same in every unit has no interval and "
    "decides nothing (*one value*)."
)
WORDS = (
    "A claim *holds* where the whole 95 % interval of its number is on the right side of the bound, *does not hold* "
    "where it is on the wrong side, and is *open* between. The words are corrected for the number of claims (Holm; the "
    "main claim and the further findings apart), so a claim may be open although its own interval clears the bound. "
    "One run has no interval: its word only says to which side the number points. Where an interval spans its "
    "bound, the page gives the number of units that would decide if mean and spread stayed as they are, before that "
    "correction."
)


def findings_of(study: Study, document: Mapping[str, Any]) -> list[Finding]:
    """What a study's numbers say, with the words that remain after the corrections."""
    bases = 1 if study.kind == "fresh" else len(document["conditions"]["bases"])
    return corrected(study.findings(document), bases)


def page(study: Study, document: Mapping[str, Any]) -> str:
    """The whole page."""
    lines = [
        f"# {study.title} ({size(study, document)})",
        "",
        f"{'Ours, not in the paper' if study.ours else 'The paper'}: {study.claim}",
        "",
        *conditions(study, document),
        "",
        study.body(document),
        "## What it says of the claim",
        "",
        findings_table(findings_of(study, document)),
        WORDS,
        "",
        f"![{study.title}]({study.name}.png)",
        "",
    ]
    return "\n".join(lines)


def conditions(study: Study, document: Mapping[str, Any]) -> Iterator[str]:
    """What the numbers were made with, a list item each."""
    conditions, several = document["conditions"], len(document["conditions"]["bases"]) > 1
    yield f"- Robot {conditions['robot']}; {size(study, document)}; {_subject(study, document)}."
    episodes = watched_episodes(conditions["episodes"]) if study.watches else conditions["episodes"]
    trained = f"{conditions['iterations']:,} iterations a run with the {conditions['preset']} preset, "
    yield f"- {'' if study.kind == 'rollout' else trained}{episodes} episodes a clip."
    yield from origins(document)
    if study.kind == "unlearn" and conditions["preset"] == "cpu":
        yield LAPTOP
    yield OVER_TRAININGS if study.kind == "fresh" else OVER_BASES if several else OVER_SEEDS
    yield WITHOUT_SPREAD
    for name, reason in document["failed"].items():
        yield f"- Failed: `{name}`: {reason}"


def _subject(study: Study, document: Mapping[str, Any]) -> str:
    """What the runs start from, and what they forget where that is one thing."""
    conditions = document["conditions"]
    if study.kind == "fresh":
        return "fresh policies, trained on all clips"
    steps = " and ".join(dict.fromkeys(f"{base['environment_steps']:,}" for base in conditions["bases"]))
    bases = f"bases trained for {steps} environment steps"
    if study.kind == "rollout":
        return f"{bases}, which are not trained further"
    variants = document["results"].get("variants", {}).values()
    own_targets = study.own_targets or any("targets" in variant["options"] for variant in variants)
    return bases if own_targets else f"{bases}; targets: {', '.join(conditions['targets'])}"


def size(study: Study, document: Mapping[str, Any]) -> str:
    """How many bases a study has, and how many runs of each kind from each of them."""
    bases, seeds = len(document["conditions"]["bases"]), document["conditions"]["seeds"]
    of_base, of_seed = f"{bases} base{'s' * (bases > 1)}", f"{seeds} seed{'s' * (seeds > 1)}"
    return {"unlearn": f"{of_base} × {of_seed}", "fresh": of_seed, "rollout": of_base}[study.kind]


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
            machine += f", {group['cores']} core{'' if group['cores'] == 1 else 's'} of {group['processor']}"
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
