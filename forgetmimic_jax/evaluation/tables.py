"""evaluation.json as tables: on the terminal, in evaluation.md and in a README.

`python -m forgetmimic_jax.evaluation.tables README.md` fills every block of a Markdown file that names an
evaluation.json (`<!-- evaluation:start PATH -->` ... `<!-- evaluation:end -->`), so that no number is typed by hand.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
from rich import box
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from forgetmimic_jax.basics.errors import InputError, run_command
from forgetmimic_jax.basics.files import write_atomically
from forgetmimic_jax.evaluation import statistics
from forgetmimic_jax.evaluation.document import Estimate, EvaluationDocument, GroupResult, read_evaluation
from forgetmimic_jax.evaluation.metrics import BASE, FINE_TUNED, HOLD_SECONDS, UNLEARNED, ZERO_ACTION

POLICY_ORDER = (BASE, UNLEARNED, "retrained", FINE_TUNED, ZERO_ACTION)

# Shares of the base's skill: a target is forgotten at FORGOTTEN or less, a kept clip is kept at KEPT or more. One clip
# varies more from training to training than the mean of all: on the G1 three distilled policies retain 93 % of the kept
# clips' skill on average, and 68, 77 and 81 % on their weakest clip. Below KEPT_CLIP a clip is not kept.
FORGOTTEN, KEPT, KEPT_CLIP = 0.2, 0.8, 0.5
COLOURS = {"forgotten": "green", "kept": "green", "still known": "red", "not kept": "red"}

UNITS = {
    "episode_length": "steps",
    "joint_position_error": "rad",
    "joint_velocity_error": "rad/s",
    "anchor_orientation_error": "rad",
    "foot_contact": "share",
    "joint_limit_violation": "share",
}  # every other error is a distance in m

UNBOUNDED = {
    "upright_rate": "upright until the end",
    "safe_rate": "safe: upright, no impact above one body weight",
    "time_to_fall": "time until the first fall, s",
    "impact_force_median": "largest impact, median, body weights",
    "impact_force_95": "largest impact, 95th percentile, body weights",
    "impact_rate": "impact above one body weight",
    "impact_speed": "root's speed downward before the first impact, m/s",
    "head_contact_rate": "the head touches the floor",
    "hand_contact_rate": "a hand touches the floor",
    "torque_saturation": "torque above 95 % of its limit, share",
    "joint_limit_violation": "joint beyond its soft limits, share",
    "joint_speed_violation": "joint faster than its motor, share",
    "motion_content": "motion content",
    "attempt_rate": "attempts the clip: motion content above 0.3",
}  # numbers of episodes that no termination ends

BLOCK = re.compile(r"(<!-- evaluation:start (?P<path>\S+) -->\n).*?(<!-- evaluation:end -->)", re.DOTALL)


@dataclass(frozen=True)
class Rows:
    """A table as text: what the terminal, Markdown and the report show."""

    title: str
    header: list[str]
    rows: list[list[str]]


def render_table(document: EvaluationDocument) -> RenderableType:
    """What was forgotten and what was kept, at one glance, for `rich.console.Console.print`."""
    tables = [_clip_rows(document, digits=2, interval=False), _group_rows(document, digits=2)]
    tables += unbounded_in_brief(document)
    return Group(*map(_rich, tables), Text("\n".join(notes(document)), style="dim"))


def markdown(document: EvaluationDocument) -> str:
    """evaluation.md: the whole document, with the conditions it was measured under."""
    targets = ", ".join(document.targets) or "none"
    lines = [f"# Evaluation: {document.robot}, targets: {targets}", "", *_conditions(document), ""]
    lines += [markdown_tables(document), *map(_markdown, unbounded_tables(document)), _markdown(_error_rows(document))]
    return "\n".join(lines)


def result_tables(document: EvaluationDocument) -> list[Rows]:
    """The two tables of a result: clip by clip, and by group."""
    return [_clip_rows(document), _group_rows(document)]


def markdown_tables(document: EvaluationDocument) -> str:
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
        document = read_evaluation(path)
        source = f"From `{block['path']}`: {_budget(document)}{_code(document)}"
        return f"{block[1]}{source}\n\n{_summary(document)}\n{block[3]}"

    return BLOCK.sub(tables, text)


def unbounded_tables(document: EvaluationDocument) -> list[Rows]:
    """What the robot did on the targets in episodes that no termination ends; nothing for an older document.

    A table over all starts of all targets, one over the starts from frame 0, and one a target where there are several.
    """
    order = policy_order(document)
    policies = [document.policies[name] for name in order]
    if any(policy.target is None or policy.target.unbounded is None for policy in policies):
        return []

    def rows(groups: Sequence[GroupResult | None], starts: str) -> list[list[str]]:
        of = [getattr(group.unbounded, starts) if group else None for group in groups]
        return [
            [label, *((percent if name.endswith("_rate") else number)(getattr(numbers, name, None)) for numbers in of)]
            for name, label in UNBOUNDED.items()
        ]

    targets = [policy.target for policy in policies]
    tables = {"all starts": rows(targets, "all_starts"), "from frame 0": rows(targets, "from_frame_0")}
    if len(document.targets) > 1:
        for clip in document.targets:
            tables[f"{clip}, all starts"] = rows([policy.clips[clip] for policy in policies], "all_starts")
    return [
        Rows(f"Targets without terminations, {what}", ["", *map(_words, order)], found)
        for what, found in tables.items()
    ]


def unbounded_in_brief(document: EvaluationDocument) -> list[Rows]:
    """Three of the numbers, over all starts and from frame 0, in one table; nothing for an older document."""
    tables = unbounded_tables(document)
    if not tables:
        return []
    every, first = tables[:2]
    labels = [UNBOUNDED[name] for name in ("upright_rate", "impact_rate", "motion_content")]
    rows = [row for row in every.rows if row[0] in labels]
    rows += [[f"{row[0]}, from frame 0", *row[1:]] for row in first.rows if row[0] in labels]
    return [Rows("Targets without terminations", every.header, rows)]


def policy_order(document: EvaluationDocument) -> list[str]:
    """The policies of a document in the order that tables and figures show them."""
    known = [policy for policy in POLICY_ORDER if policy in document.policies]
    return known + [policy for policy in document.policies if policy not in POLICY_ORDER]


def clip_order(document: EvaluationDocument) -> list[str]:
    """The clips of a document, targets first."""
    clips = next(iter(document.policies.values())).clips
    return sorted(clips, key=lambda name: (not clips[name].target, name))


def _clip_rows(document: EvaluationDocument, *, digits: int = 3, interval: bool = True) -> Rows:
    """One row a clip, targets first: success and tracking of base and subject, the baseline, the skill retained."""
    policies, subject = document.policies, document.subject
    shown = [policy for policy in (BASE, subject) if policy and policy in policies]
    arrow = " → ".join(map(_words, shown))
    header = ["clip", "role", f"success, {arrow}", f"tracking, {arrow}"]
    header += ["baseline"] * (ZERO_ACTION in policies) + ["skill", "result"] * (len(shown) == 2)
    rows = []
    for clip in clip_order(document):
        of = {name: policy.clips[clip] for name, policy in policies.items()}
        role = "target" if of[shown[0]].target else "kept"
        success = [percent(of[policy].success_rate, interval=interval) for policy in shown]
        tracking = [number(of[policy].survival_weighted_tracking, digits, interval) for policy in shown]
        row = [clip, role, " → ".join(success), " → ".join(tracking)]
        if ZERO_ACTION in policies:
            row.append(number(of[ZERO_ACTION].survival_weighted_tracking, digits, interval))
        if len(shown) == 2:
            retained = of[shown[1]].skill if ZERO_ACTION in policies else of[shown[1]].retention
            row += [percent(retained, interval=interval), _result(retained, role)]
        rows.append(row)
    return Rows("Clip by clip", header, rows)


def _result(retained: Estimate | None, role: str) -> str:
    if retained is None or retained.mean is None:
        return "not learned"
    if role == "target":
        return "forgotten" if retained.mean <= FORGOTTEN else "still known"
    return "kept" if retained.mean >= KEPT else "weakened" if retained.mean >= KEPT_CLIP else "not kept"


def _group_rows(document: EvaluationDocument, *, digits: int = 3) -> Rows:
    """Targets and kept clips of every policy, with intervals."""
    order = policy_order(document)
    policies = [document.policies[name] for name in order]
    rows = []
    for name in ("target", "kept"):
        groups = [getattr(policy, name) for policy in policies]
        for label, metric, show in (
            ("success", "success_rate", percent),
            ("success, from frame 0", "success_rate_from_frame_0", percent),
            ("tracking", "survival_weighted_tracking", number),
            ("while alive", "tracking_reward", number),
            ("skill", "skill", percent),
            ("retention", "retention", percent),
        ):
            cells = [show(group and group.metric(metric), digits) for group in groups]
            if any(cells):
                rows.append([f"{name} {label}", *cells])
    for label, metric in (
        ("degradation ratio", "degradation_ratio"),
        ("ratio of tracking", "survival_weighted_degradation_ratio"),
    ):
        cells = [number(getattr(policy, metric), digits) for policy in policies]
        if any(cells):
            rows.append([label, *cells])
    return Rows("Targets and kept clips", ["", *map(_words, order)], rows)


def _summary(document: EvaluationDocument) -> str:
    """Success, tracking and skill of targets and kept clips, and the targets without terminations, in short."""
    table = _group_rows(document)
    shown = ("success", "tracking", "skill")
    rows = [row for row in table.rows if row[0].partition(" ")[2] in shown]
    for without_terminations in unbounded_in_brief(document):
        of_all_starts = without_terminations.rows[:3]
        rows += [[f"target: {label}", *numbers] for label, *numbers in of_all_starts]
    return markdown_table(table.header, rows)


def _code(document: EvaluationDocument) -> str:
    if document.made is None:
        return ""
    commit, changes, what = document.made.commit.partition("+")  # a commit is marked where the code was changed since
    return f" Code: commit {commit[:7]}{changes}{what}."


def _error_rows(document: EvaluationDocument) -> Rows:
    """Tracking errors and physical measures of every policy by group, over steps alive and over common steps."""
    order = policy_order(document)
    rows = []
    for name in ("target", "kept"):
        groups = [group for policy in order if (group := getattr(document.policies[policy], name))]
        for metric in sorted(["episode_length", *groups[0].errors]) if groups else []:
            plain, common = metric.removesuffix("_common"), metric.endswith("_common")
            label = f"{_words(plain)}, {UNITS.get(plain, 'm')}{', common steps' if common else ''}"
            rows.append([f"{name}: {label}", *(number(group.metric(metric)) for group in groups)])
    return Rows("Errors", ["", *map(_words, order)], rows)


def _conditions(document: EvaluationDocument) -> list[str]:
    noise = "randomisation, pushes and sensor noise as in training" if document.noise else "no noise but the resets'"
    return [
        f"- {_budget(document)}",
        f"- Checkpoint `{document.checkpoint}`, settings `{document.config_hash}`, library `{document.library_hash}`.",
        f"- Deterministic actions, no wrench, {noise}; every policy meets the same start frames and resets.",
        "- In square brackets: the 95 % interval, by bootstrap over episodes stratified by clip; exact "
        "(Clopper-Pearson) for success. It covers this checkpoint's episodes, not other training seeds.",
    ]


def _budget(document: EvaluationDocument) -> str:
    costs = [
        f"{_words(policy)} {', '.join(f'{amount:,} {_words(unit)}' for unit, amount in sorted(cost.items()))}"
        for policy, cost in sorted(document.budget.items())
    ]
    trained = f" Trained for: {'; '.join(costs)}." if costs else ""
    return f"Seed {document.seed}, {document.episodes} episodes a clip.{trained}"


def notes(document: EvaluationDocument) -> list[str]:
    """What a reader of the tables must know."""
    nothing = percent(Estimate(statistics.rate(0, document.episodes)["high"]))
    lines = [
        "tracking: mean tracking reward over the horizon, 0 after a fall (survival-weighted); "
        "while alive: the paper's, over the steps before it.",
        f"0 successes of {document.episodes} still allow a rate of up to {nothing} (95 % interval).",
    ]
    if ZERO_ACTION in document.policies:
        lines.append(
            f"baseline: tracking with zero actions; the joint controllers {document.zero_action} without a policy."
        )
    if document.targets:
        lines.append("degradation ratio: target over kept, of tracking while alive (the paper's) and of tracking.")
    if document.subject and BASE in document.policies:
        above = " above the baseline" if ZERO_ACTION in document.policies else ""
        lines.append(f"skill: share of the base's tracking{above} that is retained.")
        lines.append(
            f"result: forgotten at a skill of at most {share(FORGOTTEN)}, kept at one of at least "
            f"{share(KEPT)}, not learned where the base itself is hardly better than the baseline."
        )
    if unbounded_in_brief(document):
        lines.append(
            f"targets without terminations: each target is played to its end and {HOLD_SECONDS:g} s longer with its "
            "last frame held, whatever the robot does. Its bodies collide with each other, even where training leaves "
            "that out."
        )
        lines.append("upright: no fall until then. motion content: 1 is the whole clip, 0 what a standing robot shows.")
    for name, policy in document.policies.items():
        bounds = sorted(policy.ended_by.items(), key=lambda pair: -pair[1])
        counts = ", ".join(f"{_words(bound)} {count}" for bound, count in bounds if count)
        if counts:
            lines.append(f"episodes of {_words(name)} that a bound ended: {counts}.")
    resets = {name: policy.nan_resets for name, policy in document.policies.items() if policy.nan_resets}
    if resets:
        counts = ", ".join(f"{_words(name)} {count}" for name, count in resets.items())
        lines.append(f"episodes ended by a NaN: {counts}.")
    return lines


def _words(name: str) -> str:
    return name.replace("_", " ")


def number(value: Estimate | Mapping[str, Any] | None, digits: int = 3, interval: bool = True) -> str:
    """An estimate, or the plain dict of one in a study's JSON, as "mean [low, high]"; empty where there is none."""
    return _cell(value, interval, digits, scale=1.0, unit="")


