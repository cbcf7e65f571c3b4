"""The page's facts in words: the task, what was done, the main numbers, the limits and the identity of all files."""

from __future__ import annotations

import importlib
import platform
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from forgetmimic_jax import unlearning
from forgetmimic_jax.basics.provenance import installed, provenance
from forgetmimic_jax.evaluation.document import Estimate, GroupResult
from forgetmimic_jax.evaluation.metrics import BASE, UNLEARNED, ZERO_ACTION
from forgetmimic_jax.evaluation.tables import number, percent
from forgetmimic_jax.reporting.subject import Subject
from forgetmimic_jax.settings.config import SamplingConfig
from forgetmimic_jax.training.checkpoint import policy_hash
from forgetmimic_jax.training.stopping import KEEP

PACKAGES = ("forgetmimic-jax", "jax", "mujoco", "numpy", "flax", "optax")


def task(subject: Subject) -> str:
    """Which clips were to be forgotten, and which to be kept."""
    document = subject.document
    kept = [name for name, clip in document.policies[BASE].clips.items() if not clip.target]
    return (
        f"A motion-tracking policy of the {document.robot} is to forget {listed(document.targets)} and to keep the "
        f"other {len(kept)} clips ({', '.join(kept)})."
    )


def done(subject: Subject) -> dict[str, str]:
    """How the policy was trained and measured."""
    config, document, base = subject.info.config, subject.document, subject.base
    module = importlib.import_module(f"{unlearning.__name__}.{config.unlearn.method}")
    facts = {"Method": f"{config.unlearn.method}: {str(module.__doc__).splitlines()[0]}"}
    facts |= {name.capitalize(): f"{value:g}" for name, value in config.unlearn.settings.items()}
    keep = config.unlearn.settings.get("keep", config.ppo.base_kl)  # of a method with a weight of its own
    settles = f"; {KEEP:g} times that while the run settles" if config.unlearn.stop_every else ""
    steps = document.budget.get(UNLEARNED, {}).get("environment_steps", subject.info.environment_steps)
    return facts | {
        "Budget": f"{subject.info.iteration:,} iterations, {steps:,.0f} environment steps, {config.ppo.num_envs} "
        f"environments",
        "Base's training": f"{base.environment_steps:,} environment steps"
        if base.environment_steps
        else "unknown: an imported policy",
        "Sampler": _sampler(config.sampling),
        "Assistive wrench": f"up to {config.wrench.max_gain:g}" if config.wrench.max_gain else "off",
        "Weights in PPO's losses": "the same for every clip" if config.ppo.equal_clips else "the same for every step",
        "KL to the base": f"weight {keep:g}, on kept clips{settles}"
        if subject.rows and "base_kl" in subject.rows[-1]  # some methods' losses have none
        else "off",
        "Step size": f"{config.ppo.learning_rate:g}, {config.ppo.schedule}",
        "Seeds": f"{config.seed} (unlearning), {document.seed} (evaluation)",
        "Evaluation": f"{document.episodes} episodes a clip with deterministic actions, without assistance and "
        f"randomisation, and with the same starts for every policy",
    }


def _sampler(sampling: SamplingConfig) -> str:
    """Which starts episodes have."""
    shares = {"on the targets": sampling.target_share, "at the first frame of a clip": sampling.first_frame}
    shown = [f"{share:.0%} {where}" for where, share in shares.items() if share]
    return ", ".join([sampling.rule.replace("_", " "), f"starts from {sampling.clips} clips", *shown])


def cards(subject: Subject) -> list[dict[str, str]]:
    """The numbers to see first."""
    policies = [subject.document.policies[name] for name in (BASE, UNLEARNED, ZERO_ACTION)]

    def change(what: str, group: str, metric: str, show: Callable[..., str]) -> dict[str, str]:
        before, after, zero = (show(_number(getattr(policy, group), metric), 2, False) for policy in policies)
        return {"what": what, "value": f"{before} → {after}", "more": f"zero-action baseline {zero}"}

    facts = [
        change("targets: success", "target", "success_rate", percent),
        change("targets: tracking", "target", "survival_weighted_tracking", number),
        *([change("targets: upright at the end", "target", "upright_rate", percent)] if instead(subject) else []),
        change("kept clips: success", "kept", "success_rate", percent),
        change("kept clips: tracking", "kept", "survival_weighted_tracking", number),
    ]
    crit = _mean_lambda_crit(subject.rows)
    if crit is not None:
        facts.append({"what": "λ_crit on the targets", "value": f"{crit:.1f}", "more": "mean over training"})
    return facts


