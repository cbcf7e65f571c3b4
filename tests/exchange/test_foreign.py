"""Policies of other projects, from invented files: what is read of them, and that they move the robot as theirs do."""

import dataclasses
import re

import numpy as np
import onnx
import pytest
import yaml
from foreign_files import (
    clip_tables,
    config_table,
    deploy_table,
    lab_folder,
    metadata,
    mjlab_file,
    network,
    wbc_folder,
)
from loops import from_config_yaml, from_deploy_yaml, from_metadata, in_its_own_loop, in_the_environment
from orders import isaac_order

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.exchange.adopt import own_setup
from forgetmimic_jax.exchange.foreign import PolicyReading, read_policy
from forgetmimic_jax.exchange.imported import with_actor
from forgetmimic_jax.motion.library import build_library, read_library
from forgetmimic_jax.tracking.env import make_assets
from forgetmimic_jax.training.start import fresh_policy

STEPS = 12


def read(path, robot, **reading):
    return read_policy(path, robot, 0.02, PolicyReading(**reading))


def ours(foreign, tiny_config, library=None):
    """The setup and the policy that an import makes of it."""
    setup = own_setup(foreign.config(tiny_config), [foreign.clip] if foreign.clip else [])
    if library is not None:
        setup = dataclasses.replace(setup, library=library)
    return setup, with_actor(fresh_policy(setup, make_assets(setup)), foreign.actor, 0.4)


def sources(foreign) -> dict[str, str]:
    return {row.what: row.source for row in foreign.rows}


def values(foreign) -> dict[str, str]:
    return {row.what: row.value for row in foreign.rows}


@pytest.fixture(scope="module")
def mjlab(robot, library, tmp_path_factory):
    return mjlab_file(tmp_path_factory.mktemp("mjlab") / "kick.onnx", robot, library)


@pytest.fixture(scope="module")
def lab(robot, tmp_path_factory):
    return lab_folder(tmp_path_factory.mktemp("dance"), robot)


@pytest.fixture(scope="module")
def wbc(robot, tmp_path_factory):
    return wbc_folder(tmp_path_factory.mktemp("wbc"), robot)


@pytest.mark.parametrize("project", ["mjlab", "lab", "wbc"])
def test_joint_targets_are_those_of_the_policys_own_loop(request, project, robot, library, tiny_config):
    file = request.getfixturevalue(project)
    deployment = {
        "mjlab": lambda: from_metadata(file),
        "lab": lambda: from_deploy_yaml(file, file.parents[1] / "params" / "deploy.yaml", robot),
        "wbc": lambda: from_config_yaml(file, file.parent / "config.yaml"),
    }[project]()
    expected = in_its_own_loop(deployment, robot, library, STEPS)
    foreign = read(file, robot)
    setup, policy = ours(dataclasses.replace(foreign, clip=None), tiny_config, library)
    found = in_the_environment(setup, lambda assets, state, seen: policy.mean_action(seen), STEPS)
    assert np.ptp(expected, axis=0).max() > 0.1
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_the_table_says_what_was_taken_from_where_and_each_missing_key(mjlab, lab, wbc, robot):
    said = sources(read(mjlab, robot))
    assert said["layout"] == "observation_names, the metadata"
    assert said["action"] == "assumed: no action_mode; as projects of layout mjlab160 have it"
    assert said["control step"].startswith("assumed: no step_dt; ")
    assert values(read(mjlab, robot))["layout"] == "mjlab160"
    assert values(read(mjlab, robot))["network"] == "160-16-29, a normaliser"
    said = sources(read(lab, robot))
    assert said["joint order"] == "joint_names, deploy.yaml"
    assert said["anchor body"] == "assumed: no anchor_body_name; g1's"
    assert values(read(lab, robot))["network"] == "154-16-29, no normaliser"
    assert values(read(lab, robot))["clip"] == "those of --library"
    assert sources(read(wbc, robot))["stiffness"] == "joint_stiffness, config.yaml"
    assert values(read(wbc, robot))["action"] == "residual: target = reference joints + scale · action"


def test_bounds_are_the_projects_own(mjlab, wbc, robot, tiny_config):
    bounds = tiny_config.termination
    assert read(wbc, robot).config(tiny_config).termination == bounds
    found = read(mjlab, robot).config(tiny_config).termination
    assert found == dataclasses.replace(bounds, contact_force=100.0)


