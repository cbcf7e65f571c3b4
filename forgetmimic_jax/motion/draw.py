"""Pictures of clips: a strip of frames a clip, every shape a thick line in parallel projection. Needs no renderer."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np
from PIL import Image, ImageDraw

from forgetmimic_jax.motion.clip import Clip
from forgetmimic_jax.motion.kinematics import configuration
from forgetmimic_jax.robot.model import Robot, relative_height

WIDTH, HEIGHT, CAPTION = 132, 160, 16  # pixels of one frame, and of the line above a strip
PIXELS_PER_M = 88.0  # for a robot of the G1's height
SMOOTH = 3  # drawn this much larger, then shrunk
FLOOR_LINE = HEIGHT - 30  # pixel row of the floor below the root
AZIMUTH, ELEVATION = np.radians(60.0), np.radians(10.0)  # of the viewer, from the robot's starting x axis
COLOURS = {"left": (60, 110, 215), "right": (225, 120, 45), "": (120, 120, 126)}
PAPER, SHADOW = (255, 255, 255), (222, 222, 222)


def draw(robot: Robot, clips: Sequence[Clip], spans: Sequence[int], path: Path, frames: int = 12) -> None:
    """Write a PNG with one strip a clip; the robot's left is blue, its right orange.

    Args:
        robot: whose clips they are.
        clips: one a strip.
        spans: frames of each clip to show: one cycle, or all.
        path: the PNG.
        frames: pictures a strip, evenly spread over the span.
    """
    sheet = Image.new("RGB", (WIDTH * frames, (HEIGHT + CAPTION) * len(clips)), PAPER)
    pen = ImageDraw.Draw(sheet)
    for row, (clip, span) in enumerate(zip(clips, spans, strict=True)):
        shown = np.linspace(0, min(span, clip.num_frames) - 1, frames).round().astype(int)
        top = row * (HEIGHT + CAPTION)
        pen.text(
            (4, top + 2), f"{clip.name}: {clip.seconds:.2f} s, shown to {shown[-1] / clip.fps:.2f} s", fill=(0, 0, 0)
        )
        for column, qpos in enumerate(configuration(clip, robot)[shown]):
            sheet.paste(picture(robot, qpos), (column * WIDTH, top + CAPTION))
    sheet.save(path)


def picture(robot: Robot, qpos: np.ndarray) -> Image.Image:
    """One configuration [nq], centred on its root, shadow below."""
    model, data = robot.model, mujoco.MjData(robot.model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    image = Image.new("RGB", (WIDTH * SMOOTH, HEIGHT * SMOOTH), PAPER)
    pen = ImageDraw.Draw(image)
    shapes = []
    for geom in np.flatnonzero(model.geom_bodyid):
        half = model.geom_size[geom, 1] if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_CAPSULE else 0.0
        axis = data.geom_xmat[geom].reshape(3, 3)[:, 2] * half
        ends = np.stack([data.geom_xpos[geom] - axis, data.geom_xpos[geom] + axis])
        colour = COLOURS[robot.body_sides[model.geom_bodyid[geom]]]
        if geom in robot.foot_geom_ids:  # joined to the ankle, so that the foot is seen
            ends = np.stack([data.xpos[model.geom_bodyid[geom]], data.geom_xpos[geom]])
        shapes.append((ends, model.geom_size[geom, 0], colour))
    scale = PIXELS_PER_M / relative_height(model)
    for ends, radius, _ in shapes:
        _line(pen, ends * [1.0, 1.0, 0.0], qpos, radius, SHADOW, scale)
    towards = np.array([np.cos(AZIMUTH) * np.cos(ELEVATION), np.sin(AZIMUTH) * np.cos(ELEVATION), np.sin(ELEVATION)])
    for ends, radius, colour in sorted(shapes, key=lambda shape: float(np.mean(shape[0] @ towards))):
        _line(pen, ends, qpos, radius, colour, scale)
    return image.resize((WIDTH, HEIGHT), Image.Resampling.LANCZOS)


def _line(
    pen: ImageDraw.ImageDraw,
    ends: np.ndarray,
    qpos: np.ndarray,
    radius: float,
    colour: tuple[int, int, int],
    scale: float,
) -> None:
    """A thick line with round ends between two world positions [2, 3] m, at `scale` pixels a m."""
    relative = ends - [qpos[0], qpos[1], 0.0]
    across = relative @ [-np.sin(AZIMUTH), np.cos(AZIMUTH), 0.0]
    away = relative @ [-np.cos(AZIMUTH), -np.sin(AZIMUTH), 0.0]
    up = relative[:, 2] * np.cos(ELEVATION) + away * np.sin(ELEVATION)
    pixels = np.stack([WIDTH / 2 + scale * across, FLOOR_LINE - scale * up], axis=-1) * SMOOTH
    thickness = radius * scale * SMOOTH
    pen.line([tuple(pixels[0]), tuple(pixels[1])], fill=colour, width=max(1, round(2 * thickness)))
    for x, y in pixels:
        pen.ellipse([x - thickness, y - thickness, x + thickness, y + thickness], fill=colour)
