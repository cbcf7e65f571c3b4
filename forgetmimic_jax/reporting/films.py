"""The page's films: those that the run has, and new ones of the clips that it lacks."""

from __future__ import annotations

import base64

from forgetmimic_jax.basics.console import progress
from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.evaluation.metrics import BASE
from forgetmimic_jax.reporting.facts import listed
from forgetmimic_jax.reporting.subject import Subject
from forgetmimic_jax.training.comparison import load_comparison
from forgetmimic_jax.viewing import film, offscreen
from forgetmimic_jax.viewing.takes import record

FILM_SECONDS = 4.0


def films(subject: Subject, count: int) -> tuple[list[dict[str, str]], str]:
    """Films and their stills as base64 with captions; and why there are none or fewer, or nothing.

    Args:
        subject: the run.
        count: of clips: the targets, then those that the base does best.
    """
    targets = subject.document.targets
    chosen = _chosen(subject, count)
    files = {clip: subject.run / "videos" / f"{clip}.mp4" for clip in chosen}
    contents = {clip: path.read_bytes() for clip, path in files.items() if path.is_file()}
    needed = [clip for clip in chosen if clip not in contents]
    missing = ""
    if needed:
        try:
            offscreen.check_rendering()
        except InputError as error:
            missing = f"No films of {listed(needed)}: {error}."
        else:
            contents |= _filmed(subject, needed)
    shown = [
        {
            "mp4": base64.b64encode(contents[clip]).decode(),
            "poster": base64.b64encode(film.poster(contents[clip])).decode(),
            "caption": f"{clip} ({'to be forgotten' if clip in targets else 'to be kept'})",
        }
        for clip in chosen
        if clip in contents
    ]
    return shown, missing


def _chosen(subject: Subject, count: int) -> list[str]:
    clips = subject.document.policies[BASE].clips

    def order(name: str) -> tuple[bool, float]:
        return not clips[name].target, -(clips[name].survival_weighted_tracking.mean or 0.0)

    return sorted(clips, key=order)[:count]


def _filmed(subject: Subject, clips: list[str]) -> dict[str, bytes]:
    """MP4 of clips, base and unlearned policy side by side."""
    contents = {}
    compared = load_comparison(subject.info.path, robot=subject.info.robot, base=subject.base.path, physics="native")
    episodes = record(compared.setup, compared.policies, clips, subject.document.targets)
    with film.pane_renderer(subject.info.robot) as renderer, progress("film", len(clips)) as show:
        for finished, episode in enumerate(episodes, start=1):
            contents[episode.clip] = film.mp4(film.render_clip(renderer, episode, seconds=FILM_SECONDS))
            show(finished, 0, {})
    return contents