def test_a_pose_of_the_observation_that_is_not_the_actions_offset_is_converted(robot, library, tiny_config, tmp_path):
    """What is seen is less one pose, what is done adds the other; in unitree_rl_lab's files so far they are equal."""
    table = deploy_table(robot)
    offset = table["actions"]["JointPositionAction"]["offset"]
    table["actions"]["JointPositionAction"]["offset"] = [x + 0.1 for x in offset]
    file = lab_folder(tmp_path, robot, table)
    equal = lab_folder(tmp_path / "equal", robot)
    deployment = from_deploy_yaml(equal, tmp_path / "equal" / "params" / "deploy.yaml", robot)
    theirs = deployment.act
    deployment.default = deployment.default + 0.1  # of the target, and of what the loop shows
    places = slice(67, 96)

    def act(seen):
        seen = seen.copy()
        seen[places] += 0.1
        return theirs(seen)

    deployment.act = act
    expected = in_its_own_loop(deployment, robot, library, STEPS)
    setup, policy = ours(read(file, robot), tiny_config, library)
    found = in_the_environment(setup, lambda assets, state, seen: policy.mean_action(seen), STEPS)
    np.testing.assert_allclose(found, expected, atol=1e-5)


@pytest.mark.parametrize("normaliser", [True, False])
def test_scales_of_terms_are_taken_into_the_network(robot, tmp_path, normaliser):
    table = deploy_table(robot)
    table["observations"]["joint_vel_rel"]["scale"] = 0.05
    table["observations"]["base_ang_vel"]["scale"] = [0.25, 0.5, 2.0]
    file = lab_folder(tmp_path, robot, table)
    if normaliser:
        network(file, 154)
    factor = np.ones(154)
    factor[64:67], factor[96:125] = [0.25, 0.5, 2.0], 0.05
    seen = np.random.default_rng(0).normal(size=(20, 154)).astype(np.float32)
    foreign = read(file, robot)
    plain = lab_folder(tmp_path / "plain", robot)
    if normaliser:
        network(plain, 154)
    expected = read(plain, robot).actor(seen * factor)
    np.testing.assert_allclose(foreign.actor(seen), expected, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(foreign.original(seen), expected, rtol=1e-4, atol=1e-5)


def test_the_clip_inside_is_the_clip_that_was_put_there(mjlab, robot, library):
    clip = read(mjlab, robot).clip
    assert (clip.name, clip.num_frames, clip.fps) == ("kick", 80, 50.0)
    rebuilt, ours = (built.clip(0) for built in (build_library(robot, [clip]), library))
    for name in ("joint_pos", "joint_vel"):
        np.testing.assert_allclose(getattr(rebuilt, name), getattr(ours, name), atol=2e-3)
    np.testing.assert_allclose(rebuilt.bodies.pos, ours.bodies.pos, atol=1e-4)


def test_a_clip_in_another_order_of_joints_and_bodies_is_read_by_their_names(robot, library, tmp_path):
    order = isaac_order(robot)
    place = [robot.joint_names.index(joint) for joint in order]
    tables = clip_tables(library)
    bodies = list(reversed(robot.key_bodies))
    tables |= {name: tables[name][:, place] for name in ("joint_pos", "joint_vel")}
    tables |= {name: table[:, ::-1] for name, table in tables.items() if name.startswith("body")}
    said = metadata(robot, "mjlab160") | {"joint_names": ",".join(order), "body_names": ",".join(bodies)}
    clip = read(network(tmp_path / "a.onnx", 160, metadata=said, tables=tables), robot).clip
    rebuilt, ours = (built.clip(0) for built in (build_library(robot, [clip]), library))
    np.testing.assert_allclose(clip.root_pos, ours.bodies.pos[:, robot.root], atol=2e-5)
    np.testing.assert_allclose(rebuilt.joint_pos, ours.joint_pos, atol=2e-5)


@pytest.mark.parametrize("names", [{}, {"body_names": None}])
def test_a_clip_inside_that_does_not_fit_its_own_bodies_is_refused(robot, library, tmp_path, names):
    said = {key: value for key, value in (metadata(robot, "mjlab160") | names).items() if value is not None}
    right = clip_tables(library)
    assert read(network(tmp_path / "a.onnx", 160, metadata=said, tables=right), robot).clip is not None
    others = {
        "quaternions xyzw": right | {"body_quat_w": np.roll(right["body_quat_w"], -1, axis=-1)},
        "orientations of other bodies": right | {"body_quat_w": right["body_quat_w"][:, [0, *range(13, 0, -1)]]},
        "joints of the other side": right | {"joint_pos": right["joint_pos"][:, robot.counterpart]},
    }
    for what, tables in others.items():
        path = network(tmp_path / f"{what}.onnx", 160, metadata=said, tables=tables)
        with pytest.raises(InputError, match=rf"^{path}: the clip inside: forward kinematics: \w+ lies .* m from g1's"):
            read(path, robot)


def test_garbage_in_the_first_frames_is_named_and_can_be_left_out(robot, library, tmp_path):
    tables = clip_tables(library)
    tables["joint_pos"][0, 3] += 1.0  # the left knee moves 1 rad in 0.02 s, past 20 rad/s
    tables["body_pos_w"][1:2] += [0.0, 0.3, 0.0]  # there and back
    file = network(tmp_path / "a.onnx", 160, metadata=metadata(robot, "mjlab160"), tables=tables)
    (doubt,) = read(file, robot).doubts
    assert re.match(r"a: frames 0 to 1 are garbage: left_knee_joint moves at (49|50|51) rad/s and the root "
                    r"at 15\.\d m/s; --start 0\.04 leaves them out$", doubt)  # fmt: skip
    left = read(file, robot, start=0.04)
    assert left.doubts == ()
    assert left.clip.num_frames == 78
    for start in ("nan", "inf", "-0.1", "1.2"):
        with pytest.raises(InputError, match=rf"^--start: found {start}; a has 1\.60 s, and half a second must remain"):
            read(file, robot, start=float(start))


def test_a_clip_beside_a_policy_is_taken_at_the_rate_in_its_name(robot, tmp_path):
    file = lab_folder(tmp_path / "dance", robot)
    (clip,) = read_library(robot, clips=["punch"])
    rows = np.concatenate([clip.root_pos, np.roll(clip.root_quat, -1, axis=-1), clip.joint_pos], axis=-1)[:80]
    motion = tmp_path / "dance" / "params" / "take 1_100hz.csv"
    np.savetxt(motion, rows, delimiter=",")
    foreign = read(file, robot)
    assert (foreign.clip.name, foreign.clip.num_frames) == ("take_1_100hz", 40)  # of 0.8 s at 50 Hz
    np.testing.assert_allclose(foreign.clip.joint_pos[3], rows[6, 7:], atol=1e-5)
    motion.rename(motion.with_name("take.csv"))
    with pytest.raises(InputError, match=r"take\.csv: fps: "):
        read(file, robot)
    assert read(file, robot, fps=50.0).clip.num_frames == 80
    motion.with_name("take.csv").write_text("no,motion\n")
    assert read(file, robot, own_clip=False).clip is None  # a file that is no motion stops nothing then
    (motion.parent / "other.csv").write_text("")  # two: which one is its clip is not said
    assert read(file, robot).clip is None


def test_wbc_terms_of_the_pelvis_are_root132(robot, tmp_path):
    table = config_table(robot)
    table["tracking"]["anchor_body_name"] = "pelvis"
    assert values(read(wbc_folder(tmp_path, robot, table), robot))["layout"] == "root132"


def changed(table: dict, path: str, value) -> dict:
    *sections, last = path.split(".")
    part = table
    for section in sections:
        part = part[section]
    part[last] = value
    return table


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"observation_names": None}, "missing observation_names: no metadata and no deploy.yaml or config.yaml of "),
        (
            {"observation_names": "command,base_ang_vel,motion_anchor_ori_b,joint_pos,joint_vel,actions"},
            "observation_names: the metadata says command, base_ang_vel, motion_anchor_ori_b, joint_pos, joint_vel, "
            "actions; these are the terms of mjlab154 in another order; accepted: command, motion_anchor_ori_b, ",
        ),
        (
            {"observation_names": "command,motion_anchor_ori_b,base_ang_vel,joint_pos,joint_vel,height_scan"},
            "observation_names: the metadata says command, motion_anchor_ori_b, base_ang_vel, joint_pos, joint_vel, "
            "height_scan; accepted: the terms of wbc132, mjlab160, mjlab154, root132; nearest is mjlab154 (missing: "
            "actions; unknown: height_scan)",
        ),
        ({"anchor_body_name": "pelvis"}, "anchor_body_name: the metadata says pelvis; torso_link is needed with "),
        ({"joint_names": "a,b"}, "joint_names: found 2 joints that are not g1's 29 (missing: left_ankle_pitch_joint, "),
        ({"action_scale": "0.25,0.25"}, "action_scale: found 2 numbers; 29 are needed"),
        ({"joint_stiffness": "stiff"}, "joint_stiffness: found stiff; a number is needed"),
        ({"joint_damping": "nan"}, "joint_damping: found nan; a finite number is needed"),
        ({"joint_damping": "-1"}, "joint_damping: left_hip_pitch_joint: found -1; accepted: 0 or more"),
        ({"joint_stiffness": "0"}, "joint_stiffness: left_hip_pitch_joint: found 0; accepted: more than 0"),
        ({"action_scale": "-0.25"}, "action_scale: left_hip_pitch_joint: found -0.25; accepted: more than 0"),
        ({"action_mode": "velocity"}, "action_mode: found 'velocity'; accepted: reference_residual, default_relative"),
        ({"step_dt": "0.01"}, "step_dt: the metadata says 0.01 s; accepted: 0.02 s"),
        ({"observation_history_lengths": "1,1,5"}, "observation_history_lengths: found 5: not supported: it needs a h"),
        ({"dof_names": "[]"}, "dof_names: holosoma's layout is not supported: it needs its terms in the order of thei"),
        ({"body_names": "a,b"}, "body_names: no 'pelvis', the root of g1; found a, b …"),
    ],
)
def test_metadata_that_cannot_be_are_refused(robot, library, tmp_path, changes, message):
    path = mjlab_file(tmp_path / "a.onnx", robot, library, **changes)
    with pytest.raises(InputError) as error:
        read(path, robot)
    assert str(error.value).startswith(f"{path}: {message}")


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("joint_ids_map", [str(place) for place in range(29)], "joint_ids_map: found ['0', '1', '2', "),
        ("actions", ["JointPositionAction"], "actions: found ['JointPositionAction']; a table is needed"),
        ("actions.JointPositionAction", None, "actions.JointPositionAction: found None; a table is needed"),
        ("observations.use_gym_history", True, "observations.use_gym_history: found True; accepted: false: its order"),
        ("joint_ids_map", list(range(23)), "joint_ids_map: found 23 places; the 29 joints of g1 are needed, each once"),
        ("stiffness", [1.0] * 28, "stiffness: found 28 numbers; 29 are needed"),
        ("actions", {"JointVelocityAction": {}}, "actions: found JointVelocityAction; accepted: JointPositionAction"),
        (
            "actions.JointPositionAction.clip",
            [-1, 1],
            "actions.JointPositionAction.clip: found [-1, 1]; accepted: null",
        ),
        ("observations.last_action.history_length", 5, "observations.last_action.history_length: found 5: not supp"),
        ("observations.base_ang_vel.clip", [-5, 5], "observations.base_ang_vel.clip: found [-5, 5]; accepted: null"),
        ("damping", [1.0] * 28 + [-2.0], "damping: right_wrist_yaw_joint: found -2; accepted: 0 or more"),
        (
            "actions.JointPositionAction.scale",
            0.0,
            "actions.JointPositionAction.scale: left_hip_pitch_joint: found 0; accepted: more than 0",
        ),
        ("observations", 3, "observations: a table of terms is needed"),
        ("default_joint_pos", ["x"] * 29, "default_joint_pos: found x; a number is needed"),
    ],
)
def test_a_deploy_yaml_that_cannot_be_is_refused(robot, tmp_path, key, value, message):
    file = lab_folder(tmp_path, robot, changed(deploy_table(robot), key, value))
    with pytest.raises(InputError) as error:
        read(file, robot)
    assert str(error.value).split("deploy.yaml: ", 1)[1].startswith(message)


