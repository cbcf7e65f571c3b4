"""Pictures of a robot on a floor, drawn without a screen by MuJoCo's renderer on EGL or OSMesa."""

from __future__ import annotations

import functools
import importlib
import os
import platform
import subprocess
import sys
from types import TracebackType

import mujoco
import numpy as np

from forgetmimic_jax.basics.drawing import chosen_library
from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.robot.model import VISUAL_GROUP, read_spec, relative_height

# Distances are for a robot of the G1's height; for another those of this file scale.
GHOST_ALPHA = 0.2
GHOST_FADE = 0.8  # m from the robot, from where the ghost pales; at twice that it is gone, lest it hide the robot
GHOST_TINT = np.array([0.25, 0.65, 0.45])  # what the reference's colours are mixed with, half and half
CAMERA_DISTANCE = 2.9  # m
CAMERA_ELEVATION = -14.0  # degrees
CAMERA_HEIGHT = 0.62  # m above the floor, of the point looked at
LIGHT_FROM = np.array([1.2, -1.6, 3.2])  # m, from the point looked at; it travels along, for the shadow to be there
SAMPLES, SHADOW_SIZE, SLICES = 4, 1024, 20  # what a picture costs on a CPU is mostly these


def drawing_model(robot: str, width: int, height: int) -> mujoco.MjModel:
    """A robot's shapes to be seen, with floor, sky and light, for pictures of that many pixels.

    A robot without such shapes is drawn by the shapes it collides with.
    """
    spec = read_spec(robot)
    if not any(geom.group == VISUAL_GROUP for geom in spec.geoms):
        for geom in spec.geoms:
            geom.group = 0 if geom.name == "floor" else VISUAL_GROUP
    _add_floor_and_sky(spec)
    spec.worldbody.add_light(
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        dir=-LIGHT_FROM / np.linalg.norm(LIGHT_FROM),
        diffuse=[0.55, 0.55, 0.55],
        specular=[0.15, 0.15, 0.15],
        castshadow=True,
    )
    visual = spec.visual
    visual.headlight.ambient = [0.42, 0.42, 0.44]
    visual.headlight.diffuse = [0.28, 0.28, 0.28]
    visual.headlight.specular = [0.1, 0.1, 0.1]
    visual.quality.offsamples, visual.quality.shadowsize = SAMPLES, SHADOW_SIZE
    visual.quality.numslices, visual.quality.numstacks = SLICES, SLICES // 2
    visual.global_.offwidth, visual.global_.offheight = width, height
    visual.map.shadowclip = 1.3
    spec.stat.extent = 2.0
    return spec.compile()


