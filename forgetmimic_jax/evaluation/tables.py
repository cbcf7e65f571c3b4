"""evaluation.json as tables: on the terminal, in evaluation.md and in a README.

`python -m forgetmimic_jax.evaluation.tables README.md` fills every block of a Markdown file that names an
evaluation.json (`<!-- evaluation:start PATH -->` ... `<!-- evaluation:end -->`), so that no number is typed by hand.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from forgetmimic_jax.basics.errors import InputError, run_command
from forgetmimic_jax.evaluation import statistics
from forgetmimic_jax.evaluation.metrics import BASE, FINE_TUNED, UNLEARNED, ZERO_ACTION
from forgetmimic_jax.evaluation.statistics import Estimate

POLICY_ORDER = (BASE, UNLEARNED, "retrained", FINE_TUNED, ZERO_ACTION)

FORGOTTEN, KEPT = 0.2, 0.8  # a clip is forgotten at most, kept at least, at this share of the base's skill
WANTED = {"target": "forgotten", "kept": "kept"}
UNWANTED = {"target": "still known", "kept": "lost"}

REWARDS = {
    "tracking_reward",
    "survival_weighted_tracking",
    "success_rate",
    "skill",
    "retention",
}
UNITS = {
    "episode_length": "steps",
    "joint_position_error": "rad",
    "joint_velocity_error": "rad/s",
    "anchor_orientation_error": "rad",
    "foot_contact": "share",
    "joint_limit_violation": "share",
}  # every other error is a distance in m

BLOCK = re.compile(r"(<!-- evaluation:start (?P<path>\S+) -->\n).*?(<!-- evaluation:end -->)", re.DOTALL)


@dataclass(frozen=True)
class Rows:
    """A table as text: what the terminal, Markdown and the report show."""

    title: str
    header: list[str]
    rows: list[list[str]]


def render_table(document: Mapping[str, Any]) -> RenderableType:
    """What was forgotten and what was kept, at one glance, for `rich.console.Console.print`."""
    clips, groups = _clip_rows(document, digits=2, interval=False), _group_rows(document, digits=2)
    return Group(_rich(clips), _rich(groups), Text("\n".join(notes(document)), style="dim"))


def markdown(document: Mapping[str, Any]) -> str:
    """evaluation.md: the whole document, with the conditions it was measured under."""
    targets = ", ".join(document["targets"]) or "none"
    lines = [f"# Evaluation: {document['robot']}, targets: {targets}", "", *_conditions(document), ""]
    lines += [markdown_tables(document), _markdown(_error_rows(document))]
    return "\n".join(lines)


def result_tables(document: Mapping[str, Any]) -> list[Rows]:
    """The two tables of a result: clip by clip, and by group."""
    return [_clip_rows(document), _group_rows(document)]


def markdown_tables(document: Mapping[str, Any]) -> str:
    """The two tables of a result, clip by clip and by group, with their notes."""
    tables = [_markdown(table) for table in result_tables(document)]
    return "\n".join([*tables, *(f"- {note}" for note in notes(document)), ""])


def fill(text: str, directory: Path) -> str:
    """Markdown with every evaluation block rewritten from the file it names, relative to `directory`.

    Raises:
        InputError: a block names a file that is absent.
    """

    def tables(block: re.Match[str]) -> str:
        path = directory / block["path"]
        if not path.is_file():
            raise InputError(f"evaluation block: no file {block['path']}")
        document = json.loads(path.read_text())
        source = f"From `{block['path']}`: {_budget(document)}"
        return f"{block[1]}{source}\n\n{markdown_tables(document)}{block[3]}"

    return BLOCK.sub(tables, text)


def policy_order(document: Mapping[str, Any]) -> list[str]:
    """The policies of a document in the order that tables and figures show them."""
    policies = document["policies"]
    known = [policy for policy in POLICY_ORDER if policy in policies]
    return known + [policy for policy in policies if policy not in POLICY_ORDER]


def clip_order(document: Mapping[str, Any]) -> list[str]:
    """The clips of a document, targets first."""
    clips = next(iter(document["policies"].values()))["clips"]
    return sorted(clips, key=lambda name: (not clips[name]["target"], name))


def _subject(document: Mapping[str, Any]) -> str | None:
    """The policy that is compared with the base: the unlearned one, or the first other that was trained."""
    return next((policy for policy in policy_order(document) if policy not in (BASE, ZERO_ACTION)), None)


def _clip_rows(document: Mapping[str, Any], *, digits: int = 3, interval: bool = True) -> Rows:
    """One row a clip, targets first: success and tracking of base and subject, the floor, what is left."""
    policies, subject = document["policies"], _subject(document)
    shown = [policy for policy in (BASE, subject) if policy and policy in policies]
    arrow = " → ".join(_words(policy) for policy in shown)
    header = ["clip", "role", f"success, {arrow}", f"tracking, {arrow}"]
    header += ["floor"] * (ZERO_ACTION in policies) + ["left", "result"] * (len(shown) == 2)
    rows = []
    clips = policies[shown[0]]["clips"]
    for clip in clip_order(document):
        role = "target" if clips[clip]["target"] else "kept"
        of = {policy: policies[policy]["clips"][clip] for policy in policies}
        success = [percent(of[policy]["success_rate"], interval=interval) for policy in shown]
        tracking = [number(of[policy]["survival_weighted_tracking"], digits, interval) for policy in shown]
        row = [clip, role, " → ".join(success), " → ".join(tracking)]
        if ZERO_ACTION in policies:
            row.append(number(of[ZERO_ACTION]["survival_weighted_tracking"], digits, interval))
        if len(shown) == 2:
            left = of[shown[1]].get("skill" if ZERO_ACTION in policies else "retention")
            row += [percent(left, interval=interval), _verdict(left, role)]
        rows.append(row)
    return Rows("Clip by clip", header, rows)


def _verdict(left: Estimate | None, role: str) -> str:
    if left is None:
        return "not learned"
    if FORGOTTEN < left["mean"] < KEPT:
        return "weakened"
    return (WANTED if (left["mean"] <= FORGOTTEN) == (role == "target") else UNWANTED)[role]


def _group_rows(document: Mapping[str, Any], *, digits: int = 3) -> Rows:
    """Targets and kept clips of every policy, with intervals."""
    policies, order = document["policies"], policy_order(document)
    rows = []
    for group in ("target", "kept"):
        if not any(group in policies[policy] for policy in order):
            continue
        for label, metric, show in (
            ("success", "success_rate", percent),
            ("tracking", "survival_weighted_tracking", number),
            ("while alive", "tracking_reward", number),
            ("skill left", "skill", percent),
            ("retention", "retention", percent),
        ):
            cells = [show(policies[policy].get(group, {}).get(metric), digits) for policy in order]
            if any(cells):
                rows.append([f"{group} {label}", *cells])
    for label, metric in (
        ("degradation ratio", "degradation_ratio"),
        ("ratio of tracking", "survival_weighted_degradation_ratio"),
    ):
        cells = [number(policies[policy].get(metric), digits) for policy in order]
        if any(cells):
            rows.append([label, *cells])
    return Rows("Targets and kept clips", ["", *(_words(policy) for policy in order)], rows)


def _error_rows(document: Mapping[str, Any]) -> Rows:
    """Tracking errors and physical measures of every policy by group, over steps alive and over common steps."""
    policies, order = document["policies"], policy_order(document)
    rows = []
    for group in ("target", "kept"):
        metrics = policies[order[0]].get(group, {})
        for metric in sorted(metrics.keys() - REWARDS):
            name, common = metric.removesuffix("_common"), metric.endswith("_common")
            label = f"{_words(name)}, {UNITS.get(name, 'm')}{', common steps' if common else ''}"
            rows.append([f"{group}: {label}", *(number(policies[policy][group].get(metric)) for policy in order)])
    return Rows("Errors", ["", *(_words(policy) for policy in order)], rows)


def _conditions(document: Mapping[str, Any]) -> list[str]:
    return [
        f"- {_budget(document)}",
        f"- Checkpoint `{document['checkpoint']}`, settings `{document['config_hash']}`, "
        f"library `{document['library_hash']}`.",
        "- Deterministic actions, wrench and randomisation off; every policy meets the same start frames and resets.",
        "- In square brackets: the 95 % interval, by bootstrap over episodes stratified by clip; exact "
        "(Clopper-Pearson) for success. It covers this checkpoint's episodes, not other training seeds.",
    ]


def _budget(document: Mapping[str, Any]) -> str:
    costs = [
        f"{_words(policy)} {', '.join(f'{amount:,} {_words(unit)}' for unit, amount in sorted(cost.items()))}"
        for policy, cost in sorted(document.get("budget", {}).items())
    ]
    trained = f" Trained for: {'; '.join(costs)}." if costs else ""
    return f"Seed {document['seed']}, {document['episodes']} episodes a clip.{trained}"


def notes(document: Mapping[str, Any]) -> list[str]:
    """What a reader of the tables must know."""
    n = document["episodes"]
    nothing = statistics.rate(0, n)
    trained = bool(_subject(document)) and BASE in document["policies"]
    measure = "skill above the zero-action floor" if ZERO_ACTION in document["policies"] else "tracking"
    told = [
        "tracking: mean tracking reward over the horizon, 0 after a fall (survival-weighted); "
        "while alive: the paper's, over the steps before it.",
        f"0 successes of {n} still allow a rate of up to {100 * nothing['high']:.0f} % (95 % interval).",
    ]
    if document["targets"]:
        told.append("degradation ratio: target over kept, of tracking while alive (the paper's) and of tracking.")
    if trained:
        told.append(
            f"left: share of the base's {measure}; forgotten: at most {100 * FORGOTTEN:.0f} %, "
            f"kept: at least {100 * KEPT:.0f} %, not learned: the base itself is no better than the floor."
        )
    resets = {policy: summary["nan_resets"] for policy, summary in document["policies"].items()}
    if any(resets.values()):
        told.append(
            "episodes ended by a NaN: "
            + ", ".join(f"{_words(p)} {count}" for p, count in resets.items() if count)
            + "."
        )
    return told


def _words(name: str) -> str:
    return name.replace("_", " ")


def number(value: Estimate | None, digits: int = 3, interval: bool = True) -> str:
    """An estimate as "mean [low, high]"; empty where there is none."""
    return _cell(value, interval, digits, scale=1.0, unit="")


def percent(value: Estimate | None, digits: int = 0, interval: bool = True) -> str:
    """The same in whole per cent."""
    return _cell(value, interval, 0, scale=100.0, unit=" %")


def _cell(value: Estimate | None, interval: bool, digits: int, *, scale: float, unit: str) -> str:
    if value is None or "mean" not in value:
        return ""
    text = f"{scale * value['mean']:z,.{digits}f}{unit}"
    if interval and "low" in value:
        text += f" [{scale * value['low']:z,.{digits}f}, {scale * value['high']:z,.{digits}f}]"
    return text


def _markdown(table: Rows) -> str:
    return f"**{table.title}**\n\n{markdown_table(table.header, table.rows)}"


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table in Markdown, with the line end after its last row."""
    return "\n".join([*map(_line, [header, ["---"] * len(header), *rows]), ""])


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cell.replace('|', '&#124;') for cell in cells)} |"


def _rich(table: Rows) -> Table:
    colours = {text: "green" for text in WANTED.values()} | {text: "red" for text in UNWANTED.values()}
    view = Table(title=table.title, title_justify="left", box=box.SIMPLE_HEAD, collapse_padding=True, pad_edge=False)
    for column, name in enumerate(table.header):
        view.add_column(name, no_wrap=column == 0)
    for row in table.rows:
        view.add_row(*row[:-1], Text(row[-1], style=colours.get(row[-1], "")))
    return view


def main() -> None:
    """Fill the evaluation blocks of the Markdown files named on the command line."""
    for name in sys.argv[1:]:
        path = Path(name)
        path.write_text(fill(path.read_text(), path.parent))


if __name__ == "__main__":
    run_command(main)