@pytest.mark.parametrize(
    ("said", "message"),
    [
        (
            {"action_mode": "default_relative"},
            "action_mode: the metadata says offset, config.yaml says residual; which",
        ),
        ({"action_scale": "0.25"}, r"action_scale: left_hip_pitch_joint: the metadata says 0.25, config.yaml says 0."),
        ({"anchor_body_name": "pelvis"}, "anchor_body_name: the metadata says pelvis, config.yaml says torso_link; "),
        (
            {"observation_names": "command,joint_pos"},
            "observation_names: the metadata says 2 (command, joint_pos …), config.yaml says 10 (ref_base_height, ",
        ),
    ],
)
def test_a_yaml_that_disagrees_with_the_metadata_is_refused_with_both_values(robot, tmp_path, said, message):
    file = wbc_folder(tmp_path, robot, **said)
    with pytest.raises(InputError) as error:
        read(file, robot)
    assert str(error.value).startswith(f"{file}: {message}")


def test_a_yaml_that_agrees_to_the_metadatas_digits_is_accepted_and_its_own_digits_are_kept(robot, tmp_path):
    table = config_table(robot)
    table["action"]["scale"] = [0.33333333] * 29
    foreign = read(wbc_folder(tmp_path, robot, table, action_scale="0.333"), robot)
    assert foreign.description.action.scale["left_knee_joint"] == 0.33333333


