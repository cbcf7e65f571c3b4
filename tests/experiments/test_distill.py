"""One policy from several teachers, and what the search found among what they teach."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments import distill
from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.evaluation.rollout import act, begin_episodes
from forgetmimic_jax.ppo.state import init_state
from forgetmimic_jax.tracking import env as tracking
from forgetmimic_jax.tracking.setup import make_setup
from forgetmimic_jax.training import checkpoint, runner


def setup_of(config, library_folder):
    return make_setup(dataclasses.replace(config, library=str(library_folder)))


def saved(setup, path, seed):
    """A random policy, whose actions are made large enough to tell it from another."""
    state = init_state(setup.env, setup.assets, jax.random.PRNGKey(seed))
    actor = state.policy.actor["params"]
    last = actor["MLP_0"]["Dense_2"]
    larger = {"params": {**actor, "MLP_0": {**actor["MLP_0"], "Dense_2": {**last, "kernel": 30.0 * last["kernel"]}}}}
    state = dataclasses.replace(state, policy=dataclasses.replace(state.policy, actor=larger))
    checkpoint.save_checkpoint(
        path,
        state,
        setup.config,
        setup.robot,
        setup.library,
        setup.library_hash,
        environment_steps=0,
        resumable=False,
    )
    return path


def actions(setup, path):
    """At every fifth frame of sway and turn, [clip, frame, joint]."""
    policy = checkpoint.load_policy(path, runner.template(setup))
    result = []
    for name in ("sway", "turn"):
        clip = jnp.full(setup.env.num_envs, setup.library.names.index(name))
        episodes = begin_episodes(
            setup.env, setup.assets, jax.random.PRNGKey(0), clip, 5 * jnp.arange(setup.env.num_envs)
        )
        result.append(act(setup.env, policy, tracking.observe(setup.env, setup.assets, episodes, None)[0]))
    return np.stack(result)


def test_correction_is_straight_between_knots_and_comes_again_with_the_cycle(tmp_path):
    found = {"start": 3, "window": 5, "knots": [[0.0], [4.0], [0.0]]}
    (tmp_path / "found.json").write_text(json.dumps({"clips": {"sway": found}}))
    added = distill.correction(tmp_path / "found.json", "sway", cycle=6)
    # Frames 3 to 7 get 0, 2, 4, 2, 0; 6 and 7 are frames 0 and 1 of the next cycle.
    np.testing.assert_allclose(added[:, 0], [2, 0, 0, 0, 2, 4])


def test_correction_of_a_clip_that_was_not_searched(tmp_path):
    (tmp_path / "found.json").write_text(json.dumps({"clips": {"sway": {"fall": 3}}}))
    with pytest.raises(InputError, match=r"--found: .*found\.json has nothing for 'sway'"):
        distill.correction(tmp_path / "found.json", "sway", cycle=6)


def test_cycle_of_a_loop_and_of_none():
    time = np.arange(100)[:, None]
    assert distill.cycle_of(np.sin(2 * np.pi * time / 20)) == 20
    assert distill.cycle_of(0.01 * time) == 100


def test_learns_each_clip_from_its_teacher(library_folder, tiny_config, tmp_path, monkeypatch):
    """The student comes nearer to the specialist on its clip and stays what it was on the others."""
    small = {"ENVIRONMENTS": 8, "STEPS": 8, "MINIBATCHES": 2, "EPISODE": 20, "LEARNING_RATE": 3e-3}
    for name, value in small.items():
        monkeypatch.setattr(distill, name, value)
    setup = setup_of(tiny_config, library_folder)
    student, specialist = (saved(setup, tmp_path / str(seed), seed) for seed in (0, 1))
    options = distill.Options(tmp_path / "out", student=student, teachers=(f"turn={specialist}",), rounds=120)
    distill.distill(options)
    assert checkpoint.read_info(options.output).environment_steps == 120 * 8 * 8
    before, taught, after = (actions(setup, path) for path in (student, specialist, options.output))
    apart = np.abs(before - taught).mean((1, 2))
    sway, turn = 0, 1
    assert np.abs(after - taught).mean((1, 2))[turn] < 0.5 * apart[turn]
    assert np.abs(after - before).mean((1, 2))[sway] < 0.5 * apart[sway]


def test_errors_come_before_anything_is_written(library_folder, tiny_config, tmp_path):
    student = saved(setup_of(tiny_config, library_folder), tmp_path / "student", 0)
    with pytest.raises(InputError, match="exists already"):
        distill.distill(distill.Options(student, student=student))
    output = tmp_path / "out"
    with pytest.raises(InputError, match="no clip 'swy'"):
        distill.distill(distill.Options(output, student=student, teachers=(f"swy={student}",)))
    with pytest.raises(InputError, match="no such checkpoint folder"):
        distill.distill(distill.Options(output, student=student, teachers=(f"sway={tmp_path / 'none'}",)))
    for incomplete in ("sway", "sway=", f"={student}"):
        with pytest.raises(InputError, match="accepted: CLIP=CHECKPOINT"):
            distill.distill(distill.Options(output, student=student, teachers=(incomplete,)))
    assert not output.exists()
