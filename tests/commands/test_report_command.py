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
from forgetmimic_jax.attacks.verdict import NOT_ATTACKED, RULES
from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.basics.provenance import provenance
from forgetmimic_jax.reporting import films
from forgetmimic_jax.reporting.facts import done
from forgetmimic_jax.reporting.subject import read_subject
from forgetmimic_jax.settings.config import load_config
from forgetmimic_jax.settings.options import override, parse
from forgetmimic_jax.training.checkpoint import policy_hash, read_info
from forgetmimic_jax.training.unlearning_run import config_of_new_run
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


def test_the_page_has_task_method_and_numbers(page, run, base_run):
    text = re.sub(r"\s+", " ", page)
    for said in (
        "is to forget turn and to keep the other 2 clips (nod, sway).",
        "arft: Anti-reward fine-tuning, the paper&#39;s method",
        "<th>Penalty</th><td>16</td>",
        "2 iterations, 192 environment steps, 8 environments",
        "<th>Base&#39;s training</th><td>128 environment steps</td>",
        "0 (unlearning), 0 (evaluation)",
        "3 episodes a clip with deterministic actions",
        policy_hash(read_info(run / "checkpoints" / "00000002")),
        policy_hash(read_info(base_run.checkpoint(4))),
        read_info(base_run.checkpoint(4)).library_hash,
        "Everything is simulation.",
        "Not tested: the attacks of `make evidence`, such as",
        f"Evaluation made with</th><td>code {provenance().commit}, jax ",
        "λ_crit = W (1 + R_reg / R_track)",
    ):
        assert said in text, said
    assert page.count("<svg") == 3
    film = base64.b64encode((run / "videos" / "turn.mp4").read_bytes()).decode()
    assert f'src="data:video/mp4;base64,{film}"' in page
    still = base64.b64decode(re.search(r'poster="data:image/jpeg;base64,([^"]+)"', page)[1])
    assert np.abs(np.asarray(Image.open(io.BytesIO(still)), int) - FILM[1]).max() < 8, "its middle"
    assert "certif" not in page.lower()


def test_the_page_says_what_the_robot_does_instead_or_nothing_for_an_older_evaluation(page, run, facts, tmp_path):
    document = json.loads((run / "evaluation.json").read_text())
    found = document["policies"]["unlearned"]["target"]["unbounded"]["all_starts"]
    assert found["upright_rate"]["n"] == 3
    upright = f"{100 * found['upright_rate']['mean']:.0f} %"
    assert f"With the unlearned policy the robot stands until the end in {upright} of the targets" in facts["instead"]
    (card,) = [card for card in facts["cards"] if card["what"] == "targets: upright at the end"]
    assert card["value"].endswith(f"→ {upright}")
    section = page[page.index("<h2>When its reference is a forgotten clip</h2>") :]
    assert section.index("Targets without terminations, all starts") < section.index("from frame 0")
    assert re.search(rf"<td>upright until the end</td><td>[^<]*</td><td>{upright[:-2]}\u00a0%", section)

    copy = Path(shutil.copytree(run, tmp_path / "run"))
    for policy in document["policies"].values():
        for group in (policy["target"], *policy["clips"].values()):
            group.pop("unbounded", None)
    (copy / "evaluation.json").write_text(json.dumps(document))
    finished(report.main, report.Options(run=copy, films=0, output=copy / "report.html"))
    assert "its reference is a forgotten clip" not in (copy / "report.html").read_text()
    older = json.loads((copy / "report.json").read_text())
    assert older["instead"] == ""
    assert "targets: upright at the end" not in [card["what"] for card in older["cards"]]