def test_a_layout_can_be_given_where_nothing_says_it_but_never_another_than_the_files(robot, library, tmp_path):
    file = network(tmp_path / "bare" / "policy.onnx", 154)
    foreign = read(file, robot, layout="mjlab154")
    assert sources(foreign)["layout"] == "observation_names, the flags"
    assumed = {what for what, source in sources(foreign).items() if source.startswith("assumed: ")}
    assert assumed == {"anchor body", "action", "control step", "joint order", "default pose", "scale", "stiffness",
                       "damping", "armature"}  # fmt: skip
    with pytest.raises(InputError, match=r"observations: found 154; 160 are needed, in this order: command 58, "):
        read(file, robot, layout="mjlab160")
    path = mjlab_file(tmp_path / "a.onnx", robot, library)
    with pytest.raises(InputError, match=r"observation_names.*: the flags says .*, the metadata says "):
        read(path, robot, layout="mjlab154")


def test_isaac_labs_order_can_be_given_where_nothing_says_it(robot, tmp_path):
    file = network(tmp_path / "bare" / "policy.onnx", 154)
    assert read(file, robot, layout="mjlab154").description.action.joint_order == ()
    assert read(file, robot, layout="mjlab154", order="robot").description.action.joint_order == ()
    found = read(file, robot, layout="mjlab154", order="isaac").description.action.joint_order
    assert found == isaac_order(robot)


