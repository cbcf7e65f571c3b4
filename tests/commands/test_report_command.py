import base64
import dataclasses
import io
import json
import re
import shutil
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from miniature import finished
from PIL import Image

from forgetmimic_jax import report, unlearn
from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.evaluation.verdict import RULES
from forgetmimic_jax.settings.config import load_config
from forgetmimic_jax.settings.options import override, parse
from forgetmimic_jax.training.checkpoint import policy_hash, read_info
from forgetmimic_jax.viewing import film, offscreen

FILM = [np.full((48, 64, 3), grey, np.uint8) for grey in (0, 128, 255)]


@pytest.fixture(scope="module")
def run(unlearned_run, tmp_path_factory) -> Path:
    """The miniature run with a film of one clip, as `make video` leaves it."""
    folder = Path(shutil.copytree(unlearned_run.folder, tmp_path_factory.mktemp("reported") / "run"))
    (folder / "videos").mkdir()
    (folder / "videos" / "turn.mp4").write_bytes(film.mp4(FILM))
    return folder


@pytest.fixture(scope="module")
def page(run) -> str:
    finished(report.main, report.Options(run=run, films=1, output=run / "report.html"))
    return (run / "report.html").read_text()


@pytest.fixture(scope="module")
def facts(run, page) -> dict:
    return json.loads((run / "report.json").read_text())


class Tags(HTMLParser):
    """Every tag with its attributes; unbalanced ones are found."""

    def __init__(self, page: str):
        super().__init__()
        self.open, self.attributes = [], []
        self.feed(page)
        assert not self.open

    def handle_starttag(self, tag, attributes):
        self.attributes += [(tag, *attribute) for attribute in attributes]
        if tag not in ("meta", "br", "img", "link", "input"):
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.attributes += [(tag, *attribute) for attribute in attributes]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_the_page_is_whole_and_needs_nothing_else(page):
    tags = Tags(page)
    links = [value for _, name, value in tags.attributes if name in ("src", "href", "xlink:href")]
    assert links
    assert all(link.startswith(("data:", "#")) for link in links)
    assert not re.search(r"url\((?!#)|@import|<script", page)
    assert 'name="viewport"' in page
    assert "@media print" in page


def test_the_page_tells_what_was_asked_done_and_found(page, run, base_run):
    text = re.sub(r"\s+", " ", page)
    for said in (
        "is to forget turn and to keep the other 2 clips (nod, sway).",
        "arft: Anti-reward fine-tuning, the paper&#39;s method",
        "<th>Penalty λ</th><td>16</td>",
        "2 iterations, 192 environment steps, 8 environments",
        "<th>Base&#39;s training</th><td>128 environment steps</td>",
        "0 (unlearning), 0 (evaluation)",
        "3 episodes a clip with deterministic actions",
        "Clip by clip"[:4],
        policy_hash(read_info(run / "checkpoints" / "00000002")),
        policy_hash(read_info(base_run.checkpoint(4))),
        read_info(base_run.checkpoint(4)).library_hash,
        "Everything is simulation.",
        "Not tested: how fast fine-tuning would bring the targets back.",
        "λ_crit = W (1 + R_reg / R_track)",
    ):
        assert said in text, said
    assert page.count("<svg") == 3
    film = base64.b64encode((run / "videos" / "turn.mp4").read_bytes()).decode()
    assert f'src="data:video/mp4;base64,{film}"' in page
    still = base64.b64decode(re.search(r'poster="data:image/jpeg;base64,([^"]+)"', page)[1])
    assert np.abs(np.asarray(Image.open(io.BytesIO(still)), int) - FILM[1]).max() < 8, "its middle"
    assert "certif" not in page.lower()


def test_the_tables_are_those_of_the_evaluation(page, run):
    document = json.loads((run / "evaluation.json").read_text())
    mean = document["policies"]["unlearned"]["clips"]["turn"]["survival_weighted_tracking"]["mean"]
    assert re.search(rf'<tr class="target">\s*<td>turn</td><td>target</td>.*→ {mean:.3f}\u00a0\[', page)


