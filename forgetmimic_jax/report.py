"""Write one HTML page about an unlearning run: `forgetmimic report --run runs/unlearn-g1-001`."""

from __future__ import annotations

import base64
import importlib
import io
import json
import platform
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from forgetmimic_jax.basics.errors import InputError, run_command
from forgetmimic_jax.settings.options import at_least, parse

if TYPE_CHECKING:
    from forgetmimic_jax.evaluation.relearning import Lasted
    from forgetmimic_jax.settings.config import Config
    from forgetmimic_jax.training.checkpoint import CheckpointInfo


@dataclass
class Options:
    """Tell of an unlearning run on one self-contained HTML page, with the same facts as JSON beside it.

    Every number comes from the run's own files; the verdict is one of four phrases, whose rules the page states.
    """

    run: Path
    """Folder of the run, with its evaluation.json."""
    base: Path | None = None
    """Checkpoint that the run started from; the one its settings name by default."""
    control: Path | None = None
    """Run of `make unlearn METHOD=distill` (or retrain) with the same targets and evaluation, to compare with."""
    relearning: Path | None = None
    """JSON of experiments/relearning.py with the same targets: how fast unlearned policy and control relearn them."""
    films: int = 4
    """Clips to film for at most 4 s: the targets, then those the base does best; one in the run's videos/ is taken."""
    output: Path | None = None
    """HTML file to write, with a .json beside it; report.html in the run by default."""


FILM_SECONDS = 4.0
RELEARNED = 0.8  # of the base's tracking on the targets
PACKAGES = ("forgetmimic-jax", "jax", "mujoco", "numpy", "flax", "optax")


def main(options: Options) -> None:
    """Gather, judge, draw and write."""
    import jinja2
    from markupsafe import Markup
    from rich.console import Console

    from forgetmimic_jax.basics.console import closing, command_line
    from forgetmimic_jax.basics.files import read_rows, write_atomically
    from forgetmimic_jax.evaluation import plots, tables
    from forgetmimic_jax.evaluation.verdict import NO_CONTROL, NO_RELEARNING, RULES, judge
    from forgetmimic_jax.training import checkpoint
    from forgetmimic_jax.training.folder import check_writable

    at_least(0, "--films", options.films)
    output = options.output or options.run / "report.html"
    if output.suffix != ".html":
        raise InputError(f"{output}: --output is an .html file")
    document = read_evaluation(options.run)
    path = _checkpoint(options.run, document)
    check_writable(output.parent)
    info = checkpoint.read_info(path)
    base = _base(options, document, info)
    control = NO_CONTROL if options.control is None else _control(options.control, document)
    relearning = NO_RELEARNING if options.relearning is None else _relearning(options.relearning, document)
    verdict = judge(document["policies"], control=control, relearning=relearning)
    rows = [row for row in read_rows(options.run / "metrics.jsonl") if "target/lambda_crit" in row]
    films, films_missing = _films(options, document, info, base)

    facts = {
        "verdict": {"phrase": verdict.phrase, "reasons": list(verdict.reasons), "rules": RULES},
        "asked": _asked(document),
        "done": _done(document, info, base, rows),
        "cards": _cards(document, rows),
        "threshold": _threshold(info.config, rows),
        "notes": tables.notes(document),
        "limits": _limits(document, options),
        "commands": _commands(options, document, info),
        "identity": _identity(document, info, base),
    }
    figures = {"bars": _svg(plots.clip_bars, document), "curves": "", "sampling": ""}
    if rows:
        penalty = info.config.unlearn.penalty if info.config.unlearn.method == "arft" else None
        figures |= {
            "curves": _svg(plots.unlearning_curves, rows, penalty=penalty),
            "sampling": _svg(plots.sampling_shares, rows, targets=document["targets"]),
        }
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent), autoescape=True, undefined=jinja2.StrictUndefined
    )
    # Only figures are let through as they are: matplotlib escapes the names in them.
    page = environment.get_template("report.html").render(
        **{name: value for name, value in facts.items() if name != "verdict"},
        title=f"Unlearning {_list(document['targets'])}: {document['robot']}",
        verdict=verdict,
        rules=RULES,
        tables=tables.result_tables(document),
        figures={name: Markup(svg) for name, svg in figures.items()},
        films=films,
        films_missing=films_missing,
    )
    output.parent.mkdir(parents=True, exist_ok=True)
    as_json = output.with_suffix(".json")
    write_atomically(as_json, (json.dumps(facts | {"evaluation": document}, indent=2) + "\n").encode())
    write_atomically(output, page.encode())
    console = Console()
    console.print(f"{verdict.phrase}: {' '.join(verdict.reasons)}", highlight=False, soft_wrap=True)
    if films_missing:
        console.print(films_missing, highlight=False, soft_wrap=True)
    closing({"report": output, "facts": as_json}, command_line("export", robot=document["robot"], checkpoint=path))