def test_every_yaml_of_a_policy_is_read_and_two_that_disagree_are_named(robot, tmp_path):
    file = wbc_folder(tmp_path, robot)
    table = deploy_table(robot, "wbc132") | {"joint_ids_map": list(range(29))}
    table |= {key: config_table(robot)[key] for key in ("default_joint_pos", "stiffness", "damping")} | {"actions": {}}
    for folder in (tmp_path, tmp_path / "params"):
        folder.mkdir(exist_ok=True)
        (folder / "deploy.yaml").write_text(yaml.safe_dump(table, sort_keys=False))
    assert sources(read(file, robot))["stiffness"] == f"joint_stiffness, {tmp_path / 'params' / 'deploy.yaml'}"
    table["stiffness"] = [50.0] * 29
    (tmp_path / "deploy.yaml").write_text(yaml.safe_dump(table, sort_keys=False))
    (tmp_path / "params" / "deploy.yaml").unlink()
    with pytest.raises(InputError, match=r"joint_stiffness: left_hip_pitch_joint: deploy.yaml says 50, config.yaml sa"):
        read(file, robot)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("robot_id", "h1", "robot_id: found 'h1'; accepted: g1: a policy of another robot?"),
        ("robot", "unitree_go2", "robot: found 'unitree_go2'; accepted: g1: a policy of another robot?"),
        ("action", "x", "action: found x; a table is needed"),
        ("tracking", ["x"], "tracking: found ['x']; a table is needed"),
        ("action.action_mode", [1], "action.action_mode: found '[1]'; accepted: reference_residual, default_relative"),
    ],
)
def test_a_config_yaml_that_cannot_be_is_refused(robot, tmp_path, key, value, message):
    file = wbc_folder(tmp_path, robot, changed(config_table(robot), key, value))
    with pytest.raises(InputError) as error:
        read(file, robot)
    assert str(error.value) == f"{tmp_path / 'config.yaml'}: {message}"


