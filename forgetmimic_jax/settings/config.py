"""Every setting, in frozen dataclasses. Presets: `paper` (a GPU) and `cpu` (a laptop), as differences from the paper.

A value that the paper leaves out is wbc-mjlab's, whose constants match the paper's where it gives them.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import yaml

from forgetmimic_jax.basics.errors import InputError, nearest
from forgetmimic_jax.basics.files import write_atomically
from forgetmimic_jax.settings.checked import (
    Amount,
    Angle,
    BodyWeights,
    Count,
    Interval,
    NotComputed,
    Period,
    Positive,
    Seed,
    Share,
    Vector,
    Weight,
    from_dict,
)

EngineName = Literal["auto", "native", "mjx", "mjx-warp"]
Preset = Literal["cpu", "paper"]


@dataclass(frozen=True)
class PhysicsConfig:
    """Simulation (paper, appendix 'Simulation')."""

    engine: EngineName = "auto"  # auto: native on a CPU, mjx on a GPU or TPU
    timestep: Positive = 0.005  # s
    substeps: Count = 4  # physics steps per control step: 50 Hz control
    solver_iterations: Count = 10
    line_search_iterations: Count = 20
    self_collision: bool = False
    warp_contacts: Count = 35  # room of mjx-warp, an environment: contact points, on average over all environments
    warp_constraints: Count = 250  # and rows of contact forces and joint limits

    @property
    def control_step(self) -> float:
        """Seconds between two actions."""
        return self.timestep * self.substeps


@dataclass(frozen=True)
class ObservationConfig:
    """What the actor sees."""

    layout: str = "wbc132"  # a name in `tracking.layouts.LAYOUTS`


@dataclass(frozen=True)
class ActionConfig:
    """What the actor's output does, and the robot that the policy expects, joint by joint.

    A joint that a table leaves out has the robot's own value; without an order, joints are in the robot's own.
    """

    mode: Literal["residual", "offset"] = "residual"  # added to the reference joints, or to the default pose
    joint_order: tuple[str, ...] = ()  # of the actor's inputs and outputs
    default_pose: dict[str, Angle] = field(default_factory=dict, hash=False)  # rad
    scale: dict[str, Positive] = field(default_factory=dict, hash=False)  # rad per unit of action
    stiffness: dict[str, Positive] = field(default_factory=dict, hash=False)  # kp, N m/rad
    damping: dict[str, Amount] = field(default_factory=dict, hash=False)  # kd, N m s/rad
    armature: dict[str, Amount] = field(default_factory=dict, hash=False)  # reflected inertia of the motor, kg m²


@dataclass(frozen=True)
class RewardConfig:
    """Weights and scales (paper, table of reward terms); the kernel is exp(−κ e / σ²)."""

    root_position: Weight = 1.0
    root_orientation: Weight = 1.0
    root_linear_velocity: Weight = 1.0
    root_angular_velocity: Weight = 1.0
    body_position: Weight = 1.0
    body_orientation: Weight = 1.0
    body_linear_velocity: Weight = 0.5
    body_angular_velocity: Weight = 0.5
    joint_position: Weight = 1.0
    joint_velocity: Weight = 0.0
    survival: Weight = 1.0
    action_rate_l1: Weight = -0.1
    joint_acceleration: Weight = -5e-6
    joint_limit: Weight = -1.0
    torque_limit: Weight = -0.1
    torque_soft_ratio: Share = 0.9
    # The paper's table lists these with weight 0: no one computes them, and `validate` accepts no other weight.
    foot_slip: NotComputed = 0.0
    angular_momentum: NotComputed = 0.0


@dataclass(frozen=True)
class TerminationConfig:
    """Bounds that end an episode (paper, appendix 'Termination Conditions')."""

    anchor_height: Amount = 0.35  # m
    orientation: Amount = 0.8  # difference of projected gravity's z, or rad with orientation_rule 'angle'
    orientation_rule: Literal["gravity_z", "angle"] = "gravity_z"
    end_effector_height: Amount = 0.25  # m
    contact_force: BodyWeights = 6.114775503760825  # body weights: 2000 N for the G1


@dataclass(frozen=True)
class NoiseConfig:
    """Reset noise, randomisation and observation noise: uniform half-widths (wbc-mjlab).

    `enabled` stands for all but the reset noise, which evaluation keeps.
    """

    enabled: bool = True
    reset_position: Vector = (0.05, 0.05, 0.01)  # m
    reset_orientation: Vector = (0.1, 0.1, 0.2)  # rad: roll, pitch, yaw
    reset_linear_velocity: Vector = (0.5, 0.5, 0.2)  # m/s
    reset_angular_velocity: Vector = (0.52, 0.52, 0.78)  # rad/s
    reset_joint_position: Amount = 0.1  # rad
    push_interval: Interval = (1.0, 3.0)  # s, drawn uniformly; a push adds a velocity in the reset ranges
    torso_com: Vector = (0.025, 0.05, 0.05)  # m
    encoder_bias: Amount = 0.01  # rad
    foot_friction: Interval = (0.3, 1.5)  # drawn uniformly between
    sensors: Amount = 1.0  # times the half-widths of the observation's terms, which the layout has


@dataclass(frozen=True)
class SamplingConfig:
    """Reference-state initialisation: which clip and frame an episode starts from."""

    rule: Literal["adaptive", "uniform_clips", "uniform_bins", "frozen"] = "adaptive"
    bin_seconds: Positive = 4.0
    smoothing: Share = 0.005  # α per episode
    uniform_ratio: Share = 0.15  # ρ
    prior: Literal["bins", "clips"] = "bins"  # clips: short clips weigh as much as long ones, whatever their bins
    initial_failure: Share = 1.0
    failure_signal: Literal["survival_weighted", "alive_mean"] = "survival_weighted"
    clips: Literal["all", "kept"] = "all"  # kept: no episode of a clip to forget
    target_share: Share = 0.0  # share of the starts that are the targets'; 0: what the rule gives them
    first_frame: Share = 0.0  # share of the starts that are moved to the first frame of their clip


@dataclass(frozen=True)
class WrenchConfig:
    """Assistive wrench: β = clamp(1 − (1 − L)/η, 0, β_max), and its computed-torque gains."""

    max_gain: Share = 0.6  # β_max; 0 turns the wrench off
    sensitivity: Positive = 0.8  # η
    position_stiffness: Amount = 100.0  # k_p, 1/s²
    position_damping: Amount = 20.0  # k_d, 1/s
    orientation_stiffness: Amount = 100.0  # k_R, 1/s²
    orientation_damping: Amount = 20.0  # k_ω, 1/s


@dataclass(frozen=True)
class PPOConfig:
    """Proximal policy optimisation (paper, appendix 'PPO Hyperparameters')."""

    num_envs: Count = 4096
    branches: Count = (
        1  # environments that start from one state in every iteration, each other's baseline; 1: plain PPO
    )
    num_steps: Count = 24  # control steps per environment per iteration
    epochs: Count = 5
    minibatches: Count = 4
    learning_rate: Positive = 1e-3
    # The step size follows the KL at every minibatch or iteration, stays, or rises, stays and falls over the run.
    schedule: Literal["adaptive", "adaptive_iteration", "fixed", "trapezoid"] = "adaptive"
    target_kl: Positive = 0.01
    min_learning_rate: Positive = 1e-5
    max_learning_rate: Positive = 1e-2
    discount: Share = 0.99
    gae_lambda: Share = 0.95
    clip_range: Positive = 0.2
    entropy_cost: Amount = 0.005
    value_cost: Amount = 1.0
    clip_value: bool = True
    equal_clips: bool = False  # every clip weighs the same in the losses, however few of the steps are its
    base_kl: Amount = 0.0  # weight of KL(π ‖ π_base) on the kept clips' steps, while unlearning
    max_gradient_norm: Positive = 1.0
    actor_layers: tuple[Count, ...] = (1024, 512, 256, 128)
    critic_layers: tuple[Count, ...] = (1024, 1024, 512, 256)
    initial_std: Positive = 1.0


@dataclass(frozen=True)
class PretrainConfig:
    """The phases of pretraining, which are in training/curriculum.py; ordinary training has none.

    The score of a clip is the mean of its success and its survival-weighted tracking. Progress is counted from one
    evaluation to the next (`evaluate_every` iterations).
    """

    average: Period = 0  # iterations over which the parameters are averaged that are evaluated and kept; 0: the newest
    mastered: Share = 0.95  # success from which a clip is mastered
    gain: Positive = 0.01  # rise of a score above its record that counts as progress
    patience: Count = 3  # evaluations without progress after which a clip is stuck, or a phase ends
    lagging_share: Share = 0.75  # of the steps, for the clips that are new or learning, in the phase `lagging`
    best_kl: Amount = 0.1  # weight of KL(π ‖ π_best) on the clips that the best policy has mastered, there
    target_kl: Positive = 0.012  # in the place of ppo.target_kl in every phase but the first
    gae_lambda: Share = 0.97  # in the place of ppo.gae_lambda, likewise
    broad_until: Share = 0.5  # of the iterations: the end of a phase that still makes progress
    lagging_until: Share = 0.7
    specialist_evaluations: Count = 8  # the longest training of a specialist
    search_rounds: Period = 75  # of the search for a first success; 0: no search
    distil_rounds: Count = 80


@dataclass(frozen=True)
class UnlearnConfig:
    """The unlearning flag: clips to forget, and how. No targets: ordinary training."""

    targets: tuple[str, ...] = ()
    method: str = "arft"  # a module of forgetmimic_jax.unlearning
    settings: dict[str, float] = field(default_factory=dict, hash=False)  # the method's own, such as λ of arft
    instead: str | None = None  # what a method teaches in the place of the targets: stand, or a kept clip
    stop_every: Period = 0  # iterations between two looks whether the targets are at the zero-action baseline; 0: none


@dataclass(frozen=True)
class Config:
    """One run."""

    preset: str = "paper"
    robot: str = "g1"
    library: str | None = None  # folder of clips; None: data/ROBOT
    base: str | None = None  # checkpoint to start from; None: a random policy, or for unlearning the shipped base
    seed: Seed = 0
    iterations: Count = 100_000
    checkpoint_every: Count = 500
    evaluate_every: Period = 0  # iterations between evaluations during training; 0: none
    evaluate_episodes: Count = 6  # a clip in each of them: enough to see a trend, not to report
    max_episode_steps: Count = 500  # 10 s
    devices: Count = 1  # that share the environments, each with noise of its own
    physics: PhysicsConfig = field(default_factory=PhysicsConfig)
    observation: ObservationConfig = field(default_factory=ObservationConfig)
    action: ActionConfig = field(default_factory=ActionConfig)
    reward: RewardConfig = field(default_factory=RewardConfig)
    termination: TerminationConfig = field(default_factory=TerminationConfig)
    noise: NoiseConfig = field(default_factory=NoiseConfig)
    sampling: SamplingConfig = field(default_factory=SamplingConfig)
    wrench: WrenchConfig = field(default_factory=WrenchConfig)
    ppo: PPOConfig = field(default_factory=PPOConfig)
    unlearn: UnlearnConfig = field(default_factory=UnlearnConfig)
    pretrain: PretrainConfig = field(default_factory=PretrainConfig)


# What a preset changes of the paper's settings. `cpu` is what trains best on a laptop's cores (docs/findings.md):
# without randomisation, since evaluation has none either and a laptop's budget is better spent on the motions.
PRESETS: dict[str, dict[str, Any]] = {
    "paper": {},
    "cpu": {
        "iterations": 7_000,
        "checkpoint_every": 50,
        "evaluate_every": 150,
        "noise": {"enabled": False},
        "sampling": {"bin_seconds": 1.0, "prior": "clips", "uniform_ratio": 0.3},
        "wrench": {"max_gain": 0.0},
        "ppo": {
            "num_envs": 512,
            "branches": 4,
            "epochs": 4,
            "minibatches": 12,
            "learning_rate": 2e-4,
            "schedule": "adaptive_iteration",
            "target_kl": 0.03,
            "discount": 0.97,
            "entropy_cost": 0.006,
            "actor_layers": (256, 256, 128),
            "critic_layers": (256, 256, 128),
        },
    },
}


def preset(name: str) -> Config:
    """The settings of a preset: the paper's, with the changes of `PRESETS`.

    Raises:
        InputError: unknown preset.
    """
    if name not in PRESETS:
        raise InputError(f"preset '{name}': {nearest(name, PRESETS)}")
    return from_dict(Config, {"preset": name, **PRESETS[name]}, f"preset {name}")


def validate(config: Config) -> None:
    """Refuse settings that no run can work with, before anything is built.

    Raises:
        InputError: the setting, what was found and what is accepted.
    """
    from_dict(Config, to_dict(config))
    if config.sampling.target_share and (config.sampling.clips == "kept" or not config.unlearn.targets):
        found = "sampling.clips = kept" if config.unlearn.targets else "no targets"
        raise InputError(
            f"sampling.target_share: found {config.sampling.target_share:g} with {found}; accepted: 0, or a share "
            "where episodes start from targets too"
        )
    for name, value in config.unlearn.settings.items():
        if not 0.0 < value < math.inf:
            raise InputError(f"unlearn.settings.{name}: found {value!r}; accepted: a number above 0")
    ppo = config.ppo
    if ppo.num_envs % ppo.branches:
        raise InputError(f"ppo.branches: found {ppo.branches}; accepted: a divisor of num_envs = {ppo.num_envs}")
    groups = ppo.num_envs // ppo.branches
    if groups % config.devices:
        raise InputError(f"devices: found {config.devices}; accepted: a divisor of num_envs / branches = {groups}")
    steps = ppo.num_envs * ppo.num_steps // config.devices
    if steps < ppo.minibatches:
        raise InputError(f"ppo.minibatches: found {ppo.minibatches}; accepted: 1 to {steps}, the steps of each device")


def to_dict(config: Config) -> dict[str, Any]:
    """Plain nested dict of a config, tuples as lists: what YAML holds."""
    return json.loads(json.dumps(dataclasses.asdict(config)))


def by_name(config: Config) -> dict[str, Any]:
    """Every setting by its dotted name, such as `ppo.learning_rate`; tuples as lists."""

    def settings(content: Mapping[str, Any], prefix: str) -> Iterator[tuple[str, Any]]:
        for name, value in content.items():
            if isinstance(value, dict):
                yield from settings(value, f"{prefix}{name}.")
            else:
                yield f"{prefix}{name}", value

    return dict(settings(to_dict(config), ""))


def config_hash(config: Config) -> str:
    """Content hash (16 hex digits) of every setting that changes a result."""
    content = to_dict(config)
    for neutral in ("base", "checkpoint_every", "evaluate_every", "evaluate_episodes", "iterations", "pretrain"):
        content.pop(neutral)
    if config.devices == 1:  # the hash of a run on one device does not know that there may be more
        content.pop("devices")
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


def save_config(config: Config, path: Path) -> None:
    """Write a config as YAML, atomically."""
    write_atomically(path, yaml.safe_dump(to_dict(config), sort_keys=False).encode())


def load_config(path: Path) -> Config:
    """Read a config saved by `save_config`.

    Raises:
        InputError: no such file, no YAML, or a setting that `from_dict` refuses.
    """
    try:
        content = yaml.safe_load(path.read_text())
    except FileNotFoundError:
        raise InputError(f"{path}: no such config") from None
    except (yaml.YAMLError, ValueError) as error:
        raise InputError(f"{path}: not YAML: {str(error).splitlines()[0]}") from None
    return from_dict(Config, content, str(path))