def test_the_facts_lie_beside_it(facts, run):
    assert facts["verdict"]["phrase"] in RULES
    assert facts["verdict"]["rules"] == RULES
    assert facts["evaluation"] == json.loads((run / "evaluation.json").read_text())
    assert facts["done"]["Penalty λ"] == "16"
    assert facts["done"]["Anchor"] == "0.1 of the divergence from the base, on kept clips"


def test_the_command_that_reproduces_it_gives_the_runs_settings(facts, run):
    command, page = facts["commands"]
    words = command.split()
    assert words[:3] == [".venv/bin/python", "-m", "forgetmimic_jax.unlearn"]
    options = parse(unlearn.Options, "unlearn", words[3:])
    config = override(unlearn.config_of_new_run(options), [setting for group in options.set for setting in group])
    assert dataclasses.replace(config, iterations=options.iterations) == load_config(run / "config.yaml")
    assert page == f".venv/bin/python -m forgetmimic_jax.report --run {run}"


def test_names_are_text_not_markup(run, tmp_path):
    copy = Path(shutil.copytree(run, tmp_path / "run"))
    text = (copy / "evaluation.json").read_text().replace('"turn"', '"<i>turn</i>"')
    (copy / "evaluation.json").write_text(text)
    finished(report.main, report.Options(run=copy, films=0, output=copy / "report.html"))
    page = (copy / "report.html").read_text()
    assert "&lt;i&gt;turn&lt;/i&gt;" in page
    assert "<i>" not in page
    Tags(page)


def test_comparisons_enter_the_verdict(run, tmp_path):
    """Made by hand: the base has skill, the unlearned policy none of it, and it relearns fast."""
    copy = Path(shutil.copytree(run, tmp_path / "run"))
    document = json.loads((copy / "evaluation.json").read_text())
    for group, mean in (("target", 0.0), ("kept", 1.0)):
        skill = {"mean": mean, "low": mean - 0.1, "high": mean + 0.1, "std": 0.1, "n": 3}
        for clip in document["policies"]["unlearned"]["clips"].values():
            if clip["target"] == (group == "target"):
                clip["skill"] = skill
    tracking = {"mean": 0.15, "low": 0.12, "high": 0.18, "std": 0.1, "n": 3}
    document["policies"]["unlearned"]["target"]["survival_weighted_tracking"] = tracking
    (copy / "evaluation.json").write_text(json.dumps(document))
    control = tmp_path / "control"
    control.mkdir()
    (control / "config.yaml").write_text((run / "config.yaml").read_text().replace("method: arft", "method: retrain"))
    policies = {"retrained": document["policies"]["unlearned"]}
    (control / "evaluation.json").write_text(json.dumps(document | {"policies": policies}))
    counts = tmp_path / "relearning.json"
    asked = {"library": document["library_hash"], "targets": document["targets"]}

    def curve(steps: int) -> dict:
        reached = {"iterations": [0, 1, 2, 3], "target_steps": [0, steps / 2, steps, 2 * steps]}
        return reached | {"tracking": [0.1, 0.39, 0.4, 0.5]}

    def word(unlearned: int) -> str:
        # The base tracks at 0.5, so 0.4 is relearned; the retrained policy is there after 1000 steps on the targets.
        starts = {"unlearned": {"0": curve(unlearned), "1": curve(unlearned)}, "retrained": {"0": curve(1000)}}
        counts.write_text(json.dumps({"asked": asked, "results": {"base": {"0": 0.5, "1": 0.5}, "starts": starts}}))
        options = report.Options(run=copy, control=control, relearning=counts, films=0, output=tmp_path / "r.html")
        printed = finished(report.main, options).printed
        facts = json.loads((tmp_path / "r.json").read_text())
        assert printed.startswith(f"{facts['verdict']['phrase']}: ")
        assert not any("never lived" in limit or "bring the" in limit for limit in facts["limits"])
        assert "Relearning was measured on the study's own unlearned policies, not on this one." in facts["limits"]
        assert facts["commands"][1].endswith(f"--control {control} --relearning {counts}")
        return facts["verdict"]["phrase"]

    assert word(900) == "consistent with retraining"
    assert word(100) == "suppressed but recoverable"


