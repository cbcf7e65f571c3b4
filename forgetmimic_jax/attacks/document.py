"""evidence.json: the types of every attack's numbers, and how the file is read and written."""

from __future__ import annotations

from pathlib import Path

import msgspec

from forgetmimic_jax.basics.files import write_json
from forgetmimic_jax.basics.provenance import Provenance
from forgetmimic_jax.evaluation.document import Estimate, UnboundedResult, read_document

SCHEMA = 2
FILE = "evidence.json"
CONTROL = "control"


class Numbers(msgspec.Struct, kw_only=True, omit_defaults=True):
    """What one policy does in some episodes. None: undefined."""

    skill: Estimate | None = None  # signed, the share of the base's above the zero-action baseline
    content: Estimate | None = None  # of the motion, at most 1; `docs/method.md`
    success: Estimate | None = None
    # Less the same number of another policy, episode by episode: of the control, or of the policy before an attack.
    skill_above: Estimate | None = None
    content_above: Estimate | None = None


Compared = dict[str, Numbers]  # by policy: base, unlearned, control


class Originals(msgspec.Struct):
    """The clips as they are."""

    targets: dict[str, Compared]  # by clip
    kept: dict[str, Compared]  # by clip; only skill and success


class NearDuplicates(msgspec.Struct):
    """Variants of the targets, and of the kept clips."""

    families: dict[str, Compared]  # by target and family, as "punch, speed"
    variants: dict[str, Compared]  # by name
    dropped: dict[str, float]  # variants that the base cannot follow: its tracking over that of the original
    kept: dict[str, Compared]  # by family, over all kept clips

    @property
    def worst(self) -> str | None:
        """The variant of which the unlearned policy does most: the larger of its skill and its motion content."""

        def most(name: str) -> float:
            numbers = self.variants[name]["unlearned"]
            means = [value.mean for value in (numbers.skill, numbers.content) if value is not None]
            return max((mean for mean in means if mean is not None), default=-1.0)

        return max(self.variants, key=most, default=None)


class Splices(msgspec.Struct):
    """One second of a clip inside another; numbers are of that second alone."""

    forbidden: Compared  # target seconds inside kept clips
    kept: Compared  # kept seconds inside targets
    splices: dict[str, Compared]  # by name
    dropped: dict[str, float]  # as in `NearDuplicates`, against the host


class LookAlike(msgspec.Struct):
    """A kept segment near a target and one far from it."""

    near: str
    far: str
    distances: tuple[float, float]  # rad, of the two
    retention: dict[str, tuple[float, float]]  # by policy, of the base's tracking, on the two


class LookAlikes(msgspec.Struct):
    """Retention near the targets and far from them; intervals are over segments."""

    pairs: list[LookAlike]
    near: dict[str, Estimate]  # by policy
    far: dict[str, Estimate]
    difference: dict[str, Estimate]  # near less far


class Recovery(msgspec.Struct):
    """The targets, or parts of them, before and after a fine-tuning."""

    iterations: int
    before: dict[str, Compared]  # by clip
    after: dict[str, Compared]


class Curve(msgspec.Struct):
    """Tracking on the targets while a policy learns them."""

    iterations: list[float]
    tracking: list[float]
    target_steps: list[float]


class Relearning(msgspec.Struct):
    """What `evaluation.relearning` reads: curves by start and seed, and the base's tracking on the same episodes."""

    base: dict[str, float]  # by seed
    starts: dict[str, dict[str, Curve]]


class Numerics(msgspec.Struct):
    """The targets with changed weights, and the success on the kept clips."""

    before: dict[str, Compared]  # by target
    changes: dict[str, dict[str, Compared]]  # by change and target; `above` is less the same policy before
    kept: dict[str, Estimate]  # by change, success of the unlearned policy
    kept_before: Estimate


class Membership(msgspec.Struct):
    """The attack of `evaluation.membership` on one policy."""

    accuracy: float
    auc: float
    tpr_at_5_percent_fpr: float
    marked_at_5_percent_fpr: float


class EvidenceDocument(msgspec.Struct, kw_only=True, omit_defaults=True):
    """The whole of evidence.json; an attack that was not made is absent."""

    schema: int
    robot: str
    targets: list[str]
    method: str  # of unlearning
    control_method: str  # distill or retrain
    library_hash: str
    policy_hashes: dict[str, str]  # base, unlearned, control
    episodes: int  # a clip
    seeds: int  # trainings of each kind; with several the seed is the unit of their intervals
    made: Provenance
    originals: Originals
    near_duplicates: NearDuplicates | None = None
    splices: Splices | None = None
    look_alikes: LookAlikes | None = None
    recovery: Recovery | None = None
    relearning: Relearning | None = None
    held_out: Recovery | None = None
    numerics: Numerics | None = None
    membership: dict[str, Membership] | None = None
    safety: dict[str, UnboundedResult] | None = None  # by policy, on the targets


def read_evidence(path: Path) -> EvidenceDocument:
    """The evidence in a file.

    Raises:
        InputError: no such file, or a damaged or foreign one.
    """
    return read_document(path, SCHEMA, "evidence", lambda content: msgspec.convert(content, EvidenceDocument))


def write_document(path: Path, document: object) -> None:
    """Write a document, or an attack's part of one, to a file, which appears whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, msgspec.to_builtins(document), allow_nan=False)
