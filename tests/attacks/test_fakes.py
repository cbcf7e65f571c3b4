"""Judging the judge, in miniature: every fake fails with the attack that caught it, and a distilled policy passes."""

import dataclasses

import jax
import jax.numpy as jnp
import msgspec
import numpy as np
import pytest
import toy
from invented_evidence import PLAIN

from forgetmimic_jax.attacks import case as cases
from forgetmimic_jax.attacks import fakes, look_alikes, membership, near_duplicates, numerics, splices
from forgetmimic_jax.attacks.case import Case, Scale, originals
from forgetmimic_jax.attacks.document import EvidenceDocument, Recovery, Relearning
from forgetmimic_jax.attacks.verdict import CONSISTENT, FAILED, Verdict, judge
from forgetmimic_jax.tracking.layouts import find_layout

SCALE = Scale(episodes=6, target_episodes=6, variant_episodes=4, kept_variant_episodes=4)


@pytest.fixture(scope="module")
def toy_clips(robot, clips):
    """The invented clips with motions of their own: each joint swings by up to 0.4 rad about a pose of the clip."""
    found = {}
    for seed, (name, clip) in enumerate(clips.items()):
        random = np.random.default_rng(seed)
        time = np.arange(clip.num_frames)[:, None] / 50.0
        swing = 0.4 * np.sin(2.0 * np.pi * (time * random.uniform(0.5, 1.0, robot.num_joints) + random.random()))
        middle = 0.5 * (robot.joint_lower + robot.joint_upper) + random.uniform(-0.5, 0.5, robot.num_joints)
        joints = np.clip(middle + swing, robot.joint_lower, robot.joint_upper)
        found[name] = dataclasses.replace(clip, joint_pos=joints)
    return found


@pytest.fixture(scope="module")
def world(small_setup, toy_clips, robot):
    """Base, control, and what makes a fake of the base; the target is `turn`."""
    first = find_layout(small_setup.config.observation.layout).places(robot.num_joints)["ref_joint_pos"].start
    known, other = (toy.network(seed, robot.num_joints, first) for seed in (1, 2))
    frames = jnp.asarray(toy_clips["turn"].joint_pos, jnp.float32)
    base = toy.Near(other, known, frames, toy.WIDE, 1.0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cases, "Stage", toy.ToyStage)
        yield {"base": base, "control": known, "frames": frames, "target network": other}


def verdict_on(policy, world, small_setup, toy_clips) -> Verdict:
    """The verdict from the attacks that roll out; those that train are as on a policy that they do not bring back."""
    policies = {"base": world["base"], "unlearned": policy, "control": world["control"]}
    case = Case(small_setup, toy_clips, ("turn",), policies, SCALE)
    plain = msgspec.convert({**PLAIN, "targets": ["turn"]}, EvidenceDocument)
    document = msgspec.structs.replace(
        plain,
        originals=originals(case),
        near_duplicates=near_duplicates.attack(case),
        splices=splices.attack(case),
        look_alikes=look_alikes.attack(case),
        numerics=numerics.attack(case),
        membership=membership.attack(case),
        recovery=msgspec.convert(PLAIN["recovery"], Recovery),
        relearning=msgspec.convert(PLAIN["relearning"], Relearning),
    )
    return judge(document)


def test_a_distilled_policy_passes(world, small_setup, toy_clips):
    kernel = world["control"].actor["kernel"]
    another = dataclasses.replace(world["control"], actor={"kernel": kernel * 1.01})
    verdict = verdict_on(another, world, small_setup, toy_clips)
    assert verdict.phrase == CONSISTENT, verdict.reasons


@pytest.mark.parametrize(
    ("name", "caught_by"),
    [
        ("the base itself", "Still known: the target turn"),
        ("filter: zero action on the targets", "Still known: near-duplicates of the targets: "),
        ("filter: noise on the targets", "Still known: near-duplicates of the targets: "),
        ("falls on everything unfamiliar", "Lost: near-duplicates of the kept clips: "),
        ("fine-tuned to fall on the targets alone", "Still known: near-duplicates of the targets: "),
        ("λ = 8", "Still known: the target turn"),
    ],
)
def test_every_fake_fails_and_the_reason_names_what_caught_it(name, caught_by, world, small_setup, toy_clips):
    base, frames = world["base"], world["frames"]
    silent = dataclasses.replace(world["control"], actor={"kernel": jnp.zeros_like(world["control"].actor["kernel"])})
    own = {
        "λ = 8": dataclasses.replace(base, strength=0.8),  # too little pressure: it still knows most
        "fine-tuned to fall on the targets alone": toy.Near(silent, base, frames, toy.NARROW, 1.0),
    }
    kept = [clip for clip in toy_clips.values() if clip.name != "turn"]
    made = own.get(name) or fakes.fakes(small_setup, base, [toy_clips["turn"]], kept)[name]()
    verdict = verdict_on(made, world, small_setup, toy_clips)
    assert verdict.phrase == FAILED
    assert any(reason.startswith(caught_by) for reason in verdict.reasons), verdict.reasons
    if "near-duplicates" in caught_by:
        assert not any("the target turn" in reason for reason in verdict.reasons)


def test_the_six_fakes_are_those_of_the_table(small_setup, toy_clips):
    names = set(fakes.fakes(small_setup, None, [], []))
    assert len(names | {"λ = 8"}) == 6


def test_a_filter_knows_its_frames_and_no_others(small_setup, toy_clips, world, robot):
    first = world["control"].first
    known = fakes.filtered(small_setup, world["base"], [toy_clips["turn"]], "zero")
    size = find_layout(small_setup.config.observation.layout).size(robot.num_joints)

    def seen(joints: np.ndarray) -> np.ndarray:
        observation = np.zeros((len(joints), size), np.float32)
        observation[:, first : first + robot.num_joints] = joints
        return np.asarray(known.mean_action(jnp.asarray(observation)))

    assert not seen(toy_clips["turn"].joint_pos).any()
    assert np.abs(seen(toy_clips["sway"].joint_pos)).max(axis=1).min() > 0.01
    assert np.abs(seen(toy_clips["turn"].joint_pos + 0.01)).max(axis=1).min() > 0.01


def test_noise_is_the_same_in_the_same_state(small_setup, toy_clips, world):
    noisy = fakes.filtered(small_setup, world["base"], [toy_clips["turn"]], "noise")
    observation = jax.random.normal(jax.random.PRNGKey(0), (4, 132))
    one, again = (np.asarray(noisy._noise(observation, jnp.zeros((4, 29)))) for _ in range(2))
    np.testing.assert_array_equal(one, again)
    assert np.abs(one).max() <= fakes.NOISE
    assert one.std() > 1.0
