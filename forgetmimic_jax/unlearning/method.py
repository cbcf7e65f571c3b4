"""What an unlearning method may change of PPO. A module of this package with a `METHOD` is one, by its file's name."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from forgetmimic_jax.ppo.rule import Rule


@dataclass(frozen=True)
class Pace:
    """How long a method trains by default, and the PPO settings that it trains with.

    Args:
        iterations: by preset; of a preset without a number, as many steps as the base was trained for.
        ppo: settings of the `ppo` section by preset, in the place of the base's own.
        target_share: share of the uniform starts that are the targets', by preset.
        first_frame: share of the uniform starts that are at the first frame of their clip.
    """

    iterations: Mapping[str, int]
    ppo: Mapping[str, Mapping[str, Any]]
    target_share: Mapping[str, float] = field(default_factory=dict)
    first_frame: float = 0.0


# On a laptop: short iterations, because forgetting takes some hundred of them whatever their length. Targets would be
# a few steps in a hundred, and fewer as they are forgotten. So half of the starts are theirs and clips weigh the same.
# The step size rises and falls, and a KL to the base keeps the kept clips. Values of targets change sign, so the
# clipping of the value loss would slow their learning.
SHORT: dict[str, Any] = {
    "num_steps": 12,
    "minibatches": 4,
    "epochs": 2,
    "schedule": "trapezoid",
    "learning_rate": 3e-4,
    "clip_value": False,
    "equal_clips": True,
    "base_kl": 0.1,
}
STOP_EVERY = 10  # iterations, of the methods whose reward would push the targets below the zero-action baseline
FINE_TUNING = Pace({"cpu": 640, "paper": 1000}, {"cpu": SHORT}, {"cpu": 0.5})


@dataclass(frozen=True)
class Method(Rule):
    """An unlearning method: its rule, and what its runs start from. Without any difference, fine-tuning on all clips.

    Args:
        reward, observation, loss, simulate: see `Rule`.
        clips: which clips episodes start from, unless the user says otherwise (`sampling.clips`).
        start: `base`: the base policy, with uniform sampling and no wrench. `taught`: a fresh policy with a KL to the
            base, with the same sampling. `fresh`: a fresh policy with the base's own settings.
        result: what evaluation.json calls the policy.
        settings: its own settings (`unlearn.settings`) and their defaults.
        pace: how long it trains and with which PPO settings.
        instead: what it teaches in the place of the targets by default (`unlearn.instead`), where it teaches.
        stop_every: iterations between two looks of the stop rule by default (`unlearn.stop_every`); 0: a method that
            has no stop rule, because nothing in it pushes the targets below the zero-action baseline.
    """

    clips: Literal["all", "kept"] = "all"
    start: Literal["base", "taught", "fresh"] = "base"
    result: Literal["unlearned", "retrained", "fine_tuned"] = "unlearned"
    settings: Mapping[str, float] = field(default_factory=dict)
    pace: Pace = FINE_TUNING
    instead: str | None = None
    stop_every: int = 0