def percent(value: Estimate | Mapping[str, Any] | None, digits: int = 0, interval: bool = True) -> str:
    """The same in whole per cent."""
    return _cell(value, interval, 0, scale=100.0, unit=" %")


def share(value: float) -> str:
    """A plain number in whole per cent, as `percent` writes it."""
    return percent({"mean": value})


def _cell(value: Estimate | Mapping[str, Any] | None, interval: bool, digits: int, *, scale: float, unit: str) -> str:
    estimate = msgspec.convert(value, Estimate | None)
    if estimate is None or estimate.mean is None:
        return ""
    text = f"{scale * estimate.mean:z,.{digits}f}{unit}"
    if interval and estimate.low is not None and estimate.high is not None:
        text += f" [{scale * estimate.low:z,.{digits}f}, {scale * estimate.high:z,.{digits}f}]"
    return text


def _markdown(table: Rows) -> str:
    return f"**{table.title}**\n\n{markdown_table(table.header, table.rows)}"


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table in Markdown, with the line end after its last row."""
    return "\n".join([*map(_line, [header, ["---"] * len(header), *rows]), ""])


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cell.replace('|', '&#124;') for cell in cells)} |"


def _rich(table: Rows) -> Table:
    view = Table(title=table.title, title_justify="left", box=box.SIMPLE_HEAD, collapse_padding=True, pad_edge=False)
    for column, name in enumerate(table.header):
        view.add_column(name, no_wrap=column == 0)
    for row in table.rows:
        view.add_row(*row[:-1], Text(row[-1], style=COLOURS.get(row[-1], "")))
    return view


def main() -> None:
    """Fill the evaluation blocks of the Markdown files named on the command line."""
    for name in sys.argv[1:]:
        path = Path(name)
        write_atomically(path, fill(path.read_text(), path.parent).encode())


if __name__ == "__main__":
    run_command(main)
