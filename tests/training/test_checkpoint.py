"""A checkpoint appears whole or not at all, goes back bit for bit, and says which part of it is not what was wanted."""

import dataclasses
import errno
import json
import resource
import shutil
from pathlib import Path

import jax
import numpy as np
import pytest
import yaml
from trees import assert_same

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.basics.provenance import provenance
from forgetmimic_jax.ppo.state import TrainState
from forgetmimic_jax.tracking.env import make_assets, make_environment
from forgetmimic_jax.tracking.rsi import Bins
from forgetmimic_jax.tracking.setup import Setup, make_setup
from forgetmimic_jax.training import checkpoint, start
from forgetmimic_jax.training.checkpoint import newest_checkpoint, read_info

STEPS = 96


@pytest.fixture(scope="module")
def setup(tiny_config, library_folder) -> Setup:
    return make_setup(dataclasses.replace(tiny_config, library=str(library_folder)))


@pytest.fixture(scope="module")
def template(setup) -> TrainState:
    return start.template(make_environment(setup, setup.config.ppo.num_envs), make_assets(setup))


@pytest.fixture(scope="module")
def state(template) -> TrainState:
    """A TrainState of the right shapes whose every leaf is its own noise."""
    random = np.random.default_rng(0)

    def noise(leaf: jax.ShapeDtypeStruct) -> np.ndarray:
        if leaf.dtype == bool:
            return random.random(leaf.shape) < 0.5
        return np.asarray(1000.0 * random.random(leaf.shape)).astype(leaf.dtype)

    return dataclasses.replace(jax.tree.map(noise, template), iteration=np.int32(7))


def save(path: Path, state: TrainState, setup: Setup) -> Path:
    checkpoint.save_checkpoint(path, setup, state, checkpoint.Progress(int(state.iteration), STEPS))
    return path


@pytest.fixture(scope="module")
def saved(tmp_path_factory, state, setup) -> Path:
    return save(tmp_path_factory.mktemp("run") / "checkpoints" / "00000007", state, setup)


@pytest.fixture
def copy(tmp_path, saved) -> Path:
    """A checkpoint that a test may damage."""
    return Path(shutil.copytree(saved, tmp_path / "copy"))


def test_every_leaf_comes_back_bit_for_bit(saved, state, template):
    assert_same(checkpoint.load_state(read_info(saved), template), state)


def test_the_note_says_what_it_belongs_to(saved, setup):
    info = read_info(saved)
    assert info.config == setup.config
    assert (info.robot, info.clips, info.iteration, info.environment_steps) == ("g1", ("sway", "turn", "nod"), 7, STEPS)
    assert info.joints == setup.robot.joint_names
    assert info.library_hash == setup.library_hash
    assert info.made == dataclasses.asdict(provenance())


def test_without_the_run_it_is_a_policy_that_cannot_be_resumed(tmp_path, state, setup, template):
    path, bins = tmp_path / "base", make_assets(setup).bins
    checkpoint.save_policy(path, setup, state.policy, state.failure_level, checkpoint.Progress(7, STEPS, base="abc"))
    assert read_info(path).base == "abc"
    assert_same(checkpoint.load_policy(read_info(path), setup.robot), state.policy)
    assert_same(checkpoint.load_failure_level(path, bins), state.failure_level)
    fewer = Bins(*(leaf[:, :1] for leaf in (bins.start, bins.end, bins.valid)))
    with pytest.raises(InputError, match=r"policy.safetensors: failure_level: found shape \[3, \d\]; \[3, 1\] is "):
        checkpoint.load_failure_level(path, fewer)
    with pytest.raises(InputError, match=r"no run/ to resume from; start a new run with --base"):
        checkpoint.load_state(read_info(path), template)


def test_a_save_replaces_the_one_before_and_leaves_nothing_else(tmp_path, state, setup, template):
    (tmp_path / ".00000003.tmp").mkdir()  # a run was killed while it saved
    for iteration in (1, 2):
        path = save(tmp_path / "1", dataclasses.replace(state, iteration=np.int32(iteration)), setup)
    assert [entry.name for entry in tmp_path.iterdir()] == ["1"]
    assert checkpoint.load_state(read_info(path), template).iteration == 2


# Orbax leaves a callback behind that finds its event loop closed.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_what_the_system_refuses_is_an_oserror_and_leaves_nothing(tmp_path, saved, state, setup):
    # A limit on the size of files is a refusal that needs no full disk and no privileges.
    unlimited = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2000, unlimited[1]))
    try:
        with pytest.raises(OSError, match=r"File too large: .*00000009") as refusal:
            save(tmp_path / "00000009", state, setup)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, unlimited)
    assert refusal.value.filename == str(tmp_path / "00000009")
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_is_refused_before_anything_is_written(tmp_path, state, setup, monkeypatch):
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _path: usage._replace(free=2**20))
    with pytest.raises(OSError, match=r"No space left on device: \d+ MiB are needed") as refusal:
        save(tmp_path / "00000009", state, setup)
    assert (refusal.value.errno, refusal.value.filename) == (errno.ENOSPC, str(tmp_path))
    assert list(tmp_path.iterdir()) == []


