import json
import re
from pathlib import Path

import pytest
from miniature import TINY, finished

from forgetmimic_jax import bench
from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.ppo import update
from forgetmimic_jax.settings import config
from forgetmimic_jax.settings.options import override
from forgetmimic_jax.training import run, speed


@pytest.fixture
def tiny(monkeypatch):
    preset = config.preset
    monkeypatch.setattr(config, "preset", lambda name: override(preset(name), TINY))
    monkeypatch.setattr(speed, "make_iteration", run.make_iteration)  # which other tests have compiled


def test_every_part_of_an_iteration_is_timed(tiny, tmp_path, library_folder):
    output = tmp_path / "new" / "figures.json"
    printed = finished(bench.main, bench.Options(library=library_folder, repeats=1, output=output)).printed
    assert "g1, preset cpu, native engine" in printed
    figures = json.loads(output.read_text())
    assert (figures["engine"], figures["environments"]) == ("native", 8)
    assert figures["raw_control_steps_per_second"] > figures["iteration_control_steps_per_second"] > 0.0
    assert len(figures["made"]["code"]) == 8
    shares = [figures[name] for name in figures if name.startswith("share_")]
    assert sum(shares) == pytest.approx(1.0)


def test_memory_is_computed_without_a_simulation(tiny, monkeypatch, tmp_path, library_folder):
    monkeypatch.setattr(speed, "make_iteration", update.make_iteration)  # a compiled one has no program to look at
    output = tmp_path / "figures.json"
    finished(bench.main, bench.Options(library=library_folder, dry=True, output=output))
    figures = json.loads(output.read_text())
    # The rollout alone: 4 steps of 8 environments with two observations of 132 and more than 600 numbers.
    assert figures["temporary_gib"] * 2**30 > 4 * 8 * (132 + 600) * 4
    assert figures["together_gib"] > figures["arguments_gib"] > figures["state_gib"] > 0.0


@pytest.mark.parametrize(
    ("preset", "physics", "engine"), [("cpu", None, "native"), ("paper", None, "mjx"), ("paper", "native", "native")]
)
def test_the_memory_of_the_preset_of_a_gpu_is_that_of_its_engine(
    tiny, monkeypatch, library_folder, preset, physics, engine
):
    monkeypatch.setattr(speed, "memory", lambda setup: {"engine": setup.config.physics.engine})
    options = bench.Options(library=library_folder, dry=True, preset=preset, physics=physics)
    printed = finished(bench.main, options).printed
    assert re.search(rf"engine │ +{engine} │", printed)
    assert ("--physics: mjx, the engine of this preset on a GPU" in printed) == (engine == "mjx")


def test_a_comparison_is_the_ratio_of_medians_over_processes_in_turn(monkeypatch):
    turns = iter([2.0, 8.0, 4.0, 8.0])
    roots, worktrees = [], []

    def figures_of(root, output, options):
        roots.append(root.name)
        return {"iteration_over_raw": next(turns), "cores": 2, "engine": "native"}

    monkeypatch.setattr(bench, "_figures_of", figures_of)
    monkeypatch.setattr(bench, "_git", lambda checkout, arguments, commit: worktrees.append(arguments[1]))
    found = bench.compared("abc", bench.Options())
    assert found["over"] == {"iteration_over_raw": pytest.approx(3.0 / 8.0)}
    assert [name == "other" for name in roots] == [False, True, False, True]
    assert worktrees == ["add", "remove"]


def test_an_unknown_commit_is_named(refused):
    assert refused(bench.main, bench.Options(against="nonsense")).startswith(
        "--against: found nonsense; accepted: a commit of the checkout ("
    )


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"repeats": 0}, "--repeats: found 0; accepted: 1 or more"),
        (
            {"against": "HEAD", "dry": True},
            "--dry: does not go with --against, which measures the default settings",
        ),
        (
            {"against": "HEAD", "devices": "2"},
            "--devices: does not go with --against, which measures the default settings",
        ),
        ({"dry": True, "devices": "2"}, "--dry: does not go with --devices"),
        ({"devices": "1,0"}, "--devices: found 1,0; accepted: numbers from 1 on, such as 1,2,4"),
        ({"robot": "gg1"}, "robot 'gg1': no robots/gg1/gg1.yaml; did you mean 'g1'?"),
        ({"library": Path("nowhere")}, "nowhere/manifest.json: not found; a library is a folder with manifest.json"),
        ({"output": Path(__file__) / "figures.json"}, f"{__file__}: {__file__} is a file; choose another --output"),
        ({"output": Path(__file__).parent}, f"{Path(__file__).parent}: a folder; --output is a file"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(refused, given, message):
    assert refused(bench.main, bench.Options(**given)) == message


def test_the_growth_over_devices_is_measured_and_past_the_cores_computed(monkeypatch, tmp_path):
    calls = []

    def figures_of(root, output, options, more, use):
        devices = int(more[more.index("--devices") + 1])
        calls.append((devices, use))
        if devices > 2:
            raise InputError("its bench ended with exit code 2: error: --devices: found 4; accepted: 1 to 2")
        seconds = {1: (8.0, 0.0), 2: (5.0, 0.5)}[devices]
        names = ("iteration_seconds", "averaging_seconds")
        return {"devices": devices, "cores": use, "control_steps": 100, **dict(zip(names, seconds, strict=True))}

    monkeypatch.setattr(bench, "_figures_of", figures_of)
    monkeypatch.setattr(bench, "cores", lambda: 3)
    output = tmp_path / "growth.json"
    printed = finished(bench.main, bench.Options(devices="4,1,2", output=output)).printed
    rows = json.loads(output.read_text())["growth"]
    assert calls == [(1, 1), (2, 2), (4, 3)]  # a core for each device, as many as there are
    assert [row["measured"] for row in rows] == [True, True, False]
    assert rows[2]["iteration_seconds"] == pytest.approx(8.0 / 4 + 0.5)
    assert [row["over_first"] for row in rows] == pytest.approx([1.0, 8.0 / 5.0, 8.0 / 2.5])
    assert "computed" in printed


def test_one_device_has_nothing_to_average(tiny, tmp_path, library_folder):
    output = tmp_path / "figures.json"
    finished(bench.main, bench.Options(library=library_folder, repeats=2, devices="1", output=output))
    row = json.loads(output.read_text())
    assert (row["devices"], row["environments"], row["control_steps"]) == (1, 8, 8 * 4)
    assert row["iteration_seconds"] > 100 * row["averaging_seconds"]


def test_the_first_number_of_devices_must_be_measured(monkeypatch, refused):
    def figures_of(*_):
        raise InputError("its bench ended: error: --devices: found 2; accepted: 1")

    monkeypatch.setattr(bench, "_figures_of", figures_of)
    assert (
        refused(bench.main, bench.Options(devices="2,4")) == "its bench ended: error: --devices: found 2; accepted: 1"
    )