def test_a_threshold_that_was_not_measured_is_not_shown(run, tmp_path):
    copy = Path(shutil.copytree(run, tmp_path / "run"))
    rows = [json.loads(row) for row in (copy / "metrics.jsonl").read_text().splitlines()]
    first, *others = [{name: row[name] for name in row if name != "target/lambda_crit"} for row in rows]
    log = [first, *({**row, "target/lambda_crit": 7.5} for row in others)]
    shown = []
    for rows in (log, [first]):
        (copy / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
        finished(report.main, report.Options(run=copy, films=0, output=copy / "report.html"))
        facts = json.loads((copy / "report.json").read_text())
        cards = {card["what"]: card["value"] for card in facts["cards"]}
        shown.append((cards.get("λ_crit on the targets"), "7.5 on average" in facts["threshold"]))
    assert shown == [("7.5", True), (None, False)]
    assert facts["threshold"] == ""
    assert (copy / "report.html").read_text().count("<svg") == 3  # the curves are there, without it


def test_the_tables_are_those_of_the_evaluation(page, run):
    document = json.loads((run / "evaluation.json").read_text())
    mean = document["policies"]["unlearned"]["clips"]["turn"]["survival_weighted_tracking"]["mean"]
    assert re.search(rf'<tr class="target">\s*<td>turn</td><td>target</td>.*→ {mean:.3f}\u00a0\[', page)


def test_the_facts_lie_beside_it(facts, run):
    verdict = facts["verdict"]
    assert verdict["phrase"] in RULES
    assert verdict["phrase"] == "failed" or NOT_ATTACKED in verdict["reasons"]
    assert facts["rules"] == RULES
    assert facts["evaluation"] == json.loads((run / "evaluation.json").read_text())
    assert facts["done"]["Penalty"] == "16"
    assert facts["done"]["Sampler"] == "uniform clips, starts from all clips, 50% on the targets"
    assert facts["done"]["KL to the base"] == "weight 0.1, on kept clips; 6 times that while the run settles"


def test_a_method_with_a_weight_of_its_own_for_the_kept_clips_is_shown_with_it(run):
    subject = read_subject(run, None)
    stand = dataclasses.replace(subject.info.config.unlearn, method="stand", settings={"keep": 3.0}, stop_every=0)
    config = dataclasses.replace(subject.info.config, unlearn=stand)
    shown = done(dataclasses.replace(subject, info=dataclasses.replace(subject.info, config=config)))
    assert shown["KL to the base"] == "weight 3, on kept clips"


def test_the_command_that_reproduces_it_gives_the_runs_settings(facts, run):
    command, page = facts["commands"]
    words = command.split()
    assert words[:2] == ["forgetmimic", "unlearn"]
    options = parse(unlearn.Options, "unlearn", words[2:])
    config = override(config_of_new_run(options), [setting for group in options.set for setting in group])
    assert dataclasses.replace(config, iterations=options.iterations) == load_config(run / "config.yaml")
    assert page == f"forgetmimic report --run {run}"


def test_names_are_text_not_markup(run, tmp_path):
    copy = Path(shutil.copytree(run, tmp_path / "run"))
    text = (copy / "evaluation.json").read_text().replace('"nod"', '"<i>nod</i>"')
    (copy / "evaluation.json").write_text(text)
    finished(report.main, report.Options(run=copy, films=0, output=copy / "report.html"))
    page = (copy / "report.html").read_text()
    assert "&lt;i&gt;nod&lt;/i&gt;" in page
    assert "<i>" not in page
    Tags(page)


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
    monkeypatch.setattr(films, "FILM_SECONDS", 0.1)
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
    ("given", "message"),
    [
        ({"run": Path("nowhere")}, "nowhere: no such run folder"),
        ({"films": -1}, "--films: found -1; accepted: 0 or more"),
        ({"output": Path("report.pdf")}, "--output: found report.pdf; accepted: an .html file"),
        ({"output": Path(__file__) / "r.html"}, f"{__file__}: {__file__} is a file; choose another --output"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(refused, run, given, message):
    assert refused(report.main, report.Options(**{"run": run, "output": Path("r.html"), "films": 0} | given)) == message


def test_what_is_no_unlearning_run_is_refused(refused, base_run, run, tmp_path):
    message = refused(report.main, report.Options(run=base_run.folder))
    assert message.startswith(
        f"{base_run.folder}/evaluation.json: not found; make it first, with: make evaluate CHECKPOINT"
    )
    copy = Path(shutil.copytree(run, tmp_path / "run"))
    whole = json.loads((copy / "evaluation.json").read_text())

    def message_of(content: str) -> str:
        (copy / "evaluation.json").write_text(content)
        return refused(report.main, report.Options(run=copy)).removeprefix(f"{copy}/")

    assert message_of("{").startswith("evaluation.json: not an evaluation, or damaged: JSONDecodeError: ")
    base_only = whole | {"policies": {"base": whole["policies"]["base"]}, "targets": []}
    refusal = message_of(json.dumps(base_only))
    assert refusal.startswith("evaluation.json: found base and 0 targets; a report needs base, ")
    gone = whole | {"checkpoint": "runs/x/checkpoints/00000009"}
    assert message_of(json.dumps(gone)).startswith(
        f"checkpoints/00000009: not found, but {copy}/evaluation.json is its evaluation"
    )
    other_targets = whole | {"targets": ["nod"]}
    assert message_of(json.dumps(other_targets)) == (
        "evaluation.json: targets: found nod; accepted: those that the run unlearned, turn"
    )


def test_an_unlearned_policy_that_was_replaced_since_is_refused(refused, run, tmp_path):
    copy = Path(shutil.copytree(run, tmp_path / "run"))
    document = json.loads((copy / "evaluation.json").read_text())
    document["policy_hashes"]["unlearned"] = "0123456789abcdef"
    (copy / "evaluation.json").write_text(json.dumps(document))
    message = refused(report.main, report.Options(run=copy, films=0))
    assert message.startswith(f"{copy}/checkpoints/00000002: found the policy ")
    assert "is of the unlearned policy 0123456789abcdef" in message


def test_a_base_that_was_replaced_since_is_refused(refused, run, base_run, tmp_path):
    def message_of(base: Path) -> str:
        return refused(report.main, report.Options(run=run, base=base, films=0, output=tmp_path / "r.html"))

    other, evaluated = base_run.checkpoint(2), base_run.checkpoint(4)
    assert message_of(other) == (
        f"{other}: found the policy {policy_hash(read_info(other))}; {run}/evaluation.json is of the base policy "
        f"{policy_hash(read_info(evaluated))}; name that one, or evaluate again"
    )
    assert message_of(Path("nowhere")) == "nowhere: no such checkpoint folder"
