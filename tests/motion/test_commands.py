"""`python -m forgetmimic_jax.motions` in this process: what it writes, what it prints, how it ends."""

import pickle
import shutil

import numpy as np
import pytest
from motion_cases import waving
from PIL import Image

from forgetmimic_jax import motions
from forgetmimic_jax.basics.errors import InputError, run_command
from forgetmimic_jax.motion import importing, library
from forgetmimic_jax.settings.options import parse


@pytest.fixture
def run(monkeypatch, capsys, tmp_path):
    """run(arguments) -> (exit code, standard output, standard error), in an empty working directory."""
    monkeypatch.chdir(tmp_path)

    def call(*arguments):
        monkeypatch.setattr("sys.argv", ["motions", *map(str, arguments)])
        code = 0
        try:
            run_command(lambda: motions.main(parse(motions.Options, "motions")))
        except SystemExit as ending:
            code = ending.code
        shown = capsys.readouterr()
        return code, shown.out, shown.err

    return call


@pytest.fixture
def motion_file(robot, tmp_path):
    """A GMR pickle of 61 frames at 30 Hz: 2 s."""
    clip = waving(robot, "wave", 61, fps=30.0)
    content = {
        "fps": 30,
        "root_pos": clip.root_pos,
        "root_rot": np.roll(clip.root_quat, -1, axis=-1),
        "dof_pos": clip.joint_pos,
    }
    path = tmp_path / "wave.pkl"
    path.write_bytes(pickle.dumps(content))
    return path


def test_import_makes_a_library_that_loads(run, robot, motion_file):
    code, out, _ = run("--robot", "g1", "import", motion_file, "--name", "first", "--library", "mine")
    assert code == 0
    assert "mine" in out
    assert "Next: make pretrain ROBOT=g1 LIBRARY=mine" in out
    loaded = library.load_library(robot, motion_file.parent / "mine")
    assert loaded.names == ("first",)
    assert loaded.length.tolist() == [101]  # 2 s at 50 Hz, both ends
    entry = library.read_manifest(motion_file.parent / "mine")["clips"]["first"]
    assert (entry["source"], entry["source_fps"], entry["licence"]) == ("wave.pkl", 30.0, "unknown")

    code, _, err = run("import", motion_file, "--name", "first", "--library", "mine")
    assert code == 2
    assert "--force" in err
    assert run("import", motion_file, "--name", "first", "--library", "mine", "--force", "--end", "1.0")[0] == 0
    assert run("import", motion_file, "--name", "second", "--library", "mine")[0] == 0
    loaded = library.load_library(robot, motion_file.parent / "mine")
    assert loaded.length.tolist() == [51, 101]


def test_a_refused_import_writes_nothing(run, motion_file):
    motion_file.write_bytes(b"no pickle")
    code, out, err = run("import", motion_file, "--library", "mine")
    assert (code, out) == (2, "")
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    assert not (motion_file.parent / "mine").exists()
    assert not (motion_file.parent / "runs").exists()


def test_nothing_is_written_where_a_later_check_fails(run, motion_file, monkeypatch):
    def fails(*_):
        raise InputError("a shape that cannot be measured")

    monkeypatch.setattr(importing, "measure", fails)
    code, _, err = run("import", motion_file, "--library", "mine")
    assert (code, err) == (2, "error: a shape that cannot be measured\n")
    assert not (motion_file.parent / "mine").exists()


def test_a_name_that_is_taken_is_refused_before_the_file_is_read(run, motion_file):
    assert run("import", motion_file, "--library", "mine")[0] == 0
    motion_file.write_bytes(b"no pickle")
    assert "already has a clip 'wave'" in run("import", motion_file, "--library", "mine")[2]


def test_a_name_from_the_file_is_cleaned_and_one_that_is_given_is_not(run, motion_file):
    file = motion_file.rename(motion_file.with_name("Wave 1.2 (slow).pkl"))
    assert run("import", file, "--library", "mine")[0] == 0
    assert (file.parent / "mine" / "Wave_1_2_slow.npz").is_file()
    code, _, err = run("import", file, "--name", "Wave 1.2", "--library", "mine")
    assert (code, "found 'Wave 1.2'; letters, digits" in err) == (2, True)


def test_check_passes_the_shipped_library_and_draws_it(run, tmp_path):
    code, out, _ = run("--robot", "g1", "check", "--draw", "sheet.png")
    assert code == 0
    assert "cartwheel" in out
    assert Image.open(tmp_path / "sheet.png").height > 12 * 100
    assert "Next: " in out


def test_check_ends_with_2_where_a_clip_fails(run, robot, tmp_path):
    clip = waving(robot, "sunk", 60)
    clip.root_pos[:, 2] -= 0.3
    library.add_clip(tmp_path / "bad", robot, clip, {})
    code, out, err = run("check", "--library", "bad")
    assert code == 2
    assert "under the floor" in out
    assert "1 of 1 clips are no motion of g1: sunk" in err


def test_show_and_list(run, robot, tmp_path):
    library.add_clip(tmp_path / "mine", robot, waving(robot, "sway", 60), {"source": "invented", "licence": "CC0"})
    code, out, _ = run("show", "sway", "--library", "mine")
    assert code == 0
    assert "CC0" in out
    assert "Next: make pretrain ROBOT=g1 LIBRARY=mine" in out
    assert (tmp_path / "runs" / "sway.png").is_file()
    assert "Next: make unlearn ROBOT=g1 TARGETS=kick" in run("show", "kick")[1]
    code, out, _ = run("list", "--library", "mine")
    assert code == 0
    assert "sway     1.20 s  invented" in out
    code, _, err = run("show", "swey", "--library", "mine")
    assert code == 2
    assert "did you mean 'sway'" in err


def test_retarget_spares_what_is_there(run, tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "letter.txt").write_text("dear")
    code, _, err = run("retarget", "--source", "nowhere", "--output", "mine")
    assert code == 2
    assert "letter" not in err
    assert "mine" in err
    shutil.copytree(library.DATA_DIR / "g1", tmp_path / "copy")
    code, _, err = run("retarget", "--source", "nowhere", "--output", "copy")
    assert (code, "--force" in err) == (2, True)


def test_the_robot_is_named_before_or_after_the_command(run):
    for arguments in (("--robot", "g7", "list"), ("list", "--robot", "g7")):
        code, _, err = run(*arguments)
        assert (code, "robot 'g7'" in err) == (2, True)


@pytest.mark.parametrize("command", [(), ("import",), ("retarget",), ("check",), ("show",), ("list",)])
def test_help_lists_every_flag_and_its_default(run, command):
    code, out, _ = run("--robot", "g1", *command, "--help")
    assert code == 0
    assert out.count("--") > 1
    assert "(default:" in out or "(required)" in out
