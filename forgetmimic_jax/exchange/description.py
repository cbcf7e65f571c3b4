"""What a policy of another project sees and does, in this project's terms: its layout, its action, its robot.

The facts come from `exchange.sources`. A layout is recognised by the names of its terms, never by its size.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.exchange.sources import Facts
from forgetmimic_jax.robot.model import Robot
from forgetmimic_jax.settings.config import ActionConfig
from forgetmimic_jax.tracking.layouts import LAYOUTS, Layout

Mode = Literal["residual", "offset"]
ASSUMED = "assumed: "
# The tables of `ActionConfig`, and the facts that they are.
TABLES = {
    "default_pose": "default_joint_pos",
    "scale": "action_scale",
    "stiffness": "joint_stiffness",
    "damping": "joint_damping",
}
ROUNDING = 2e-3  # projects write three digits, some of them two


class Row(NamedTuple):
    """A line of the table that an import prints."""

    what: str
    value: str
    source: str  # the file and its key, or what was assumed since which key is missing

    @property
    def assumed(self) -> str | None:
        """Why the value was assumed; None if it was read."""
        return self.source.partition(ASSUMED)[2].partition(";")[0] or None


class Fact(NamedTuple):
    """A fact and the source that says it."""

    value: Any
    source: str


@dataclass(frozen=True)
class Description:
    """How a policy's observation and action follow from ours."""

    layout: Layout
    action: ActionConfig
    body_names: tuple[str, ...]  # of the clip inside the file; empty if it does not say
    factor: np.ndarray  # f[features], and
    shift: np.ndarray  # f[features]: the policy sees factor · (our observation + shift)
    rows: tuple[Row, ...]

    def seen(self, observation: np.ndarray) -> np.ndarray:
        """What the policy sees [..., features] where our observation is [..., features]."""
        return self.factor * (observation + self.shift)


def agreed(sources: Sequence[tuple[str, Facts]], policy: Path) -> dict[str, Fact]:
    """The facts of all sources; of numbers that agree, those of the last source.

    Raises:
        InputError: two sources say different things; both are named.
    """
    facts: dict[str, Fact] = {}
    for source, found in sources:
        for key, value in found.items():
            before = facts.get(key)
            if before is not None and (difference := _difference(before.value, value)):
                where, one, other = difference
                raise InputError(f"{policy}: {key}{where}: {before.source} says {one}, {source} says {other}; which "
                                 f"one is right?")  # fmt: skip
            facts[key] = Fact(value, source)
    return facts


def _difference(one: Any, other: Any) -> tuple[str, Any, Any] | None:
    """Where two values of a fact differ, and the two."""
    if isinstance(one, Mapping):
        for name in one:
            if name in other and (found := _difference(one[name], other[name])) is not None:
                return f": {name}{found[0]}", found[1], found[2]
        return None
    if isinstance(one, list | tuple):
        if len(one) != len(other):
            return (
                "",
                f"{len(one)} ({', '.join(map(str, one[:3]))} …)",
                f"{len(other)} ({', '.join(map(str, other[:3]))} …)",
            )
        for place, pair in enumerate(zip(one, other, strict=True)):
            if (found := _difference(*pair)) is not None:
                return f" at place {place}{found[0]}", found[1], found[2]
        return None
    if isinstance(one, float):
        return None if abs(one - other) <= ROUNDING * (1.0 + abs(other)) else ("", f"{one:.4g}", f"{other:.4g}")
    return None if one == other else ("", one, other)


