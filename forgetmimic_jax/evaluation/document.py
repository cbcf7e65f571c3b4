"""evaluation.json, the one source of every number: its types, and how it is read and written.

Tables, figures, the verdict and the report take an `EvaluationDocument`; none of them reads the file itself.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal, TypeVar

import msgspec

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.basics.files import write_json
from forgetmimic_jax.basics.provenance import Provenance
from forgetmimic_jax.evaluation.metrics import BASE, UNLEARNED, ZERO_ACTION

SCHEMA = 1
FILE = "evaluation.json"
T = TypeVar("T")


class Estimate(msgspec.Struct, frozen=True, omit_defaults=True):
    """A mean over `n` units and its 95 % interval. What is undefined is None, and absent in the file.

    `std` is the standard deviation over the units; of a ratio, which no single unit has, that of the bootstrap.
    """

    mean: float | None = None
    low: float | None = None
    high: float | None = None
    std: float | None = None
    n: int = 0


class UnboundedNumbers(msgspec.Struct, kw_only=True, omit_defaults=True):
    """What a robot did in episodes that no termination ends; `docs/method.md` defines each. None: undefined."""

    upright_rate: Estimate | None = None
    safe_rate: Estimate | None = None
    time_to_fall: Estimate | None = None  # s
    impact_force_median: Estimate | None = None  # body weights
    impact_force_95: Estimate | None = None  # body weights, the 95th percentile
    impact_rate: Estimate | None = None  # share of episodes above one body weight
    impact_speed: Estimate | None = None  # m/s
    head_contact_rate: Estimate | None = None
    hand_contact_rate: Estimate | None = None
    torque_saturation: Estimate | None = None
    joint_limit_violation: Estimate | None = None
    joint_speed_violation: Estimate | None = None
    motion_content: Estimate | None = None
    attempt_rate: Estimate | None = None


class UnboundedResult(msgspec.Struct, kw_only=True):
    """The same over all starts, and over those from a clip's first frame."""

    all_starts: UnboundedNumbers
    from_frame_0: UnboundedNumbers


class GroupResult(msgspec.Struct, kw_only=True, omit_defaults=True):
    """One policy's numbers over the episodes of some clips; `docs/method.md` defines each.

    In the file the errors are beside the other numbers, without a level of their own.
    """

    tracking_reward: Estimate
    survival_weighted_tracking: Estimate
    success_rate: Estimate
    episode_length: Estimate
    success_rate_from_frame_0: Estimate | None = None  # of the episodes that start there; absent in older files
    skill: Estimate | None = None  # signed; None where the base is hardly better than the zero-action baseline
    retention: Estimate | None = None
    unbounded: UnboundedResult | None = None  # of targets; absent in older files
    errors: dict[str, Estimate] = {}

    def metric(self, name: str) -> Estimate | None:
        """A number or an error by its name in the file."""
        return self.errors.get(name) or getattr(self, name, None)


class ClipResult(GroupResult, kw_only=True):
    """The same of one clip."""

    target: bool


class PolicyResult(msgspec.Struct, kw_only=True, omit_defaults=True):
    """One policy clip by clip, and over the targets and the kept clips, where there are any."""

    clips: dict[str, ClipResult]
    target: GroupResult | None = None
    kept: GroupResult | None = None
    degradation_ratio: Estimate | None = None  # target over kept, of tracking_reward: the paper's
    survival_weighted_degradation_ratio: Estimate | None = None
    nan_resets: int  # episodes that met a NaN or Inf and were ended for it
    ended_by: dict[str, int] = {}  # episodes by the bound that ended them; one may break two at once


