import dataclasses

import pytest

from forgetmimic_jax.motion.clip import Clip, read_clip
from forgetmimic_jax.motion.library import build_library
from forgetmimic_jax.tracking.setup import Setup


@pytest.fixture(scope="session")
def clips(library_folder) -> dict[str, Clip]:
    """`sway`, `turn` and `nod` as clips."""
    return {name: read_clip(library_folder / f"{name}.npz") for name in ("sway", "turn", "nod")}


@pytest.fixture(scope="session")
def small_setup(robot, tiny_config, clips) -> Setup:
    """The tiny config with these clips, of which `turn` is to be forgotten."""
    unlearn = dataclasses.replace(tiny_config.unlearn, targets=("turn",))
    config = dataclasses.replace(tiny_config, unlearn=unlearn)
    return Setup(config, robot, build_library(robot, list(clips.values())), library_hash="invented")