def read_evaluation(run: Path) -> dict[str, Any]:
    """The evaluation.json of a run that unlearned.

    Raises:
        InputError: no such run, or an evaluation that is damaged or of something else.
    """
    from forgetmimic_jax.basics.console import command_line
    from forgetmimic_jax.evaluation.metrics import BASE, UNLEARNED, ZERO_ACTION

    path = run / "evaluation.json"
    if not run.is_dir():
        raise InputError(f"{run}: no such run folder")
    try:
        document = json.loads(path.read_text())
        present = set(document["policies"])
        targets = list(document["targets"])
    except FileNotFoundError:
        first = command_line("evaluate", checkpoint=f"{run}/checkpoints/...")
        raise InputError(f"{path}: not found; make it first, with: {first}") from None
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: damaged: {type(error).__name__}: {error}") from None
    missing = [policy for policy in (BASE, UNLEARNED, ZERO_ACTION) if policy not in present]
    if missing or not targets:
        raise InputError(
            f"{path}: found {', '.join(sorted(present))} and {len(targets)} targets; a report needs base, unlearned, "
            f"zero_action and a target"
        )
    return document


def _checkpoint(run: Path, document: Mapping[str, Any]) -> Path:
    """The checkpoint that was evaluated, wherever the run's folder has gone since."""
    path = run / "checkpoints" / Path(document["checkpoint"]).name
    if not path.is_dir():
        raise InputError(f"{path}: evaluation.json is of this checkpoint, which is gone; evaluate one that is there")
    return path


def _base(options: Options, document: Mapping[str, Any], info: CheckpointInfo) -> CheckpointInfo:
    """The base that was evaluated; a shipped one may have been replaced since."""
    from forgetmimic_jax.training import checkpoint
    from forgetmimic_jax.training.start import base_checkpoint

    base = checkpoint.read_info(options.base or base_checkpoint(info.config))
    evaluated = document.get("budget", {}).get("base", {}).get("environment_steps", base.environment_steps)
    if evaluated != base.environment_steps:
        raise InputError(
            f"{base.path}: trained for {base.environment_steps:,} environment steps; the base that was evaluated for "
            f"{evaluated:,}; name it with --base"
        )
    return base


def _control(run: Path, document: Mapping[str, Any]) -> dict[str, Any]:
    """The policy of another run that never lived the targets, measured on the same episodes."""
    from forgetmimic_jax.settings.config import load_config
    from forgetmimic_jax.unlearning.registry import method_of

    path = run / "evaluation.json"
    method = method_of(load_config(run / "config.yaml"))
    if method.start == "base":
        raise InputError(f"{run}/config.yaml: unlearn.method: a control starts afresh, by distill or retrain")
    try:
        other = json.loads(path.read_text())
        policy = other["policies"][method.result]
    except FileNotFoundError:
        raise InputError(f"{path}: not found") from None
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: no evaluation of a control: {type(error).__name__}: {error}") from None
    for field in ("robot", "library_hash", "targets", "seed", "episodes"):
        if other.get(field) != document[field]:
            raise InputError(f"{path}: {field}: found {other.get(field)}; the unlearned run's is {document[field]}")
    return policy


def _relearning(path: Path, document: Mapping[str, Any]) -> dict[str, tuple[Lasted, Lasted]]:
    """How long unlearned policy and control took until 80 % of the base's tracking, by the seeds that both have."""
    from forgetmimic_jax.evaluation.relearning import lasted

    try:
        study = json.loads(path.read_text())
        asked, results = study["asked"], study["results"]
        control = "distilled" if "distilled" in results["starts"] else "retrained"
        unlearned, theirs = (lasted(results, start, RELEARNED) for start in ("unlearned", control))
        found = {seed: (run, theirs[seed]) for seed, run in unlearned.items() if seed in theirs}
    except FileNotFoundError:
        raise InputError(f"{path}: not found") from None
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: no relearning study: {type(error).__name__}: {error}") from None
    for field, here in (("library", document["library_hash"]), ("targets", document["targets"])):
        if asked.get(field) != here:
            raise InputError(f"{path}: {field}: found {asked.get(field)}; the unlearned run's is {here}")
    return found


def _asked(document: Mapping[str, Any]) -> str:
    clips = document["policies"]["base"]["clips"]
    kept = [clip for clip in clips if clip not in document["targets"]]
    return (
        f"Asked: a motion-tracking policy of the {document['robot']} is to forget {_list(document['targets'])} and to "
        f"keep the other {len(kept)} clips ({', '.join(kept)})."
    )


