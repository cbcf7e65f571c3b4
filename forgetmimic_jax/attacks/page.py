"""evidence.md: what every attack found, the verdict with its reasons, and the rule."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from forgetmimic_jax.attacks.case import TRAINED
from forgetmimic_jax.attacks.document import (
    CONTROL,
    Compared,
    EvidenceDocument,
    LookAlikes,
    Membership,
    NearDuplicates,
    Numbers,
    Numerics,
    Recovery,
    Relearning,
    Splices,
)
from forgetmimic_jax.attacks.judged import Judged
from forgetmimic_jax.attacks.pace import lasted_until
from forgetmimic_jax.attacks.verdict import RULES, judge
from forgetmimic_jax.evaluation.document import UnboundedResult
from forgetmimic_jax.evaluation.metrics import UNLEARNED
from forgetmimic_jax.evaluation.relearning import LEVELS
from forgetmimic_jax.evaluation.tables import UNBOUNDED, markdown_table, number, percent

Block = tuple[str, str]  # heading and text


def page(evidence: EvidenceDocument, figure: str, command: str, fakes: Mapping[str, Judged]) -> str:
    """The page in Markdown.

    Args:
        evidence: on one policy.
        figure: file name of the figure beside the page.
        command: what makes the evidence again.
        fakes: verdicts on policies that only seem to have forgotten, if there are any.
    """
    verdict = judge(evidence)
    lines = [
        f"# Evidence: {', '.join(evidence.targets)} forgotten by {evidence.method} ({evidence.robot.upper()})",
        f"**{verdict.phrase.capitalize()}.**",
        "\n".join(f"- {reason}" for reason in verdict.reasons),
        f"![What brought it back]({figure})",
        _conditions(evidence, command),
    ]
    for heading, text in _blocks(evidence):
        lines += [f"## {heading}", text]
    if fakes:
        lines += ["## Judging the judge", _fakes(fakes)]
    lines += ["## The rule", *(f"**{phrase.capitalize()}.** {rule}" for phrase, rule in RULES.items())]
    return "\n\n".join(line.rstrip("\n") for line in lines) + "\n"


def _conditions(evidence: EvidenceDocument, command: str) -> str:
    unit = (
        f"Intervals of attacks that train are over {evidence.seeds} trainings (Student's t). All others are over "
        f"episodes."
        if evidence.seeds > 1
        else "Intervals are over episodes: they say how well these policies were measured, not what another training "
        "would give."
    )
    hashes = ", ".join(f"{name} {value}" for name, value in evidence.policy_hashes.items())
    made = evidence.made
    return "\n".join(
        [
            f"- Compared in the same episodes: the base, the unlearned policy, and a control that never rolled out a "
            f"target ({evidence.control_method}). {evidence.episodes} episodes a clip, more on the targets.",
            f"- {unit}",
            "- Skill: the share of the base's tracking above the zero-action baseline. Motion content: how much of the "
            "clip's own movement is there; 1 all, 0 what a robot that stands shows.",
            f"- Policies: {hashes}. Code {made.commit}, jax {made.jax}, mujoco {made.mujoco}, {made.processor} "
            f"({made.cores} cores).",
            f"- Made by: `{command}`",
        ]
    )


def _blocks(evidence: EvidenceDocument) -> Iterable[Block]:
    originals = evidence.originals
    yield "The targets as they are", _table("target", originals.targets)
    if evidence.near_duplicates:
        yield "Near-duplicates", _near_duplicates(evidence.near_duplicates)
    if evidence.splices:
        yield "Splices", _splices(evidence.splices)
    if evidence.look_alikes:
        yield "Look-alikes", _look_alikes(evidence.look_alikes)
    if evidence.recovery:
        yield "Fine-tuning on the kept clips alone", _recovery(evidence.recovery)
    if evidence.relearning:
        yield "Relearning", _relearning(evidence.relearning)
    if evidence.held_out:
        yield "Relearning on the first half: the second half", _recovery(evidence.held_out)
    if evidence.numerics:
        yield "Other numerics", _numerics(evidence.numerics)
    if evidence.membership:
        yield "Membership", _membership(evidence.membership)
    if evidence.safety:
        yield "Without terminations", _safety(evidence.safety)


def _table(first: str, groups: Mapping[str, Compared], policies: Sequence[str] = TRAINED) -> str:
    """Skill and motion content of every policy, and by how much the unlearned one is above the other."""
    header = [first]
    for policy in policies:
        header += [f"{policy}: skill", "content"]
    rows = []
    for name, compared in groups.items():
        row = [name]
        for policy in policies:
            numbers = compared.get(policy, Numbers())
            row += [percent(numbers.skill), number(numbers.content, 2)]
        rows.append(row)
    return markdown_table(header, rows)


def _near_duplicates(found: NearDuplicates) -> str:
    parts = [_table("family", found.families)]
    if found.worst:
        numbers = found.variants[found.worst][UNLEARNED]
        skill, content = percent(numbers.skill) or "undefined", number(numbers.content, 2) or "undefined"
        parts.append(f"The worst one is **{found.worst}**: skill {skill}, motion content {content}.")
    dropped = ", ".join(f"{name} ({share:.0%})" for name, share in found.dropped.items())
    parts.append(
        f"Dropped, since the base tracks them less than half as well as the original: {len(found.dropped)}"
        f"{f' ({dropped})' if dropped else ''}."
    )
    parts += ["Near-duplicates of the kept clips:", _table("family", found.kept), "Clip by clip:"]
    return "\n\n".join([*parts, _table("variant", found.variants)])


def _splices(found: Splices) -> str:
    groups = {"target seconds inside kept clips": found.forbidden, "kept seconds inside targets": found.kept}
    text = "Motion content of the inserted second alone, without its first 0.2 s."
    header, rows = ["splice", *TRAINED], []
    for name, compared in {**groups, **found.splices}.items():
        rows.append([name, *(number(compared[p].content, 2) if p in compared else "" for p in TRAINED)])
    return f"{text} Dropped: {len(found.dropped)}.\n\n{markdown_table(header, rows)}"


def _look_alikes(found: LookAlikes) -> str:
    rows = [
        [policy, percent(found.near[policy]), percent(found.far[policy]), percent(found.difference[policy])]
        for policy in (UNLEARNED, CONTROL)
        if policy in found.near
    ]
    text = (
        f"Share of the base's tracking that is retained on {len(found.pairs)} kept segments of a second: those nearest "
        f"to the targets by dynamic time warping of the joint angles, and as many that are far and as hard for the "
        f"base. Intervals are over segments. A negative difference: more was lost near the targets."
    )
    pairs = [
        [one.near, one.far, *(f"{far:.2f}" for far in one.distances), *(f"{of:.0%}" for of in one.retention[UNLEARNED])]
        for one in found.pairs
    ]
    header = ["near (frames)", "far (frames)", "distance, rad", "of the far one", "unlearned: near", "far"]
    table = markdown_table(["policy", "near", "far", "difference"], rows)
    return f"{text}\n\n{table}\n{markdown_table(header, pairs)}"


def _recovery(found: Recovery) -> str:
    above: list[str] = []
    rows: dict[str, Compared] = {}
    for clip, after in found.after.items():
        rows |= {f"{clip}, before": found.before[clip], f"{clip}, after {found.iterations} iterations": after}
        skill, content = after[UNLEARNED].skill_above, after[UNLEARNED].content_above
        above.append(f"{clip}: skill {percent(skill)}, motion content {number(content, 2)}")
    policies = [policy for policy in TRAINED if all(policy in after for after in found.after.values())]
    return f"{_table('', rows, policies)}\nThe unlearned policy above the control afterwards: {'; '.join(above)}."


def _relearning(found: Relearning) -> str:
    rows = []
    for level in LEVELS:
        runs = lasted_until(found, level)
        cells = [
            "; ".join(f"{'' if run.there else 'more than '}{run.target_steps:,.0f}" for run in runs[start].values())
            for start in (UNLEARNED, CONTROL)
        ]
        rows.append([f"{level:.0%}", *cells])
    text = (
        "Target steps until a share of the base's tracking on the targets, training by training. Half of the starts "
        "are on targets. A level counts when two evaluations in a row are above it."
    )
    return f"{text}\n\n{markdown_table(['share of the base', 'unlearned', 'control'], rows)}"


def _numerics(found: Numerics) -> str:
    by_clip: dict[str, Compared] = {}
    for clip, before in found.before.items():
        changes = {f"{clip}, {change}": of[clip] for change, of in found.changes.items()}
        by_clip |= {f"{clip}, as they are": before, **changes}
    success = {"as they are": found.kept_before, **found.kept}
    rows = [[name, percent(value)] for name, value in success.items()]
    table = markdown_table(["weights", "unlearned: success on the kept clips"], rows)
    return f"{_table('weights', by_clip)}\n{table}"


def _membership(found: Mapping[str, Membership]) -> str:
    rows = [
        [
            policy,
            *(f"{value:.2f}" for value in (of.auc, of.accuracy, of.tpr_at_5_percent_fpr, of.marked_at_5_percent_fpr)),
        ]
        for policy, of in found.items()
    ]
    text = (
        "Whether an attack that sees tracking, success and length separates the targets from their mirror images, on "
        "which no policy was trained. AUC 0.5 is guessing; above it the policy does the targets as trained clips; "
        "below it the policy is marked by having forgotten them. True positives and marked: the share of the targets' "
        "episodes that look more, or less, trained than 95 % of the mirror images' episodes."
    )
    header = ["policy", "AUC", "accuracy", "true positives at 5 % false positives", "marked at 5 % false positives"]
    return f"{text}\n\n{markdown_table(header, rows)}"


def _safety(found: Mapping[str, UnboundedResult]) -> str:
    tables = []
    for what, numbers in {
        "all starts": {policy: of.all_starts for policy, of in found.items()},
        "from frame 0": {policy: of.from_frame_0 for policy, of in found.items()},
    }.items():
        rows = [
            [label, *((percent if name.endswith("_rate") else number)(getattr(of, name)) for of in numbers.values())]
            for name, label in UNBOUNDED.items()
        ]
        tables.append(markdown_table([f"targets, {what}", *(policy.replace("_", " ") for policy in numbers)], rows))
    return "\n".join(tables)


def _fakes(found: Mapping[str, Judged]) -> str:
    text = (
        "The same attacks, with the same base and control, on policies that only seem to have forgotten, and on "
        "another distilled one. A fake must fail. The first reason names what caught it."
    )
    rows = [[name, of.phrase, of.reasons[0], str(len(of.reasons) - 1)] for name, of in found.items()]
    return f"{text}\n\n{markdown_table(['policy', 'verdict', 'the first reason', 'more reasons'], rows)}"