def test_other_spellings_are_read(robot, library, tmp_path):
    """Spaces after commas, longer names of the robot, and a history that is switched off."""
    spaced = {key: value.replace(",", ", ") for key, value in metadata(robot, "mjlab160").items()}
    path = mjlab_file(tmp_path / "a" / "kick.onnx", robot, library, **spaced)
    assert values(read(path, robot)) == values(read(mjlab_file(tmp_path / "b" / "kick.onnx", robot, library), robot))
    table = config_table(robot) | {"robot_id": "unitree_g1_29dof"}
    table["actor_observations"]["use_gym_history"] = False
    assert values(read(wbc_folder(tmp_path / "c", robot, table), robot))["layout"] == "wbc132"


def test_another_projects_config_yaml_is_passed_over_and_humanoidverses_is_named(robot, library, tmp_path):
    path = mjlab_file(tmp_path / "a.onnx", robot, library)
    (tmp_path / "config.yaml").write_text("preset: cpu\n")  # as in our own checkpoints
    assert sources(read(path, robot))["scale"] == "action_scale, the metadata"
    (tmp_path / "config.yaml").write_text("obs: {obs_dict: {actor_obs: [actions]}}\n")
    with pytest.raises(InputError, match=r"config\.yaml: obs\.obs_dict: HumanoidVerse's layouts are not supported: "):
        read(path, robot)
    (tmp_path / "config.yaml").write_text("a: [")
    with pytest.raises(InputError, match=r"config\.yaml: not YAML: "):
        read(path, robot)


def test_a_checkpoint_of_rsl_rl_is_described_by_the_yaml_beside_it_or_by_the_flags(robot, tmp_path):
    from test_rsl_rl import POLICIES

    source = POLICIES / "rsl_rl_5.5.1.pt"
    file = tmp_path / "model_1500.pt"
    file.write_bytes(source.read_bytes())
    with pytest.raises(InputError, match=r"missing observation_names"):
        read(file, robot, activation="elu")
    assert sources(read(file, robot, activation="elu", layout="wbc132"))["scale"].startswith("assumed: no action_scale")
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(config_table(robot), sort_keys=False))
    foreign = read(file, robot, activation="elu")
    assert sources(foreign)["scale"] == "action_scale, config.yaml"
    seen = np.load(source.with_suffix(".npz"))
    np.testing.assert_allclose(foreign.original(seen["observations"]), seen["actions"], rtol=1e-5, atol=1e-5)


def test_weights_in_a_file_of_their_own_that_is_missing_are_named(robot, wbc, tmp_path):
    file = tmp_path / "policy.onnx"
    file.write_bytes(wbc.read_bytes())
    with pytest.raises(InputError, match=rf"^{file}: its weights are in policy\.onnx\.data, and there is no such file"):
        read(file, robot)


@pytest.mark.parametrize(
    ("inputs", "message"),
    [
        (
            ("obs", "state", "goal"),
            "inputs: found obs, state, goal; 'obs' is needed, and no other is accepted but mjlab",
        ),
        (("actor_obs",), "inputs: found actor_obs: HumanoidVerse's layouts are not supported: they need a history of "),
    ],
)
def test_other_inputs_are_named(robot, tmp_path, inputs, message):
    file = network(tmp_path / "policy.onnx", 154, inputs=inputs)
    with pytest.raises(InputError) as error:
        read(file, robot, layout="mjlab154")
    assert str(error.value).startswith(f"{file}: {message}")


def test_weights_that_are_no_numbers_are_refused(robot, library, tmp_path):
    path = mjlab_file(tmp_path / "a.onnx", robot, library)
    model = onnx.load(path)
    broken = onnx.numpy_helper.to_array(model.graph.initializer[0]).copy()
    broken[0, 0] = np.nan
    model.graph.initializer[0].CopyFrom(onnx.numpy_helper.from_array(broken, model.graph.initializer[0].name))
    onnx.save(model, path)
    with pytest.raises(InputError, match=rf"^{path}: found NaN or Inf among the weights; finite numbers are needed$"):
        read(path, robot)