def test_where_nothing_can_be_drawn_the_page_says_so(run, tmp_path, monkeypatch):
    def cannot():
        raise InputError("rendering: cannot draw here")

    monkeypatch.setattr(offscreen, "check_rendering", cannot)
    output = tmp_path / "report.html"
    printed = finished(report.main, report.Options(run=run, films=2, output=output)).printed
    assert re.search(r"No films of (nod|sway): rendering: cannot draw here\.", output.read_text())
    assert "No films of " in printed
    assert "data:video/mp4" in output.read_text()  # the film that was there


def test_clips_without_a_film_are_filmed(run, tmp_path, monkeypatch):
    try:
        offscreen.check_rendering()
    except InputError as error:
        pytest.skip(str(error))
    monkeypatch.setattr(film, "PANE", (96, 96))
    monkeypatch.setattr(report, "FILM_SECONDS", 0.1)
    output = tmp_path / "report.html"
    finished(report.main, report.Options(run=run, films=2, output=output))
    assert output.read_text().count("data:video/mp4;base64,") == 2


def test_without_a_training_log_there_are_no_curves(run, tmp_path):
    copy = Path(shutil.copytree(run, tmp_path / "run"))
    (copy / "metrics.jsonl").unlink()
    finished(report.main, report.Options(run=copy, films=0, output=copy / "report.html"))
    page = (copy / "report.html").read_text()
    assert page.count("<svg") == 1
    assert "While it was unlearning" not in page


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"run": Path("nowhere")}, "nowhere: no such run folder"),
        ({"films": -1}, "--films: found -1; accepted: 0 or more"),
        ({"output": Path("report.pdf")}, "report.pdf: --output is an .html file"),
        ({"output": Path(__file__) / "r.html"}, f"{__file__}: {__file__} is a file; choose another --output"),
        ({"control": Path("nowhere")}, "nowhere/config.yaml: no such config"),
        ({"relearning": Path("nowhere.json")}, "nowhere.json: not found"),
    ],
)
def test_what_cannot_be_is_told_in_one_line(refused, run, given, told):
    assert refused(report.main, report.Options(**{"run": run, "output": Path("r.html"), "films": 0} | given)) == told


def test_what_is_no_unlearning_run_is_told(refused, base_run, run, tmp_path):
    told = refused(report.main, report.Options(run=base_run.folder))
    assert told.startswith(
        f"{base_run.folder}/evaluation.json: not found; make it first, with: make evaluate CHECKPOINT"
    )
    copy = Path(shutil.copytree(run, tmp_path / "run"))
    whole = json.loads((copy / "evaluation.json").read_text())

    def told_of(content: str) -> str:
        (copy / "evaluation.json").write_text(content)
        return refused(report.main, report.Options(run=copy)).removeprefix(f"{copy}/")

    assert told_of("{").startswith("evaluation.json: damaged: JSONDecodeError: ")
    assert told_of("{}") == "evaluation.json: damaged: KeyError: 'policies'"
    base_only = whole | {"policies": {"base": whole["policies"]["base"]}, "targets": []}
    assert told_of(json.dumps(base_only)).startswith("evaluation.json: found base and 0 targets; a report needs base, ")
    gone = whole | {"checkpoint": "runs/x/checkpoints/00000009"}
    assert told_of(json.dumps(gone)).startswith(
        "checkpoints/00000009: evaluation.json is of this checkpoint, which is g"
    )