def describe(facts: Mapping[str, Fact], robot: Robot, step_dt: float, policy: Path) -> Description:
    """The description that facts amount to; what no source says is the robot's own, and the rows say so.

    Args:
        facts: of all sources.
        robot: of this project, without a policy's tables.
        step_dt: s between two actions here.
        policy: the file, for messages.

    Raises:
        InputError: no or another layout, an action or a control step that is not supported.
    """
    layout = _layout(facts, robot, policy)
    mode = _mode(facts, layout)
    said = _value(facts, "step_dt")
    if said is not None and abs(said - step_dt) > 1e-6:
        raise InputError(f"{policy}: step_dt: {facts['step_dt'].source} says {said:g} s; accepted: {step_dt:g} s")
    order = _value(facts, "joint_names") or robot.joint_names
    tables = _tables(facts, mode)
    given = {name: dict(table) for name, table in tables.items() if table}
    action = ActionConfig(mode, () if order == robot.joint_names else tuple(order), **given)
    factor, shift = _linear(facts, layout, order, tables["default_pose"], policy)
    rows = (
        *_layout_rows(facts, layout, robot),
        _mode_row(facts, layout, mode),
        _row("control step", f"{step_dt:g} s", facts, "step_dt", "the setting physics"),
        _order_row(facts, order, robot),
        *_table_rows(facts, tables, mode, robot),
        *_scale_rows(facts, factor),
    )
    return Description(layout, action, _value(facts, "body_names") or (), factor, shift, rows)


def _value(facts: Mapping[str, Fact], key: str) -> Any:
    """What the sources say; None where none does."""
    return facts[key].value if key in facts else None


def _row(what: str, value: str, facts: Mapping[str, Fact], key: str, assumed: str) -> Row:
    if key in facts:
        return Row(what, value, f"{key}, {facts[key].source}")
    return Row(what, value, f"{ASSUMED}no {key}; {assumed}")


def _layout(facts: Mapping[str, Fact], robot: Robot, policy: Path) -> Layout:
    """The layout whose terms the policy sees, of the body that they are of."""
    if "observation_names" not in facts:
        raise InputError(
            f"{policy}: missing observation_names: no metadata and no deploy.yaml or config.yaml of wbc-g1-deploy "
            f"beside it say what the policy sees; give --layout, one of {', '.join(LAYOUTS)}"
        )
    names, source = facts["observation_names"]
    body = _value(facts, "anchor_body_name")
    layout = next((layout for layout in LAYOUTS.values() if tuple(layout.sensor_noise) == names), None)
    if layout is None:
        raise InputError(f"{policy}: observation_names: {source} says {', '.join(names)}; {_needed(names)}")
    if layout.name == "wbc132" and body == robot.key_bodies[robot.root]:
        layout = LAYOUTS["root132"]  # the same terms, of the floating base
    expected = _body(layout, robot)
    if body not in (None, expected):
        raise InputError(f"{policy}: anchor_body_name: {facts['anchor_body_name'].source} says {body}; {expected} is "
                         f"needed with layout {layout.name} of {robot.name}")  # fmt: skip
    return layout


def _body(layout: Layout, robot: Robot) -> str:
    """Name of the body that a layout's terms are of."""
    return robot.key_bodies[{"anchor": robot.anchor, "root": robot.root}[layout.body]]


def _layout_rows(facts: Mapping[str, Fact], layout: Layout, robot: Robot) -> list[Row]:
    return [
        Row("layout", layout.name, f"observation_names, {facts['observation_names'].source}"),
        _row("anchor body", _body(layout, robot), facts, "anchor_body_name", f"{robot.name}'s"),
    ]


def _needed(names: Sequence[str]) -> str:
    """What is accepted in place of these terms: the layout that has most of them, or all layouts."""
    layout = max(LAYOUTS.values(), key=lambda layout: -len(set(layout.sensor_noise) ^ set(names)))
    terms = list(layout.sensor_noise)
    if sorted(terms) == sorted(names):
        return f"these are the terms of {layout.name} in another order; accepted: {', '.join(terms)}"
    unknown, missing = [n for n in names if n not in terms], [n for n in terms if n not in names]
    return (
        f"accepted: the terms of {', '.join(LAYOUTS)}; nearest is {layout.name} (missing: "
        f"{', '.join(missing) or 'none'}; unknown: {', '.join(unknown) or 'none'})"
    )


def _mode(facts: Mapping[str, Fact], layout: Layout) -> Mode:
    """Added to the reference or to the default pose; mjlab and BeyondMimic know only the second."""
    return _value(facts, "action_mode") or ("offset" if layout.name.startswith("mjlab") else "residual")


