import json
from pathlib import Path

import pytest
from miniature import TINY, finished

from forgetmimic_jax import bench
from forgetmimic_jax.ppo import update
from forgetmimic_jax.settings import config
from forgetmimic_jax.settings.options import override
from forgetmimic_jax.training import run


@pytest.fixture
def tiny(monkeypatch):
    preset = config.preset
    monkeypatch.setattr(config, "preset", lambda name: override(preset(name), TINY))
    monkeypatch.setattr(update, "make_iteration", run.make_iteration)  # which other tests have compiled


def test_every_part_of_an_iteration_is_timed(tiny, tmp_path, library_folder):
    output = tmp_path / "new" / "figures.json"
    printed = finished(bench.main, bench.Options(library=library_folder, repeats=1, output=output)).printed
    assert "g1, preset cpu, native engine" in printed
    figures = json.loads(output.read_text())
    assert (figures["engine"], figures["environments"]) == ("native", 8)
    assert figures["raw_control_steps_per_second"] > figures["iteration_control_steps_per_second"] > 0.0
    shares = [figures[name] for name in figures if name.startswith("share_")]
    assert sum(shares) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"repeats": 0}, "--repeats: found 0; accepted: 1 or more"),
        ({"robot": "gg1"}, "robot 'gg1': no robots/gg1/gg1.yaml; did you mean 'g1'?"),
        ({"library": Path("nowhere")}, "nowhere/manifest.json: not found; a library is a folder with manifest.json"),
        ({"output": Path(__file__) / "figures.json"}, f"{__file__}: {__file__} is a file; choose another --output"),
        ({"output": Path(__file__).parent}, f"{Path(__file__).parent}: a folder; --output is a file"),
    ],
)
def test_what_cannot_be_is_told_in_one_line(refused, given, message):
    assert refused(bench.main, bench.Options(**given)) == message