def test_a_base_that_was_replaced_since_is_told(refused, run, base_run, tmp_path):
    def told_of(base: Path) -> str:
        return refused(report.main, report.Options(run=run, base=base, films=0, output=tmp_path / "r.html"))

    other = base_run.checkpoint(2)
    assert told_of(other) == (
        f"{other}: trained for 64 environment steps; the base that was evaluated for 128; name it with --base"
    )
    assert told_of(Path("nowhere")) == "nowhere: no such checkpoint folder"


def test_comparisons_that_do_not_fit_are_told(refused, run, tmp_path):
    other = tmp_path / "other"
    other.mkdir()
    document = json.loads((run / "evaluation.json").read_text())
    refusal = f"{run}/config.yaml: unlearn.method: a control starts afresh, by distill or retrain"
    assert refused(report.main, report.Options(run=run, control=run, output=tmp_path / "r.html")) == refusal
    (other / "config.yaml").write_text((run / "config.yaml").read_text().replace("method: arft", "method: retrain"))

    def told_of(content: dict) -> str:
        (other / "evaluation.json").write_text(json.dumps(content))
        options = report.Options(run=run, control=other, films=0, output=tmp_path / "r.html")
        return refused(report.main, options).removeprefix(f"{other}/evaluation.json: ")

    assert told_of(document) == "no evaluation of a control: KeyError: 'retrained'"
    fits = document | {"policies": {"retrained": document["policies"]["unlearned"]}}
    assert told_of(fits | {"episodes": 50}) == "episodes: found 50; the unlearned run's is 3"
    assert told_of(fits | {"library_hash": "x"}).startswith("library_hash: found x; the unlearned run's is ")

    counts = tmp_path / "relearning.json"

    def told_of_counts(content: str) -> str:
        counts.write_text(content)
        return refused(report.main, report.Options(run=run, relearning=counts, films=0)).removeprefix(f"{counts}: ")

    assert told_of_counts("[]").startswith("no relearning study: TypeError: ")
    asked = {"library": document["library_hash"], "targets": document["targets"]}
    starts = {"unlearned": {}, "retrained": {}}
    results = {"base": {}, "starts": starts}
    only = {"asked": asked, "results": {"base": {}, "starts": {"unlearned": {}}}}
    assert told_of_counts(json.dumps(only)) == "no relearning study: KeyError: 'retrained'"
    other_targets = {"asked": asked | {"targets": ["nod"]}, "results": results}
    assert told_of_counts(json.dumps(other_targets)) == "targets: found ['nod']; the unlearned run's is ['turn']"


def test_relearning_is_compared_by_the_seeds_that_both_have(run, tmp_path):
    def curve(tracking: float, steps: float) -> dict:
        return {"tracking": [tracking] * 2, "target_steps": [steps, 99.0], "iterations": [1, 2]}

    curves = {"0": curve(0.5, 10.0), "1": curve(0.3, 10.0)}
    document = json.loads((run / "evaluation.json").read_text())
    asked = {"library": document["library_hash"], "targets": document["targets"]}
    results = {"base": {"0": 0.5, "1": 0.5}, "starts": {"unlearned": curves, "retrained": {"0": curves["0"]}}}
    path = tmp_path / "relearning.json"
    path.write_text(json.dumps({"asked": asked, "results": results}))
    assert report._relearning(path, document) == {"0": ((1, 10.0, True), (1, 10.0, True))}
    # The distilled control is as able as the base, so fairer.
    results["starts"]["distilled"] = {"0": curve(0.5, 7.0), "1": curve(0.5, 8.0)}
    path.write_text(json.dumps({"asked": asked, "results": results}))
    assert report._relearning(path, document) == {
        "0": ((1, 10.0, True), (1, 7.0, True)),
        "1": ((2, 99.0, False), (1, 8.0, True)),
    }