def test_a_failed_save_leaves_the_one_before(tmp_path, state, setup, template, monkeypatch):
    path = save(tmp_path / "1", state, setup)
    monkeypatch.setattr(checkpoint, "save_config", lambda *_: (_ for _ in ()).throw(OSError(28, "No space left")))
    with pytest.raises(OSError, match="No space left"):
        save(path, dataclasses.replace(state, iteration=np.int32(8)), setup)
    assert [entry.name for entry in tmp_path.iterdir()] == ["1"]
    assert_same(checkpoint.load_state(read_info(path), template), state)


@pytest.mark.parametrize(("part", "files"), [("policy.safetensors", 1), ("run/**/*", 4)])
def test_every_missing_or_damaged_file_is_named(saved, tmp_path, template, part, files):
    names = sorted(file.relative_to(saved) for file in saved.glob(part) if file.is_file())
    assert len(names) >= files
    for name in names:
        copy = Path(shutil.copytree(saved, tmp_path / "copy"))
        whole = (copy / name).read_bytes()
        (copy / name).write_bytes(whole[: len(whole) // 2] + (b"" if whole else b"x"))
        with pytest.raises(InputError, match=rf"^{copy / name}: damaged: not what was saved; "):
            checkpoint.load_state(read_info(copy), template)
        (copy / name).unlink()
        with pytest.raises(InputError, match=rf"^{copy / name}: missing; "):
            checkpoint.load_state(read_info(copy), template)
        shutil.rmtree(copy)


def edit_note(path: Path, **changes) -> None:
    note = json.loads((path / "meta.json").read_text())
    (path / "meta.json").write_text(json.dumps(note | changes))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "damaged: "),
        ("[]", "damaged: "),
        ("{}", "damaged: no schema"),
        ('{"schema": 3}', "damaged: no robot"),
        ('{"schema": 2}', "schema: found 2; this version reads 3"),
        ('{"schema": 3, "robot": "g1", "joints": 3}', "damaged: "),
        ('{"schema": 3, "robot": "g1", "joints": [], "clips": [], "library_hash": "", "iteration": "x"}', "damaged: "),
    ],
)
def test_a_damaged_note_is_refused(copy, content, message):
    (copy / "meta.json").write_text(content)
    with pytest.raises(InputError, match=rf"copy/meta.json: {message}"):
        read_info(copy)


def test_what_is_no_checkpoint_is_refused(tmp_path, saved):
    with pytest.raises(InputError, match="nothing: no such checkpoint folder"):
        read_info(tmp_path / "nothing")
    with pytest.raises(InputError, match=r"neither a checkpoint nor a run: no meta.json$"):
        read_info(tmp_path)


def test_a_runs_folder_stands_for_its_best_policy_else_its_newest_and_a_librarys_for_its_base(saved, tmp_path):
    for name in ("checkpoints/00000002", "checkpoints/00000010", "base"):
        shutil.copytree(saved, tmp_path / name)
    assert read_info(tmp_path).path == tmp_path / "checkpoints/00000010"
    shutil.copytree(saved, tmp_path / "best")
    assert read_info(tmp_path).path == tmp_path / "best"
    shutil.copytree(saved, tmp_path / "library" / "base")
    assert read_info(tmp_path / "library").path == tmp_path / "library" / "base"


def test_an_unknown_setting_is_refused_with_its_file(copy):
    settings = yaml.safe_load((copy / "config.yaml").read_text())
    settings["ppo"]["learning_rat"] = settings["ppo"].pop("learning_rate")
    (copy / "config.yaml").write_text(yaml.safe_dump(settings))
    with pytest.raises(InputError, match=r"config.yaml: no setting 'ppo.learning_rat'; did you mean 'learning_rate'\?"):
        read_info(copy)


def matches(path: Path, setup: Setup, **options) -> None:
    checkpoint.check_matches(read_info(path), setup, **options)


def test_another_robot_or_other_joints_are_refused(copy, setup):
    matches(copy, setup)
    edit_note(copy, robot="h2")
    with pytest.raises(InputError, match=r"copy: robot: the checkpoint's is 'h2' \(\d+ joints\), this run's 'g1'"):
        matches(copy, setup)
    edit_note(copy, robot="g1", joints=list(setup.robot.joint_names[:-1]))
    with pytest.raises(InputError, match="robot: "):
        matches(copy, setup)


def test_another_library_is_refused_clip_by_clip_and_can_be_allowed(copy, setup):
    edit_note(copy, clips=["sway", "turn", "walk"])
    with pytest.raises(InputError, match=r"library: .*\(missing here: walk; new here: nod\)"):
        matches(copy, setup)
    matches(copy, setup, other_library=True)
    edit_note(copy, clips=["sway", "turn", "nod"], library_hash="0" * 16)
    with pytest.raises(InputError, match=rf"hash is {'0' * 16}, this library's {setup.library_hash} \(same clip names"):
        matches(copy, setup)


