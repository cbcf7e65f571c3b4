"""Every setting, in frozen dataclasses. Presets: `paper` (a GPU) and `cpu` (a laptop), as differences from the paper.

A value that the paper leaves out is wbc-mjlab's, whose constants match the paper's where it gives them.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

import yaml

from forgetmimic_jax.basics.errors import InputError, nearest

Ranges = tuple[float, ...]


@dataclass(frozen=True)
class PhysicsConfig:
    """Simulation (paper, appendix 'Simulation')."""

    engine: Literal["auto", "native", "mjx", "mjx-warp"] = "auto"  # auto: native on a CPU, mjx on a GPU or TPU
    timestep: float = 0.005  # s
    substeps: int = 4  # physics steps per control step: 50 Hz control
    solver_iterations: int = 10
    line_search_iterations: int = 20
    self_collision: bool = False

    @property
    def control_step(self) -> float:
        """Seconds between two actions."""
        return self.timestep * self.substeps


@dataclass(frozen=True)
class RewardConfig:
    """Weights and scales (paper, table of reward terms); the kernel is exp(−κ e / σ²)."""

    root_position: float = 1.0
    root_orientation: float = 1.0
    root_linear_velocity: float = 1.0
    root_angular_velocity: float = 1.0
    body_position: float = 1.0
    body_orientation: float = 1.0
    body_linear_velocity: float = 0.5
    body_angular_velocity: float = 0.5
    joint_position: float = 1.0
    joint_velocity: float = 0.0
    survival: float = 1.0
    action_rate_l1: float = -0.1
    joint_acceleration: float = -5e-6
    joint_limit: float = -1.0
    torque_limit: float = -0.1
    torque_soft_ratio: float = 0.9
    # The paper's table lists these with weight 0: no one computes them, and `validate` accepts no other weight.
    foot_slip: float = 0.0
    angular_momentum: float = 0.0


@dataclass(frozen=True)
class TerminationConfig:
    """Bounds that end an episode (paper, appendix 'Termination Conditions')."""

    anchor_height: float = 0.35  # m
    orientation: float = 0.8  # difference of projected gravity's z, or rad with orientation_rule 'angle'
    orientation_rule: Literal["gravity_z", "angle"] = "gravity_z"
    end_effector_height: float = 0.25  # m
    contact_force: float = 2000.0  # N for the G1, in proportion to the mass for another robot


@dataclass(frozen=True)
class NoiseConfig:
    """Reset noise, randomisation and observation noise: uniform half-widths (wbc-mjlab).

    `enabled` stands for all but the reset noise, which evaluation keeps.
    """

    enabled: bool = True
    reset_position: Ranges = (0.05, 0.05, 0.01)  # m
    reset_orientation: Ranges = (0.1, 0.1, 0.2)  # rad: roll, pitch, yaw
    reset_linear_velocity: Ranges = (0.5, 0.5, 0.2)  # m/s
    reset_angular_velocity: Ranges = (0.52, 0.52, 0.78)  # rad/s
    reset_joint_position: float = 0.1  # rad
    push_interval: Ranges = (1.0, 3.0)  # s, drawn uniformly; a push adds a velocity in the reset ranges
    torso_com: Ranges = (0.025, 0.05, 0.05)  # m
    encoder_bias: float = 0.01  # rad
    foot_friction: Ranges = (0.3, 1.5)  # drawn uniformly between
    observation_reference_height: float = 0.01
    observation_reference_linear_velocity: Ranges = (0.1, 0.1, 0.05)
    observation_reference_angular_velocity: Ranges = (0.2, 0.2, 0.3)
    observation_reference_gravity: float = 0.02
    observation_reference_joints: float = 0.05
    observation_gyro: float = 0.2
    observation_gravity: float = 0.05
    observation_joint_position: float = 0.01
    observation_joint_velocity: float = 1.5


@dataclass(frozen=True)
class SamplingConfig:
    """Reference-state initialisation: which clip and frame an episode starts from."""

    rule: Literal["adaptive", "uniform_clips", "uniform_bins", "frozen"] = "adaptive"
    bin_seconds: float = 4.0
    smoothing: float = 0.005  # α per episode
    uniform_ratio: float = 0.15  # ρ
    prior: Literal["bins", "clips"] = "bins"  # clips: short clips weigh as much as long ones, whatever their bins
    initial_failure: float = 1.0
    failure_signal: Literal["survival_weighted", "alive_mean"] = "survival_weighted"
    clips: Literal["all", "kept"] = "all"  # kept: no episode of a clip to forget
    target_share: float = 0.0  # share of the starts that are the targets'; 0: what the rule gives them


@dataclass(frozen=True)
class WrenchConfig:
    """Assistive wrench: β = clamp(1 − (1 − L)/η, 0, β_max), and its computed-torque gains."""

    max_gain: float = 0.6  # β_max; 0 turns the wrench off
    sensitivity: float = 0.8  # η
    position_stiffness: float = 100.0  # k_p, 1/s²
    position_damping: float = 20.0  # k_d, 1/s
    orientation_stiffness: float = 100.0  # k_R, 1/s²
    orientation_damping: float = 20.0  # k_ω, 1/s


@dataclass(frozen=True)
class PPOConfig:
    """Proximal policy optimisation (paper, appendix 'PPO Hyperparameters')."""

    num_envs: int = 4096
    branches: int = (
        1  # environments that set out from one state in every iteration, each other's baseline; 1: plain PPO
    )
    num_steps: int = 24  # control steps per environment per iteration
    epochs: int = 5
    minibatches: int = 4
    learning_rate: float = 1e-3
    # The step size follows the KL at every minibatch or iteration, stays, or rises, stays and falls over the run.
    schedule: Literal["adaptive", "adaptive_iteration", "fixed", "trapezoid"] = "adaptive"
    target_kl: float = 0.01
    min_learning_rate: float = 1e-5
    max_learning_rate: float = 1e-2
    discount: float = 0.99
    gae_lambda: float = 0.95
    clip: float = 0.2
    entropy_cost: float = 0.005
    value_cost: float = 1.0
    clip_value: bool = True
    equal_clips: bool = False  # every clip weighs the same in the losses, however few of the steps are its
    anchor: float = 0.0  # weight of KL(π ‖ π_base) on the kept clips' steps, while unlearning
    max_gradient_norm: float = 1.0
    actor_layers: tuple[int, ...] = (1024, 512, 256, 128)
    critic_layers: tuple[int, ...] = (1024, 1024, 512, 256)
    initial_std: float = 1.0


@dataclass(frozen=True)
class UnlearnConfig:
    """The unlearning flag: clips to forget, how, and the penalty λ. No targets: ordinary training."""

    targets: tuple[str, ...] = ()
    penalty: float = 16.0  # λ of arft; W = 8 is the edge of the paper's algebra
    method: str = "arft"  # a module of forgetmimic_jax.unlearning


@dataclass(frozen=True)
class Config:
    """One run."""

    preset: str = "paper"
    robot: str = "g1"
    library: str | None = None  # folder of clips; None: data/ROBOT
    base: str | None = None  # checkpoint to start from; None: a random policy, or for unlearning the shipped base
    seed: int = 0
    iterations: int = 100_000
    checkpoint_every: int = 500
    evaluate_every: int = 0  # iterations between evaluations during training; 0: none
    evaluate_episodes: int = 6  # a clip in each of them: enough to see a trend, not to report
    max_episode_steps: int = 500  # 10 s
    physics: PhysicsConfig = field(default_factory=PhysicsConfig)
    reward: RewardConfig = field(default_factory=RewardConfig)
    termination: TerminationConfig = field(default_factory=TerminationConfig)
    noise: NoiseConfig = field(default_factory=NoiseConfig)
    sampling: SamplingConfig = field(default_factory=SamplingConfig)
    wrench: WrenchConfig = field(default_factory=WrenchConfig)
    ppo: PPOConfig = field(default_factory=PPOConfig)
    unlearn: UnlearnConfig = field(default_factory=UnlearnConfig)


def preset(name: str) -> Config:
    """The settings of a preset.

    `paper`: the paper's, for a GPU. `cpu`: what trains best on a laptop's cores (experiments/base_policy.md).
    """
    paper = Config()
    if name == "paper":
        return paper
    if name == "cpu":
        # Without randomisation: evaluation has none either, and a laptop's budget is better spent on the motions.
        return dataclasses.replace(
            paper,
            preset="cpu",
            iterations=7_000,
            checkpoint_every=50,
            evaluate_every=150,
            noise=dataclasses.replace(paper.noise, enabled=False),
            sampling=dataclasses.replace(paper.sampling, bin_seconds=1.0, prior="clips", uniform_ratio=0.3),
            wrench=dataclasses.replace(paper.wrench, max_gain=0.0),
            ppo=dataclasses.replace(
                paper.ppo,
                num_envs=512,
                branches=4,
                epochs=4,
                minibatches=12,
                learning_rate=2e-4,
                schedule="adaptive_iteration",
                target_kl=0.03,
                discount=0.97,
                entropy_cost=0.006,
                actor_layers=(256, 256, 128),
                critic_layers=(256, 256, 128),
            ),
        )
    raise InputError(f"preset '{name}': {nearest(name, ['paper', 'cpu'])}")


_ABOVE_ZERO = {
    *("physics.timestep", "sampling.bin_seconds", "wrench.sensitivity", "unlearn.penalty"),
    *("ppo.learning_rate", "ppo.min_learning_rate", "ppo.max_learning_rate", "ppo.target_kl", "ppo.clip"),
    *("ppo.max_gradient_norm", "ppo.initial_std"),
}
_SHARES = {
    *("reward.torque_soft_ratio", "sampling.smoothing", "sampling.uniform_ratio", "sampling.initial_failure"),
    *("sampling.target_share", "wrench.max_gain", "ppo.discount", "ppo.gae_lambda"),
}


_NOT_COMPUTED = {"reward.foot_slip", "reward.angular_momentum"}


def validate(config: Config) -> None:
    """Tell numbers that no run can work with before anything is built.

    A whole number is a count and at least 1, a weight may have any sign, every other number is at least 0.

    Raises:
        InputError: the setting, what was found and what is accepted.
    """
    for name, value in _numbers(to_dict(config)):
        if name == "seed":
            good, accepted = 0 <= value < 2**32, "0 to 4294967295"
        elif isinstance(value, int):
            smallest = 0 if name == "evaluate_every" else 1
            good, accepted = value >= smallest, f"{smallest} or more"
        elif name in _ABOVE_ZERO:
            good, accepted = 0.0 < value < math.inf, "above 0"
        elif name in _SHARES:
            good, accepted = 0.0 <= value <= 1.0, "0 to 1"
        elif name in _NOT_COMPUTED:
            good, accepted = value == 0.0, "0 (this term is not computed)"
        elif name.startswith("reward."):
            good, accepted = math.isfinite(value), "any finite number"
        else:
            good, accepted = 0.0 <= value < math.inf, "0 or more"
        if not good:
            raise InputError(f"{name}: found {value:g}; accepted: {accepted}")
    for field_ in fields(NoiseConfig):
        value, default = getattr(config.noise, field_.name), field_.default
        if isinstance(default, tuple) and len(value) != len(default):
            raise InputError(f"noise.{field_.name}: found {len(value)} numbers; accepted: {len(default)}")
    if config.sampling.target_share and (config.sampling.clips == "kept" or not config.unlearn.targets):
        found = "sampling.clips = kept" if config.unlearn.targets else "no targets"
        raise InputError(
            f"sampling.target_share: found {config.sampling.target_share:g} with {found}; accepted: 0, or a share "
            "where episodes start from targets too"
        )
    ppo = config.ppo
    if ppo.num_envs * ppo.num_steps < ppo.minibatches:
        raise InputError(
            f"ppo.minibatches: found {ppo.minibatches}; accepted: 1 to num_envs × num_steps = "
            f"{ppo.num_envs * ppo.num_steps}"
        )
    if ppo.num_envs % ppo.branches:
        raise InputError(f"ppo.branches: found {ppo.branches}; accepted: a divisor of num_envs = {ppo.num_envs}")


def _numbers(content: Any, name: str = "") -> Iterator[tuple[str, int | float]]:
    """Every number of a nested dict with its dotted name; those of a list have the list's."""
    if isinstance(content, dict):
        for key, value in content.items():
            yield from _numbers(value, f"{name}.{key}" if name else key)
    elif isinstance(content, list):
        for value in content:
            yield from _numbers(value, name)
    elif isinstance(content, int | float) and not isinstance(content, bool):
        yield name, content


