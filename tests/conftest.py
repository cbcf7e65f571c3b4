"""What the tests share: the G1, and two short invented clips, so that no test depends on the shipped data."""

import dataclasses
import os
from pathlib import Path

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from forgetmimic_jax.motion.clip import Clip, write_clip
from forgetmimic_jax.motion.library import MotionLibrary, build_library, file_hash, write_manifest
from forgetmimic_jax.robot.model import Robot, load_robot
from forgetmimic_jax.settings.config import Config, preset
from forgetmimic_jax.tracking.setup import Setup

# Compiling is most of what the tests wait for; this makes it three times as fast. JAX reads it when it first starts.
QUICK_COMPILATION = "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false"
os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {QUICK_COMPILATION}".strip()

# What one test compiled, another one takes from the cache, also in a process that a test starts.
os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.1"
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)

# As under `make test`, also without make: what a command says to do next is then a target of make.
os.environ["MAKELEVEL"] = "1"

SWAY_FRAMES, TURN_FRAMES = 80, 41
SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"  # real files of other projects, not committed


def invented_clip(robot: Robot, name: str, frames: int, yaw_rate: float, speed: float) -> Clip:
    """The default pose with every joint waving by 0.05 rad, the root walking forwards, turning and nodding."""
    time = np.arange(frames) / 50.0
    default = np.asarray(robot.arrays.default_joint_pos)
    phase = np.arange(robot.num_joints)
    joints = default + 0.05 * np.sin(2.0 * np.pi * time[:, None] + phase)
    yaw, nod = yaw_rate * time, 0.1 * np.sin(2.0 * np.pi * time)
    heading = np.cumsum(np.stack([np.cos(yaw), np.sin(yaw)], axis=-1), axis=0) * speed / 50.0
    height = robot.default_height + 0.01 * np.sin(4.0 * np.pi * time)
    turns = Rotation.from_euler("ZYX", np.stack([yaw, nod, np.zeros(frames)], axis=-1))
    return Clip(
        name=name,
        fps=50.0,
        joint_names=robot.joint_names,
        root_pos=np.concatenate([heading, height[:, None]], axis=-1),
        root_quat=turns.as_quat(scalar_first=True),
        joint_pos=joints,
    )


@pytest.fixture(scope="session")
def robot() -> Robot:
    return load_robot("g1")


@pytest.fixture(scope="session")
def library(robot) -> MotionLibrary:
    """`sway`: 80 frames; `turn`: 41 frames."""
    return build_library(
        robot,
        [invented_clip(robot, "sway", SWAY_FRAMES, 0.0, 0.3), invented_clip(robot, "turn", TURN_FRAMES, 1.0, 0.2)],
    )


@pytest.fixture(scope="session")
def tiny_config() -> Config:
    """Plain PPO of the cpu preset with 8 environments, 4 steps and networks of a few units, on the C engine."""
    config = preset("cpu")
    return dataclasses.replace(
        config,
        physics=dataclasses.replace(config.physics, engine="native"),
        sampling=dataclasses.replace(config.sampling, bin_seconds=0.4),
        ppo=dataclasses.replace(
            config.ppo,
            num_envs=8,
            branches=1,
            num_steps=4,
            epochs=2,
            minibatches=2,
            schedule="fixed",
            actor_layers=(16, 16),
            critic_layers=(16,),
        ),
    )


@pytest.fixture(scope="session")
def tiny_setup(robot, library, tiny_config) -> Setup:
    """The tiny config on the two invented clips."""
    return Setup(tiny_config, robot, library, library_hash="invented")


@pytest.fixture(scope="session")
def library_folder(robot, tmp_path_factory) -> Path:
    """A library on disk: `sway`, `turn` and `nod`, of which `turn` is to be forgotten by default."""
    folder = tmp_path_factory.mktemp("library")
    entries = {}
    for name, frames, yaw_rate in (("sway", SWAY_FRAMES, 0.0), ("turn", TURN_FRAMES, 1.0), ("nod", 60, 0.0)):
        write_clip(invented_clip(robot, name, frames, yaw_rate, 0.2), folder / f"{name}.npz")
        entries[name] = {"sha256": file_hash(folder / f"{name}.npz")}
    write_manifest(folder, {"schema": 1, "robot": "g1", "fps": 50.0, "default_targets": ["turn"], "clips": entries})
    return folder


@pytest.fixture(scope="session")
def samples() -> Path:
    """Folder with G1 clips in the three formats."""
    folder = SHARED / "motions"
    if not folder.is_dir():
        pytest.skip("sample motions are not committed: no ../shared/data/motions beside this checkout")
    return folder


@pytest.fixture(scope="session")
def deepmimic() -> Path:
    """Folder with DeepMimic's human clips."""
    folder = SHARED / "deepmimic"
    if not folder.is_dir():
        pytest.skip("DeepMimic's clips are not committed: no ../shared/data/deepmimic beside this checkout")
    return folder


@pytest.fixture(scope="session")
def public_policies() -> Path:
    """Folder with public tracking policies of the G1."""
    folder = SHARED / "policies"
    if not folder.is_dir():
        pytest.skip("public policies are not committed: no ../shared/data/policies beside this checkout")
    return folder