def _done(
    document: Mapping[str, Any], info: CheckpointInfo, base: CheckpointInfo, rows: Sequence[Mapping[str, Any]]
) -> dict[str, str]:
    from forgetmimic_jax import unlearning
    from forgetmimic_jax.unlearning.registry import find_method

    config = info.config
    method = config.unlearn.method
    find_method(method)
    module = importlib.import_module(f"{unlearning.__name__}.{method}")
    done = {"Method": f"{method}: {str(module.__doc__).splitlines()[0]}"}
    if method == "arft":
        done["Penalty λ"] = f"{config.unlearn.penalty:g}"
    budget = document.get("budget", {})
    steps = budget.get("unlearned", {}).get("environment_steps", info.environment_steps)
    done |= {
        "Budget": f"{info.iteration:,} iterations, {steps:,.0f} environment steps, {config.ppo.num_envs} environments",
        "Base's training": f"{base.environment_steps:,} environment steps"
        if base.environment_steps
        else "unknown: an imported policy",
        "Sampler": f"{config.sampling.rule.replace('_', ' ')}, from {config.sampling.clips} clips",
        "Assistive wrench": f"up to {config.wrench.max_gain:g}" if config.wrench.max_gain else "off",
        "Weights in PPO's losses": "every clip the same" if config.ppo.equal_clips else "every step the same",
        "Anchor": f"{config.ppo.anchor:g} of the divergence from the base, on kept clips"
        if rows and "anchor_kl" in rows[-1]  # some methods' losses have none
        else "off",
        "Step size": f"{config.ppo.learning_rate:g}, {config.ppo.schedule}",
        "Seeds": f"{config.seed} (unlearning), {document['seed']} (evaluation)",
        "Evaluation": f"{document['episodes']} episodes a clip with deterministic actions, no assistance, no "
        f"randomisation, and the same starts for every policy",
    }
    return done


def _cards(document: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]) -> list[dict[str, str]]:
    from forgetmimic_jax.evaluation.tables import number, percent

    base, unlearned, floor = (document["policies"][name] for name in ("base", "unlearned", "zero_action"))

    def change(what: str, group: str, metric: str, show: Callable[..., str]) -> dict[str, str]:
        before, after, without = (show(policy[group][metric], 2, False) for policy in (base, unlearned, floor))
        return {"what": what, "value": f"{before} → {after}", "more": f"without a policy {without}"}

    cards = [
        change("targets: success", "target", "success_rate", percent),
        change("targets: tracking", "target", "survival_weighted_tracking", number),
        change("kept clips: success", "kept", "success_rate", percent),
        change("kept clips: tracking", "kept", "survival_weighted_tracking", number),
    ]
    if rows:
        cards.append(
            {"what": "λ_crit on the targets", "value": f"{_mean_lambda_crit(rows):.1f}", "more": "mean over training"}
        )
    return cards


def _threshold(config: Config, rows: Sequence[Mapping[str, Any]]) -> str:
    if not rows:
        return ""
    found = _mean_lambda_crit(rows)
    text = (
        f"λ_crit = W (1 + R_reg / R_track) is the penalty above which a mean step on a target clip costs more than it "
        f"brings; on the targets it was {found:.1f} on average."
    )
    if config.unlearn.method != "arft":
        return text
    side = "above" if config.unlearn.penalty > found else "not above"
    return f"{text} The λ of this run, {config.unlearn.penalty:g}, lies {side} it."


def _mean_lambda_crit(rows: Sequence[Mapping[str, Any]]) -> float:
    return sum(row["target/lambda_crit"] for row in rows) / len(rows)


def _limits(document: Mapping[str, Any], options: Options) -> list[str]:
    from forgetmimic_jax.evaluation.tables import percent

    success = document["policies"]["base"]["target"]["success_rate"]
    limits = [
        "Everything is simulation. Nothing here was run on a robot.",
        "Unlearning is approximate: that the policy no longer performs a clip does not prove that no trace of it is "
        "left in the weights.",
        "One training seed. The intervals say how well this checkpoint was measured, not what another training would "
        "give.",
        "Not tested: pushes, sensor noise, other floors, clips outside the library, and whether one can tell from the "
        "policy that the targets were once in its library (membership inference).",
    ]
    if options.control is None:
        limits.append("Not tested: whether it behaves like a policy that never lived the targets.")
    if options.relearning is None:
        limits.append("Not tested: how fast fine-tuning would bring the targets back.")
    else:
        limits.append("Relearning was measured on the study's own unlearned policies, not on this one.")
    if success["mean"] < 0.5:
        limits.append(
            f"The base itself reaches the targets' end in only {percent(success, interval=False)} of the episodes: "
            f"what was forgotten is a beginner's skill."
        )
    return limits