@pytest.mark.parametrize("name", ["actor_layers", "critic_layers"])
def test_another_network_is_refused(saved, setup, name):
    ppo = dataclasses.replace(setup.config.ppo, **{name: (8, 8)})
    other = dataclasses.replace(setup, config=dataclasses.replace(setup.config, ppo=ppo))
    with pytest.raises(InputError, match=rf"ppo.{name}: the checkpoint's is \[16.*\], this run's \[8, 8\]"):
        matches(saved, other)


def test_other_environments_matter_to_a_resumed_run_only(saved, setup):
    ppo = dataclasses.replace(setup.config.ppo, num_envs=16)
    other = dataclasses.replace(setup, config=dataclasses.replace(setup.config, ppo=ppo))
    matches(saved, other)
    with pytest.raises(InputError, match=r"ppo.num_envs: the checkpoint's is 8, this run's 16"):
        matches(saved, other, resume=True)


@pytest.mark.parametrize(
    ("layers", "message"),
    [
        ([8, 16], r"actor/params/MLP_0/Dense_0/bias: found shape \[16\]; \[8\] is needed"),
        ([16, 16, 16], r"actor/params/MLP_0/Dense_2/bias: found shape \[29\]; \[16\] is needed"),
    ],
)
def test_a_network_of_another_size_cannot_slip_through(copy, robot, layers, message):
    # A config.yaml that was edited disagrees with the arrays.
    settings = yaml.safe_load((copy / "config.yaml").read_text())
    settings["ppo"]["actor_layers"] = layers
    (copy / "config.yaml").write_text(yaml.safe_dump(settings))
    with pytest.raises(InputError, match=rf"copy/policy.safetensors: {message}"):
        checkpoint.load_policy(read_info(copy), robot)


def other_layout(copy: Path, layout: str) -> None:
    """The checkpoint's config names another layout than the one that it was trained with, wbc132."""
    settings = yaml.safe_load((copy / "config.yaml").read_text())
    settings["observation"]["layout"] = layout
    (copy / "config.yaml").write_text(yaml.safe_dump(settings))


def test_a_network_of_another_layout_is_refused(copy, robot):
    other_layout(copy, "mjlab154")
    message = r"actor: found 132 observations; 154 are needed, with layout mjlab154 of 'g1'"
    with pytest.raises(InputError, match=rf"copy/policy.safetensors: {message}$"):
        checkpoint.load_policy(read_info(copy), robot)


def test_a_critic_of_another_size_is_refused(copy, robot):
    """Such as of a version that showed the critic other kernels: the layers of the network say nothing of it."""
    fewer = dataclasses.replace(robot, key_bodies=robot.key_bodies[:-1])
    message = r"critic: found 624 observations; 591 are needed, with layout wbc132 of 'g1'"
    with pytest.raises(InputError, match=rf"copy/policy.safetensors: {message}$"):
        checkpoint.load_policy(read_info(copy), fewer)


def test_a_checkpoint_of_another_layout_does_not_match(copy, setup):
    other_layout(copy, "root132")  # of the same size, which only the name distinguishes
    message = r"copy: observation.layout: the checkpoint's is root132, this run's wbc132"
    with pytest.raises(InputError, match=rf"{message}$"):
        checkpoint.check_matches(read_info(copy), setup)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mode": "offset"}, "action.mode: the checkpoint's is residual, this run's offset"),
        (
            {"default_pose": {"left_knee_joint": 0.3}},
            "action.default_pose.left_knee_joint: the checkpoint's is the robot's own, this run's 0.3",
        ),
        ({"stiffness": {"left_knee_joint": 80.0}}, "action.stiffness.left_knee_joint: the checkpoint's is the robot's"),
        ({"joint_order": ("a", "b")}, "action.joint_order: the checkpoint's is [], this run's ['a', 'b']"),
    ],
)
def test_a_checkpoint_whose_actions_mean_something_else_does_not_match(saved, setup, change, message):
    action = dataclasses.replace(setup.config.action, **change)
    other = dataclasses.replace(setup, config=dataclasses.replace(setup.config, action=action))
    with pytest.raises(InputError) as error:
        checkpoint.check_matches(read_info(saved), other)
    assert str(error.value).removeprefix(f"{saved}: ").startswith(message)


def test_another_robots_actions_may_differ_in_all_but_their_mode(saved, setup):
    def check(**change) -> None:
        action = dataclasses.replace(setup.config.action, **change)
        other = dataclasses.replace(setup, config=dataclasses.replace(setup.config, action=action))
        checkpoint.check_matches(read_info(saved), other, other_robot=True)

    check(default_pose={"left_knee_joint": 0.3}, joint_order=("a", "b"))
    with pytest.raises(InputError, match=r"action.mode: "):
        check(mode="offset")


def test_the_newest_is_the_highest_whole_one(tmp_path, saved):
    assert newest_checkpoint(tmp_path) is None
    for name in ("00000009", "00000100", "00000200 (copy)", "best", ".00000300.tmp", "00000400"):
        shutil.copytree(saved, tmp_path / "checkpoints" / name)
    (tmp_path / "checkpoints" / "00000400" / "meta.json").unlink()
    assert newest_checkpoint(tmp_path) == tmp_path / "checkpoints" / "00000100"
