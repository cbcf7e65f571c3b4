"""The page itself: figures as SVG and the template filled in."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup

from forgetmimic_jax.attacks.verdict import Verdict
from forgetmimic_jax.evaluation import plots, tables
from forgetmimic_jax.reporting.facts import listed
from forgetmimic_jax.reporting.subject import Subject


def page(subject: Subject, verdict: Verdict, facts: Mapping[str, Any], films: tuple[list[dict[str, str]], str]) -> str:
    """The HTML file, which needs no other.

    Args:
        subject: the run.
        verdict: on it.
        facts: of `reporting.facts` by the template's names.
        films: of `reporting.films`.
    """
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent), autoescape=True, undefined=jinja2.StrictUndefined
    )
    # Only figures are let through as they are: matplotlib escapes the names in them.
    figures = {name: Markup(svg) for name, svg in _figures(subject).items()}
    return environment.get_template("report.html").render(
        **facts,
        title=f"Unlearning {listed(subject.document.targets)}: {subject.document.robot}",
        verdict=verdict,
        zero_action=subject.document.zero_action,
        tables=tables.result_tables(subject.document),
        unbounded_tables=tables.unbounded_tables(subject.document),
        figures=figures,
        films=films[0],
        films_missing=films[1],
    )


def _figures(subject: Subject) -> dict[str, str]:
    rows, config = subject.rows, subject.info.config
    figures = {"bars": _svg(plots.clip_bars, subject.document), "curves": "", "sampling": ""}
    if rows:
        penalty = config.unlearn.settings.get("penalty")
        figures |= {
            "curves": _svg(plots.unlearning_curves, rows, penalty=penalty),
            "sampling": _svg(plots.sampling_shares, rows, targets=subject.document.targets),
        }
    return figures


def _svg(draw: Callable[..., None], *arguments: Any, **settings: Any) -> str:
    """What a function of `plots` draws, as an SVG element."""
    buffer = io.StringIO()
    draw(*arguments, buffer, **settings)
    text = buffer.getvalue()
    return text[text.index("<svg") :]