def _commands(options: Options, document: Mapping[str, Any], info: CheckpointInfo) -> list[str]:
    """What makes the run, and this page, again."""
    from forgetmimic_jax import unlearn
    from forgetmimic_jax.settings.config import to_dict

    config = info.config
    flags: dict[str, Any] = {
        "robot": config.robot,
        "targets": ",".join(config.unlearn.targets),
        "method": config.unlearn.method,
        "penalty": config.unlearn.penalty,
        "iterations": config.iterations,
        "seed": config.seed,
        "base": options.base or (None if config.base is None else Path(config.base)),
        "episodes": document["episodes"],
        "library": None if config.library is None else Path(config.library),
    }
    asked = unlearn.Options(**flags)
    plain = dict(_settings(to_dict(unlearn.config_of_new_run(asked))))
    changed = [
        f"{name}={json.dumps(value, separators=(',', ':')) if isinstance(value, list) else value}"
        for name, value in _settings(to_dict(config))
        if plain[name] != value and name not in ("iterations", "base")
    ]
    words = [f"--{flag} {value:g}" if flag == "penalty" else f"--{flag} {value}"
             for flag, value in flags.items() if value is not None]  # fmt: skip
    if changed:
        words.append(f"--set {' '.join(changed)}")
    page = [f"--run {options.run}"]
    page += [f"--{name} {value}" for name in ("base", "control", "relearning") if (value := getattr(options, name))]
    return [
        f".venv/bin/python -m forgetmimic_jax.unlearn {' '.join(words)} --output {options.run}",
        f".venv/bin/python -m forgetmimic_jax.report {' '.join(page)}",
    ]


def _settings(content: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Every setting of a nested dict by its dotted name."""
    for name, value in content.items():
        if isinstance(value, dict):
            yield from _settings(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def _identity(document: Mapping[str, Any], info: CheckpointInfo, base: CheckpointInfo) -> dict[str, str]:
    """Which files and programs these are."""
    from importlib.metadata import version

    from forgetmimic_jax.training.checkpoint import policy_hash

    programs = ", ".join(f"{package} {version(package)}" for package in PACKAGES)
    return {
        "Base policy": policy_hash(base),
        "Unlearned policy": policy_hash(info),
        "Clip library": document["library_hash"],
        "Settings": document["config_hash"],
        "Report made with": f"Python {platform.python_version()}, {programs}",
    }


def _films(
    options: Options, document: Mapping[str, Any], info: CheckpointInfo, base: CheckpointInfo
) -> tuple[list[dict[str, str]], str]:
    """Films and their posters as base64 with captions, and why there are none or fewer."""
    from forgetmimic_jax.basics.console import progress
    from forgetmimic_jax.training.comparison import load_comparison
    from forgetmimic_jax.viewing import film
    from forgetmimic_jax.viewing.offscreen import check_rendering
    from forgetmimic_jax.viewing.side_by_side import record

    clips = document["policies"]["base"]["clips"]
    best = sorted(
        clips, key=lambda clip: (not clips[clip]["target"], -clips[clip]["survival_weighted_tracking"]["mean"])
    )
    chosen = best[: options.films]
    there = {clip: options.run / "videos" / f"{clip}.mp4" for clip in chosen}
    contents = {clip: path.read_bytes() for clip, path in there.items() if path.is_file()}
    needed = [clip for clip in chosen if clip not in contents]
    missing = ""
    if needed:
        try:
            check_rendering()
        except InputError as error:
            missing = f"No films of {_list(needed)}: {error}."
        else:
            compared = load_comparison(info.path, robot=info.robot, base=base.path, physics="native")
            setup = compared.setup
            episodes = record(setup, compared.policies, needed)
            with film.pane_renderer(info.robot) as renderer, progress("film", len(needed)) as report:
                for done, episode in enumerate(episodes, start=1):
                    target = episode.clip in document["targets"]
                    frames = film.render_clip(renderer, episode, target=target, seconds=FILM_SECONDS)
                    contents[episode.clip] = film.mp4(frames)
                    report(done, 0, {})
    roles = {clip: "to be forgotten" if clip in document["targets"] else "to be kept" for clip in chosen}
    films = [
        {
            "mp4": base64.b64encode(contents[clip]).decode(),
            "poster": base64.b64encode(film.poster(contents[clip])).decode(),
            "caption": f"{clip} ({roles[clip]})",
        }
        for clip in chosen
        if clip in contents
    ]
    return films, missing


def _svg(draw: Callable[..., None], *arguments: Any, **settings: Any) -> str:
    """What a function of `plots` draws, as an SVG element."""
    buffer = io.StringIO()
    draw(*arguments, buffer, **settings)
    text = buffer.getvalue()
    return text[text.index("<svg") :]


def _list(names: Sequence[str]) -> str:
    """'a', 'a and b', 'a, b and c'."""
    *most, last = names
    return f"{', '.join(most)} and {last}" if most else last


if __name__ == "__main__":
    run_command(lambda: main(parse(Options, "report")))