T = TypeVar("T")


def to_dict(config: Any) -> dict[str, Any]:
    """Plain nested dict of a config, tuples as lists: what YAML holds."""
    return json.loads(json.dumps(dataclasses.asdict(config)))


def config_hash(config: Config) -> str:
    """Content hash (16 hex digits) of every setting that changes a result."""
    content = to_dict(config)
    for neutral in ("base", "checkpoint_every", "evaluate_every", "evaluate_episodes", "iterations"):
        content.pop(neutral)
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


def save_config(config: Config, path: Path) -> None:
    """Write a config as YAML, atomically."""
    temporary = path.with_suffix(".tmp")
    temporary.write_text(yaml.safe_dump(to_dict(config), sort_keys=False))
    os.replace(temporary, path)


def load_config(path: Path) -> Config:
    """Read a config saved by `save_config`.

    Raises:
        InputError: no such file, an unknown setting, or a value of the wrong type.
    """
    try:
        content = yaml.safe_load(path.read_text())
    except FileNotFoundError:
        raise InputError(f"{path}: no such config") from None
    except yaml.YAMLError as error:
        raise InputError(f"{path}: not YAML: {str(error).splitlines()[0]}") from None
    return from_dict(Config, content, str(path))


def from_dict(cls: type[T], content: Any, where: str) -> T:
    """A (nested) config from a plain dict; `where` leads every error message."""
    if not isinstance(content, Mapping):
        raise InputError(f"{where}: expected a table of settings, found {type(content).__name__}")
    hints = get_type_hints(cls)
    known = [f.name for f in fields(cls)]  # type: ignore[arg-type]
    for key in content:
        if key not in known:
            raise InputError(f"{where}: unknown setting '{key}'; {nearest(str(key), known)}")
    return cls(**{key: _convert(hints[key], value, f"{where}: {key}") for key, value in content.items()})


def _convert(hint: Any, value: Any, where: str) -> Any:
    if is_dataclass(hint):
        return from_dict(hint, value, where)  # type: ignore[arg-type]
    origin = get_origin(hint)
    if origin is Literal:
        if value not in get_args(hint):
            raise InputError(f"{where}: found {value!r}, accepted: {', '.join(map(str, get_args(hint)))}")
        return value
    if origin is tuple:
        if not isinstance(value, list | tuple):
            raise InputError(f"{where}: expected a list, found {value!r}")
        return tuple(_convert(get_args(hint)[0], item, where) for item in value)
    if hint is float and isinstance(value, int | float) and not isinstance(value, bool):
        return float(value)
    if type(None) in get_args(hint):
        return None if value is None else _convert(get_args(hint)[0], value, where)
    if not isinstance(value, hint) or (hint is int and isinstance(value, bool)):
        raise InputError(f"{where}: expected {hint.__name__}, found {value!r}")
    return value
