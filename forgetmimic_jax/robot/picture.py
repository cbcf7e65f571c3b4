"""A picture of a robot's roles: its bodies from the front and from the side, in its default pose."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from PIL import Image, ImageDraw

from forgetmimic_jax.robot.sides import Pairs, body_ids, sides_of_bodies
from forgetmimic_jax.robot.tree import at_rest

WIDTH, HEIGHT, MARGIN = 620, 760, 60  # pixels of a view
VIEWS = (("front", 1), ("side", 0))  # the axis across, which points to the viewer's right
LEFT, RIGHT, CENTRE, INK = (60, 110, 215), (225, 120, 45), (110, 110, 116), (30, 30, 34)


def draw_roles(model: mujoco.MjModel, roles: Mapping[str, Any], path: Path) -> None:
    """Write a PNG: every body a line from its parent's origin, its left side blue, its right orange, roles by name."""
    data = at_rest(model, roles.get("default_pose", {}))
    labels = _labels(model, roles)
    colours = _colours(model, roles)
    sheet = Image.new("RGB", (WIDTH * len(VIEWS), HEIGHT), (255, 255, 255))
    pen = ImageDraw.Draw(sheet)
    scale = (HEIGHT - 2 * MARGIN) / max(float(np.ptp(data.xpos[1:, 2])), 0.1)
    top = float(data.xpos[1:, 2].max())
    for number, (view, axis) in enumerate(VIEWS):
        middle = WIDTH * (number + 0.5)
        places = [(middle + scale * float(pos[axis]), MARGIN + scale * (top - float(pos[2]))) for pos in data.xpos]
        pen.text((WIDTH * number + 12, 10), f"{roles['model']}, from the {view}", fill=INK)
        for body in range(1, model.nbody):
            colour, parent = colours.get(body, CENTRE), int(model.body_parentid[body])
            if parent:
                pen.line([places[parent], places[body]], fill=colour, width=6)
            x, y = places[body]
            pen.ellipse([x - 5, y - 5, x + 5, y + 5], fill=colour)
        rows: list[float] = []
        for body, text in sorted(labels.items(), key=lambda item: places[item[0]][1]):
            x, y = places[body]
            y = max([y, *(row + 13 for row in rows[-1:])])
            rows.append(y)
            pen.text((WIDTH * number + 12, y - 6), text, fill=colours.get(body, INK))
            pen.line([(WIDTH * number + 200, y), places[body]], fill=(205, 205, 210), width=1)
    sheet.save(path)


def _labels(model: mujoco.MjModel, roles: Mapping[str, Any]) -> dict[int, str]:
    """The roles of each body, in words."""
    said: dict[str, list[str]] = {}
    for role, pair in roles.get("pairs", {}).items():
        for side, body in zip(("left", "right"), pair, strict=True):
            said.setdefault(body, []).append(f"{side} {role}")
    if "anchor" in roles:
        said.setdefault(roles["anchor"], []).append("anchor")
    return {model.body(body).id: ", ".join(words) for body, words in said.items()}


def _colours(model: mujoco.MjModel, roles: Mapping[str, Any]) -> dict[int, tuple[int, int, int]]:
    """The colour of each body that is of a side."""
    if "pairs" not in roles:
        return {}
    sides = sides_of_bodies(model, body_ids(model, Pairs(**roles["pairs"])))
    return {body: LEFT if side == "left" else RIGHT for body, side in enumerate(sides) if side}