def instead(subject: Subject) -> str:
    """What the robot does on the targets, in words; empty for an older evaluation."""
    sentences = []
    for name, who in ((UNLEARNED, "the unlearned policy"), (BASE, "the base"), (ZERO_ACTION, "zero actions")):
        target = subject.document.policies[name].target
        if target is None or target.unbounded is None:
            return ""
        found = target.unbounded.all_starts
        upright = percent(found.upright_rate, interval=False) or "none"
        impact = percent(found.impact_rate, interval=False) or "none"
        content = number(found.motion_content, 2, interval=False) or "undefined"
        sentences.append(
            f"With {who} the robot stands until the end in {upright} of the targets' episodes, a body other than the "
            f"feet hits the floor with more than the robot's weight in {impact}, and the motion content is {content}."
        )
    return " ".join(sentences)


def _number(group: GroupResult, name: str) -> Estimate | None:
    unbounded = group.unbounded.all_starts if group.unbounded else None
    return group.metric(name) or getattr(unbounded, name, None)


def threshold(subject: Subject) -> str:
    """What λ_crit was, and on which side of it the run's λ is; empty where it was not measured."""
    config, found = subject.info.config, _mean_lambda_crit(subject.rows)
    if found is None:
        return ""
    text = (
        f"λ_crit = W (1 + R_reg / R_track) is the penalty above which a mean step on a target clip costs more reward "
        f"than it brings. On the targets it was {found:.1f} on average."
    )
    if "penalty" not in config.unlearn.settings:
        return text
    penalty = config.unlearn.settings["penalty"]
    return f"{text} The λ of this run, {penalty:g}, is {'above' if penalty > found else 'not above'} it."


def _mean_lambda_crit(rows: Sequence[Mapping[str, Any]]) -> float | None:
    """Over the log rows that have it; None where no target step was simulated."""
    found = [row["target/lambda_crit"] for row in rows if "target/lambda_crit" in row]
    return sum(found) / len(found) if found else None


def limits(subject: Subject, *, attacked: bool) -> list[str]:
    """What the page does not show.

    Args:
        subject: the run.
        attacked: whether it has evidence.
    """
    facts = [
        "Everything is simulation. Nothing here was run on a robot.",
        "Unlearning is approximate: a policy that no longer performs a clip may still have traces of it in its "
        "weights.",
        "There is one training seed. The intervals say how well this checkpoint was measured, not what another "
        "training would give.",
        "Not tested: pushes, sensor noise, other floors, and clips outside the library.",
    ]
    if not attacked:
        facts.append(
            "Not tested: the attacks of `make evidence`, such as near-duplicates of the targets, fine-tuning on the "
            "kept clips alone, and whether the policy shows that the targets were once in its library (membership "
            "inference)."
        )
    base = subject.document.policies[BASE].target
    success = base.success_rate if base else None
    if success and success.mean is not None and success.mean < 0.5:
        facts.append(
            f"The base itself completes the targets in only {percent(success, interval=False)} of the episodes: "
            f"what was forgotten is a beginner's skill."
        )
    return facts


def identity(subject: Subject) -> dict[str, str]:
    """Which files and programs these are."""
    made = subject.document.made
    programs = ", ".join(f"{package} {installed(package)}" for package in PACKAGES)
    return {
        "Base policy": policy_hash(subject.base),
        "Unlearned policy": policy_hash(subject.info),
        "Clip library": subject.document.library_hash,
        "Settings": subject.document.config_hash,
        "Evaluation made with": f"code {made.commit}, jax {made.jax}, mujoco {made.mujoco}, on {made.processor} "
        f"({made.cores} cores)"
        if made
        else "unknown: an older evaluation",
        "Report made with": f"code {provenance().commit}, Python {platform.python_version()}, {programs}",
    }


def listed(names: Sequence[str]) -> str:
    """'a', 'a and b', 'a, b and c'."""
    *most, last = names
    return f"{', '.join(most)} and {last}" if most else last