class EvaluationDocument(msgspec.Struct, kw_only=True, omit_defaults=True):
    """The whole of evaluation.json."""

    schema: int
    robot: str
    checkpoint: str  # what was evaluated, as the user named it
    config_hash: str
    library_hash: str
    seed: int  # of the start frames, the resets and the bootstrap
    episodes: int  # a clip
    targets: list[str]  # clips to forget
    noise: bool = False  # randomisation, pushes and sensor noise as in training
    policies: dict[str, PolicyResult]  # by name: base, unlearned, zero_action ...
    budget: dict[str, dict[str, int | float]] = {}  # by policy, what its training cost
    made: Provenance | None = None  # absent in older files, as are the hashes
    policy_hashes: dict[str, str] = {}  # by policy, `checkpoint.policy_hash`
    action_mode: Literal["residual", "offset"] = "residual"  # the setting `action.mode`; absent if residual

    @property
    def zero_action(self) -> str:
        """What the joint controllers do in the zero-action baseline."""
        return {"residual": "replay the clip", "offset": "hold the default pose"}[self.action_mode]

    @property
    def subject(self) -> str | None:
        """Name of the policy that is compared with the base: the unlearned one, or the first other that was trained."""
        trained = [name for name in self.policies if name not in (BASE, ZERO_ACTION)]
        return UNLEARNED if UNLEARNED in trained else next(iter(trained), None)


def policy_result(content: Mapping[str, Any]) -> PolicyResult:
    """One policy's numbers from the plain dict that the file holds of it."""
    policy: dict[str, Any] = {**content, "clips": {name: _nested(clip) for name, clip in content["clips"].items()}}
    policy |= {group: _nested(content[group]) for group in ("target", "kept") if group in content}
    return msgspec.convert(policy, PolicyResult)


def _nested(group: Mapping[str, Any]) -> dict[str, Any]:
    known = {name: value for name, value in group.items() if name in ClipResult.__struct_fields__}
    return {**known, "errors": {name: value for name, value in group.items() if name not in known}}


def _flat(group: dict[str, Any]) -> dict[str, Any]:
    return group | group.pop("errors", {})


def read_evaluation(path: Path) -> EvaluationDocument:
    """The evaluation in a file.

    Raises:
        InputError: no such file, or a damaged or foreign one.
    """

    def document(content: dict[str, Any]) -> EvaluationDocument:
        policies = {name: policy_result(policy) for name, policy in content["policies"].items()}
        return msgspec.structs.replace(
            msgspec.convert({**content, "policies": {}}, EvaluationDocument), policies=policies
        )

    return read_document(path, SCHEMA, "an evaluation", document)


def read_document(path: Path, schema: int, kind: str, document: Callable[[dict[str, Any]], T]) -> T:
    """The typed document in a JSON file.

    Args:
        path: the file.
        schema: the only accepted value of its field `schema`.
        kind: what the file should be, with its article; for the error.
        document: makes the document of the file's content.

    Raises:
        InputError: no such file, or a damaged or foreign one.
    """
    try:
        content = json.loads(path.read_text())
        if content["schema"] != schema:
            raise InputError(f"{path}: schema: found {content['schema']!r}; accepted: {schema}")
        return document(content)
    except FileNotFoundError:
        raise InputError(f"{path}: not found") from None
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: not {kind}, or damaged: {type(error).__name__}: {error}") from None


def write_evaluation(path: Path, document: EvaluationDocument) -> None:
    """Write a document to a file, which appears whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, to_dict(document), sort_keys=True, allow_nan=False)


def to_dict(document: EvaluationDocument) -> dict[str, Any]:
    """The document as the file holds it."""
    content = msgspec.to_builtins(document)
    for policy in content["policies"].values():
        policy["clips"] = {name: _flat(clip) for name, clip in policy["clips"].items()}
        policy |= {group: _flat(policy[group]) for group in ("target", "kept") if group in policy}
    return content


def check_policies(document: EvaluationDocument, path: Path, policies: Mapping[str, tuple[Path, str]]) -> None:
    """The one check that the policies on the disk are those that were evaluated.

    Args:
        document: of the evaluation; an older one does not say which policies it is of, and passes.
        path: its file.
        policies: by name, the folder of a checkpoint and its `checkpoint.policy_hash`.

    Raises:
        InputError: another policy.
    """
    for name, (folder, found) in policies.items():
        evaluated = document.policy_hashes.get(name, found)
        if found != evaluated:
            raise InputError(
                f"{folder}: found the policy {found}; {path} is of the {name} policy {evaluated}; name that one, or "
                f"evaluate again"
            )
