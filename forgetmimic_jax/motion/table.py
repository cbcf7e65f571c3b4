"""The measures of clips as a table for the terminal, and what is outside its bounds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from forgetmimic_jax.motion.quality import Quality


class Column(NamedTuple):
    """How a field of Quality is printed."""

    title: str
    unit: str
    form: str
    scale: float = 1.0


COLUMNS = {
    "seconds": Column("length", "s", "{:.2f}"),
    "root_speed": Column("root", "m/s", "{:.2f}"),
    "sole_lowest": Column("sole min", "cm", "{:.1f}", 100.0),
    "stance_height": Column("stance", "cm", "{:.1f}", 100.0),
    "skate": Column("skate", "m/s", "{:.2f}"),
    "other_lowest": Column("body min", "cm", "{:.1f}", 100.0),
    "joint_speed": Column("speed", "%", "{:.0f}", 100.0),
    "limit_excess": Column("limits", "rad", "{:.2f}"),
    "joint_acceleration": Column("accel.", "rad/s2", "{:.0f}"),
    "jitter": Column("jitter", "%", "{:.2f}", 100.0),
    "seam": Column("seam", "x", "{:.2f}"),
    "flight_acceleration": Column("flight", "m/s2", "{:.1f}"),
    "missing_acceleration": Column("missing", "m/s2", "{:.1f}"),
    "motor_load": Column("torque", "%", "{:.0f}", 100.0),
}


def quality_table(measures: Sequence[Quality], entries: Mapping[str, Any]) -> str:
    """One line a clip, then what is no motion of the robot, and what is rougher than the shipped clips, one a line.

    A retargeted clip's mean angle to the human's limbs, from its entry of the manifest, is the last column.
    """
    width = max(len(quality.name) for quality in measures)
    human = {quality.name: entries.get(quality.name, {}).get("direction_error_deg", "-") for quality in measures}
    shown = any(angle != "-" for angle in human.values())
    rows = [
        ("clip", [column.title for column in COLUMNS.values()], "human"),
        ("", [column.unit for column in COLUMNS.values()], "deg"),
        *((quality.name, _cells(quality), human[quality.name]) for quality in measures),
    ]
    lines = [
        f"{name:<{width}}" + "".join(f"{cell:>9}" for cell in cells) + (f"{angle:>7}" if shown else "")
        for name, cells, angle in rows
    ]
    lines += [f"fault: {quality.name}: {fault}" for quality in measures for fault in quality.faults()]
    rough = [f"note: {quality.name}: {failure}" for quality in measures for failure in quality.failures()]
    if rough:
        lines += ["", "Rougher than the shipped clips, which may be no harm:", *rough]
    return "\n".join(lines)


def _cells(quality: Quality) -> list[str]:
    values = [(getattr(quality, field), column) for field, column in COLUMNS.items()]
    return ["-" if value is None else column.form.format(value * column.scale) for value, column in values]