class Renderer:
    """Draws one robot and its reference; a context manager, used on one thread."""

    def __init__(self, robot: str, width: int, height: int):
        self._model = drawing_model(robot, width, height)
        self._data = mujoco.MjData(self._model)
        self._size = relative_height(self._model)
        self._rect = mujoco.MjrRect(0, 0, width, height)
        self._gl = _backend().GLContext(width, height)
        self._gl.make_current()
        self._context = mujoco.MjrContext(self._model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._scene = mujoco.MjvScene(self._model, maxgeom=4 * self._model.ngeom)
        self._option = mujoco.MjvOption()
        self._option.geomgroup[:] = 0
        self._option.geomgroup[[0, VISUAL_GROUP]] = 1

    def __enter__(self) -> Renderer:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None):
        self._context.free()
        self._gl.free()

    def picture(
        self, qpos: np.ndarray, reference: np.ndarray | None, look_at: np.ndarray, azimuth: float
    ) -> np.ndarray:
        """The robot, and its reference as a translucent ghost.

        Args:
            qpos: [nq] of the robot.
            reference: [nq] of the ghost, which pales as it gets away from the robot; None: no ghost.
            look_at: [2] m, the point of the floor that the camera looks over.
            azimuth: of the camera's gaze, degrees.

        Returns:
            [height, width, 3] u8.
        """
        camera = mujoco.MjvCamera()
        camera.lookat[:] = [*look_at, CAMERA_HEIGHT * self._size]
        camera.distance, camera.azimuth, camera.elevation = CAMERA_DISTANCE * self._size, azimuth, CAMERA_ELEVATION
        everything, moving = mujoco.mjtCatBit.mjCAT_ALL, mujoco.mjtCatBit.mjCAT_DYNAMIC
        shadowless = mujoco.mjtCatBit.mjCAT_DECOR
        scene, perturbation = self._scene, mujoco.MjvPerturb()
        self._pose(qpos)
        mujoco.mjv_updateScene(self._model, self._data, self._option, perturbation, camera, everything, scene)
        for geom in scene.geoms[: scene.ngeom]:
            if geom.type == mujoco.mjtGeom.mjGEOM_PLANE:
                geom.category = shadowless  # a floor shadows itself, in specks
        if reference is not None:
            solid = scene.ngeom
            apart = float(np.linalg.norm(reference[:2] - qpos[:2]))
            alpha = GHOST_ALPHA * float(np.clip(2.0 - apart / (GHOST_FADE * self._size), 0.0, 1.0))
            self._pose(reference)
            mujoco.mjv_addGeoms(self._model, self._data, self._option, perturbation, moving, scene)
            for geom in scene.geoms[solid : scene.ngeom]:
                geom.category = shadowless
                geom.rgba[:3] = 0.5 * (geom.rgba[:3] + GHOST_TINT)
                geom.rgba[3] = alpha
        for light in scene.lights[: scene.nlight]:
            if not light.headlight:
                light.pos[:] = camera.lookat + LIGHT_FROM * self._size
        pixels = np.empty((self._rect.height, self._rect.width, 3), np.uint8)
        self._gl.make_current()
        mujoco.mjr_render(self._rect, scene, self._context)
        mujoco.mjr_readPixels(pixels, None, self._rect, self._context)
        return pixels[::-1]

    def _pose(self, qpos: np.ndarray) -> None:
        self._data.qpos[:] = qpos
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)


def check_rendering() -> None:
    """InputError unless pictures can be drawn here."""
    _backend()


def _add_floor_and_sky(spec: mujoco.MjSpec) -> None:
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.97, 0.98, 0.99],
        rgb2=[0.78, 0.84, 0.9],
        width=64,
        height=6 * 64,
    )
    spec.add_texture(
        name="tiles",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=[0.84, 0.86, 0.88],
        rgb2=[0.76, 0.79, 0.83],
        width=128,
        height=128,
    )
    material = spec.add_material(name="tiles", texrepeat=[1, 1], texuniform=True, specular=0.0)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "tiles"
    floor = spec.geom("floor")
    floor.material, floor.rgba = "tiles", [0.5, 0.5, 0.5, 1.0]  # this grey is MuJoCo's sign for the material's colour


@functools.cache
def _backend():
    """The module of MuJoCo's that makes a context without a screen.

    PyOpenGL can be set to one platform a process, so each is tried in a process of its own.
    """
    if platform.system() == "Darwin":
        return importlib.import_module("mujoco.cgl")
    wanted = chosen_library()
    names = [wanted] if wanted in ("egl", "osmesa") else ["egl", "osmesa"]
    for name in names:
        trial = f"from mujoco.{name} import GLContext; GLContext(16, 16).make_current()"
        environment = {key: value for key, value in os.environ.items() if key not in ("MUJOCO_GL", "PYOPENGL_PLATFORM")}
        if subprocess.run([sys.executable, "-c", trial], env=environment, capture_output=True).returncode == 0:
            os.environ["PYOPENGL_PLATFORM"] = name
            return importlib.import_module(f"mujoco.{name}")
    raise InputError(
        f"rendering: {' and '.join(names)} cannot draw here without a screen; install a library for it, such as "
        "Debian's libegl1 with libgl1-mesa-dri, or libosmesa6"
    )