def _mode_row(facts: Mapping[str, Fact], layout: Layout, mode: Mode) -> Row:
    origin = {"residual": "reference joints", "offset": "default pose"}[mode]
    text = f"{mode}: target = {origin} + scale · action"
    return _row("action", text, facts, "action_mode", f"as projects of layout {layout.name} have it")


def _order_row(facts: Mapping[str, Fact], order: Sequence[str], robot: Robot) -> Row:
    text = "the robot's" if order == robot.joint_names else f"another: {', '.join(order[:3])} …"
    return _row("joint order", text, facts, "joint_names", "the robot's order")


def _tables(facts: Mapping[str, Fact], mode: Mode) -> dict[str, Mapping[str, float] | None]:
    """The tables of `ActionConfig`; None where no source has one.

    What the action is added to is our default pose; the joint angles that the policy sees are less its own.
    """
    tables = {name: _value(facts, key) for name, key in TABLES.items()}
    return tables | {"default_pose": _offset(facts, mode) or tables["default_pose"]}


def _offset(facts: Mapping[str, Fact], mode: Mode) -> Mapping[str, float] | None:
    """What actions are added to, where a source says it apart from the default pose."""
    return _value(facts, "action_offset") if mode == "offset" else None


def _table_rows(
    facts: Mapping[str, Fact], tables: Mapping[str, Mapping[str, float] | None], mode: Mode, robot: Robot
) -> list[Row]:
    rows = []
    for name, key in TABLES.items():
        own = "the robot's own" if tables[name] is None else "the action's offset"
        rows.append(_row(name.replace("_", " "), _compared(tables[name], robot, name), facts, key, own))
    rows.append(Row("armature", "the robot's own", f"{ASSUMED}no project's files say it"))
    if offset := _offset(facts, mode):
        rows.append(Row("action offset", _compared(offset, robot, "default_pose"), facts["action_offset"].source))
    return rows


def _scale_rows(facts: Mapping[str, Fact], factor: np.ndarray) -> list[Row]:
    if (factor == 1.0).all():
        return []
    return [Row("observation scale", "taken into the first layer", facts["observation_scale"].source)]


def _compared(table: Mapping[str, float] | None, robot: Robot, name: str) -> str:
    """A table of joints beside the robot's own."""
    if table is None:
        return "the robot's own"
    own = {"default_pose": "default_joint_pos", "scale": "action_scale"}.get(name, name)
    values = dict(zip(robot.joint_names, np.asarray(getattr(robot.arrays, own)), strict=True))
    joint = max(table, key=lambda joint: abs(table[joint] - values[joint]) / (1.0 + abs(values[joint])))
    if abs(table[joint] - values[joint]) <= ROUNDING * (1.0 + abs(values[joint])):
        return "as the robot's own"
    return f"another, most at {joint}: {table[joint]:.4g} for {values[joint]:.4g}"


def _linear(
    facts: Mapping[str, Fact],
    layout: Layout,
    order: Sequence[str],
    origin: Mapping[str, float] | None,
    policy: Path,
) -> tuple[np.ndarray, np.ndarray]:
    """Factor and shift of every number of the observation."""
    places, size = layout.places(len(order)), layout.size(len(order))
    factor, shift = np.ones(size), np.zeros(size)
    pose = _value(facts, "default_joint_pos")
    if pose and origin:
        shift[places["joint_pos"]] = [origin[joint] - pose[joint] for joint in order]
    scales = facts.get("observation_scale", Fact({}, ""))
    ours = dict(zip(facts["observation_names"].value, layout.sensor_noise, strict=True))  # root132 has other names
    for name, values in scales.value.items():
        place = places[ours[name]]
        count = place.stop - place.start
        if len(values) not in (1, count) or not all(values):
            raise InputError(f"{policy}: observation_scale: {name}: {scales.source} has {len(values)} numbers; {count} "
                             f"that are not 0 are needed")  # fmt: skip
        factor[place] = values
    return factor, shift
