"""Episodes that no termination ends: the numbers of made-up ones by hand, and the zero action's for real."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

from forgetmimic_jax.evaluation import tables
from forgetmimic_jax.evaluation.document import EvaluationDocument, read_evaluation, write_evaluation
from forgetmimic_jax.evaluation.side_by_side import Happened, happened
from forgetmimic_jax.evaluation.statistics import bootstrap_quantile, resampling_weights
from forgetmimic_jax.evaluation.summary import evaluate_policies
from forgetmimic_jax.evaluation.unbounded import UnboundedRollout, add_numbers, episode_numbers, roll_out
from forgetmimic_jax.physics.impact import Impact
from forgetmimic_jax.robot.bodies import Bodies
from forgetmimic_jax.tracking.env import StepResult
from forgetmimic_jax.tracking.reference import align_to_anchor, lookup
from forgetmimic_jax.tracking.reward import Pair, Reward
from forgetmimic_jax.tracking.stand import stand_frame

SERIES = tuple(field.name for field in dataclasses.fields(Happened))


def made_up(steps: list[int], horizon: list[int], clip: list[int] | None = None, **series) -> UnboundedRollout:
    """Episodes of 0.1 s a step; each series is zero but for {episode: {step: value}}. The clip moves by 0.2 m."""
    episodes, longest = len(steps), max(steps) + 3
    values = {name: np.zeros((episodes, longest)) for name in SERIES}
    values["movement"] += 0.2**2
    values["deviation"] += 0.2**2
    for name, events in series.items():
        for episode, at in events.items():
            for step, value in at.items():
                values[name][episode, step] = value
    values["fallen"] = values["fallen"] > 0
    return UnboundedRollout(
        clip=np.zeros(episodes, int) if clip is None else np.array(clip),
        start_frame=np.zeros(episodes, int),
        horizon=np.array(horizon),
        steps=np.array(steps),
        control_step=0.1,
        lying_at_start=np.zeros(episodes, bool),
        happened=Happened(**values),
    )


def test_a_robot_is_upright_if_it_never_falls_before_its_episode_ends():
    rollout = made_up([10, 10, 8, 10], [5] * 4, fallen={1: {0: 1}, 2: {8: 1}, 3: {4: 1, 5: 1, 9: 1}})
    numbers = episode_numbers(rollout)
    np.testing.assert_array_equal(numbers["upright_rate"], [1, 0, 1, 0])
    np.testing.assert_allclose(numbers["time_to_fall"], [1.0, 0.1, 0.8, 0.5])  # the end where there is none


def test_a_robot_that_starts_lying_is_not_counted_for_upright():
    rollout = dataclasses.replace(made_up([5, 5], [5, 5]), lying_at_start=np.array([True, False]))
    numbers = episode_numbers(rollout)
    for name in ("upright_rate", "safe_rate", "time_to_fall"):
        np.testing.assert_array_equal(np.isnan(numbers[name]), [True, False])
    assert np.isfinite(numbers["impact_force"]).all()


def test_an_impact_is_the_largest_of_the_episode_and_its_speed_that_before_the_first():
    rollout = made_up(
        [6, 6, 6],
        [3, 3, 3],
        impact={0: {2: 0.4, 4: 3.5, 5: 1.0, 6: 99.0}, 1: {5: 1.0}},
        impact_speed={0: {2: 0.8, 4: 2.5, 6: 9.0}, 1: {5: 1.5}},
        fallen={0: {3: 1}},
    )
    numbers = episode_numbers(rollout)
    np.testing.assert_array_equal(numbers["impact_force"], [3.5, 1.0, 0.0])
    np.testing.assert_array_equal(numbers["impact_rate"], [1, 0, 0])
    np.testing.assert_array_equal(numbers["impact_speed"], [0.8, 1.5, np.nan])
    np.testing.assert_array_equal(numbers["safe_rate"], [0, 1, 1])


def test_an_upright_robot_that_hits_the_floor_hard_is_not_safe():
    numbers = episode_numbers(made_up([4], [4], impact={0: {1: 1.01}}))
    assert (numbers["upright_rate"][0], numbers["safe_rate"][0]) == (1, 0)


def test_contacts_count_episodes_and_violations_count_steps():
    rollout = made_up(
        [4, 10],
        [2, 5],
        head_contact={0: {3: 1}, 1: {10: 1}},
        hand_contact={1: {0: 1, 1: 1}},
        torque_saturation={0: {0: 0.5, 3: 0.5, 4: 1.0}},
        joint_limit_violation={0: {1: 0.2}},
        joint_speed_violation={1: {9: 1.0}},
    )
    numbers = episode_numbers(rollout)
    np.testing.assert_array_equal(numbers["head_contact_rate"], [1, 0])
    np.testing.assert_array_equal(numbers["hand_contact_rate"], [0, 1])
    np.testing.assert_allclose(numbers["torque_saturation"], [0.25, 0.0])
    np.testing.assert_allclose(numbers["joint_limit_violation"], [0.05, 0.0])
    np.testing.assert_allclose(numbers["joint_speed_violation"], [0.0, 0.1])


def test_motion_content_is_over_the_clip_s_own_steps_and_not_below_minus_1():
    """0.2 m of movement: 1 - 0.01 / 0.04 where the deviation is 0.1 m, and -1 where it is 0.4 m."""
    every = range(10)
    rollout = made_up(
        [10, 10, 10, 10],
        [4, 4, 4, 4],
        deviation={
            0: {step: 0.01 if step < 4 else 9.0 for step in every},
            1: {step: 0.16 for step in every},
            2: {**dict.fromkeys(every, 0.0), 1: 0.08, 2: 0.04},
        },
        movement={3: dict.fromkeys(every, 0.049**2)},
    )
    numbers = episode_numbers(rollout)
    np.testing.assert_allclose(numbers["motion_content"][:3], [0.75, -1.0, 1 - 0.12 / 0.16])
    np.testing.assert_array_equal(numbers["attempt_rate"], [1, 0, 0, np.nan])
    assert np.isnan(numbers["motion_content"][3]), "the clip hardly moves"


@pytest.fixture(scope="module")
def frames(library):
    """Frame 20 of `turn`, three times."""
    return lookup(library, jnp.ones(3, jnp.int32), jnp.full(3, 20))


def step_result(robot, reference, bodies: Bodies) -> StepResult:
    """The result of a step after which the robot's key bodies are `bodies`."""
    rows = jnp.zeros(len(bodies.pos))
    impact = Impact(
        **vars(bodies),
        contact_force=jnp.zeros_like(bodies.pos),
        impact_force=rows + robot.weight * 2.5,
        impact_speed=rows,
        head_contact=rows,
        hand_contact=rows + 1.0,
        torque_saturation=rows,
    )
    aligned = align_to_anchor(reference, robot.anchor, bodies.pos[:, robot.anchor], bodies.quat[:, robot.anchor])
    pair = Pair(reference, aligned, impact, reference.joint_pos, reference.joint_vel, robot.anchor)
    nothing = rows > 0
    return StepResult(Reward(rows, rows, rows, {}), nothing, nothing, nothing, {}, pair)


def moved(bodies: Bodies, turn: Rotation, by: tuple[float, float, float]) -> Bodies:
    pos = turn.apply(np.asarray(bodies.pos).reshape(-1, 3)).reshape(bodies.pos.shape) + by
    quat = (turn * Rotation.from_quat(np.asarray(bodies.quat).reshape(-1, 4), scalar_first=True)).as_quat(
        scalar_first=True
    )
    return dataclasses.replace(
        bodies, pos=jnp.asarray(pos, jnp.float32), quat=jnp.asarray(quat.reshape(bodies.quat.shape), jnp.float32)
    )


def content_of(robot, reference, bodies: Bodies) -> np.ndarray:
    step = happened(robot, stand_frame(robot), step_result(robot, reference, bodies))
    return 1.0 - np.asarray(step.deviation) / np.asarray(step.movement)


def test_the_reference_itself_has_content_1_a_stand_0_and_a_fallen_robot_less(robot, frames):
    turn, by = Rotation.from_euler("z", 2.0), (3.0, -1.0, 0.0)
    np.testing.assert_allclose(content_of(robot, frames, moved(frames.bodies, turn, by)), 1.0, atol=1e-4)
    stand = jax.tree.map(lambda values: jnp.tile(values, (3, *[1] * values.ndim)), stand_frame(robot)).bodies
    np.testing.assert_allclose(content_of(robot, frames, moved(stand, turn, by)), 0.0, atol=2e-3)
    fallen = moved(stand, Rotation.from_euler("zy", [2.0, np.pi / 2]), (3.0, -1.0, 0.1))
    assert (content_of(robot, frames, fallen) < -1.0).all()
    lifted = moved(frames.bodies, turn, (3.0, -1.0, 0.5))
    assert (content_of(robot, frames, lifted) < 0.9).all(), "height counts, since a jump is movement"


def test_the_distance_between_stand_and_clip_by_hand(robot, frames):
    """Positions in the heading frame of each one's own anchor: its x and y taken off, its yaw turned back."""

    def heading_frame(bodies: Bodies) -> np.ndarray:
        anchor = robot.anchor
        yaw = Rotation.from_quat(np.asarray(bodies.quat[0, anchor]), scalar_first=True).as_euler("ZYX")[0]
        offset = np.asarray(bodies.pos[0]) - [*np.asarray(bodies.pos[0, anchor, :2]), 0.0]
        return Rotation.from_euler("z", -yaw).apply(offset)

    stand = jax.tree.map(lambda values: values[None], stand_frame(robot)).bodies
    step = happened(robot, stand_frame(robot), step_result(robot, frames, frames.bodies))
    expected = ((heading_frame(stand) - heading_frame(frames.bodies)) ** 2).sum(-1).mean()
    # The code turns by the yaw of the one anchor's orientation in the other's, which nods by 0.1 rad here.
    assert step.movement[0] == pytest.approx(expected, rel=2e-2)
    assert step.impact[0] == pytest.approx(2.5)
    assert (bool(step.head_contact[0]), bool(step.hand_contact[0])) == (False, True)


def test_a_tilt_that_the_clip_has_too_is_no_fall_but_a_low_root_is(robot, frames):
    tilt = Rotation.from_euler("y", 1.2)  # 69 degrees
    upright, tilted = frames.bodies, moved(frames.bodies, tilt, (0.0, 0.0, 0.7))
    low = moved(frames.bodies, tilt, (0.0, 0.0, -0.3))

    def fell(bodies: Bodies, clip: Bodies) -> bool:
        reference = dataclasses.replace(frames, bodies=clip)
        return bool(happened(robot, stand_frame(robot), step_result(robot, reference, bodies)).fallen[0])

    assert [fell(upright, upright), fell(tilted, upright), fell(tilted, tilted)] == [False, True, False]
    assert float(low.pos[0, robot.root, 2]) < 0.38
    assert fell(low, tilted)


@pytest.fixture(scope="module")
def rolled(tiny_setup):
    return roll_out(tiny_setup, {"zero_action": None, "again": None}, ["turn"], episodes=4, seed=0)


def test_the_zero_action_falls_and_stays_down_to_the_end(rolled, robot):
    rollout = rolled["zero_action"]
    assert (rollout.clip == 1).all()
    np.testing.assert_array_equal(rollout.start_frame[:2], 0)
    np.testing.assert_array_equal(rollout.horizon, 40 - rollout.start_frame)
    np.testing.assert_array_equal(rollout.steps, rollout.horizon + 150)  # 3 s
    assert rollout.happened.fallen.shape == (4, 190)
    last = rollout.steps - 1
    assert rollout.happened.fallen[np.arange(4), last].all()
    numbers = episode_numbers(rollout)
    assert not numbers["upright_rate"].any()
    assert (numbers["impact_force"] > 1.0).all()
    assert (numbers["time_to_fall"] > 0.2).all()
    assert (numbers["time_to_fall"] < 3.0).all()
    at_rest = rollout.happened.impact[np.arange(4), last]
    assert ((at_rest > 0.05) & (at_rest < 1.0)).all(), "on the floor, carried by several bodies"


def test_every_policy_meets_the_same_episodes(rolled):
    for one, two in zip(*(jax.tree.leaves(rollout.happened) for rollout in rolled.values()), strict=True):
        np.testing.assert_array_equal(one, two)


def test_a_held_frame_is_at_rest(library):
    held = lookup(library, jnp.array([1, 1]), jnp.array([40, 41]))
    np.testing.assert_array_equal(held.joint_pos[0], held.joint_pos[1])
    np.testing.assert_array_equal(held.bodies.pos[0], held.bodies.pos[1])
    for values in (held.joint_vel, held.bodies.lin_vel, held.bodies.ang_vel, held.anchor_lin_acc):
        assert np.abs(values[0]).max() > 1e-3
        assert not np.asarray(values[1]).any()


@pytest.fixture
def document(make_rollout):
    """The base stands in all of 4 episodes of `punch` and 2 of 4 of `kick`; the unlearned policy in none."""
    names, clip = ["walk", "punch", "kick"], [0, 0, 1, 1, 2, 2]
    rollout = make_rollout(clip, [10] * 6, [10] * 6, [0.5] * 6)
    policies = evaluate_policies({"base": rollout, "unlearned": rollout}, names, ["punch", "kick"], seed=0)
    clips = [1] * 4 + [2] * 4
    impact = {episode: {2: 0.5 * episode} for episode in range(8)}
    base = made_up([5] * 8, [5] * 8, clips, fallen={6: {4: 1}, 7: {4: 1}}, impact=impact)
    unlearned = made_up([5] * 8, [5] * 8, clips, fallen={episode: {0: 1} for episode in range(8)}, impact=impact)
    starts = np.array([0, 0, 3, 4] * 2)
    rolled = {
        name: dataclasses.replace(of, start_frame=starts) for name, of in (("base", base), ("unlearned", unlearned))
    }
    add_numbers(policies, rolled, names, seed=0)
    return EvaluationDocument(
        schema=1,
        robot="g1",
        checkpoint="here",
        config_hash="c",
        library_hash="l",
        seed=0,
        episodes=4,
        targets=["punch", "kick"],
        policies=policies,
    )


def test_numbers_of_groups_by_hand(document):
    base = document.policies["base"]
    upright = base.target.unbounded.all_starts.upright_rate
    exact = stats.binomtest(6, 8).proportion_ci(method="exact")
    assert (upright.mean, upright.low, upright.high, upright.n) == pytest.approx((0.75, exact.low, exact.high, 8))
    assert base.clips["kick"].unbounded.all_starts.upright_rate.mean == 0.5
    assert base.clips["kick"].unbounded.from_frame_0.upright_rate.mean == 1.0
    assert base.clips["kick"].unbounded.from_frame_0.upright_rate.n == 2
    assert base.clips["walk"].unbounded is None
    assert base.kept.unbounded is None
    # Impacts 0, 0.5 ... 3.5: half are at most 1.5, 95 % need all; above 1 are 5 of 8, and at frame 0 2 of 4.
    every, first = base.target.unbounded.all_starts, base.target.unbounded.from_frame_0
    assert (every.impact_force_median.mean, every.impact_force_95.mean) == (1.5, 3.5)
    assert (every.impact_rate.mean, first.impact_rate.mean) == (0.625, 0.5)
    assert every.impact_speed is None
    assert every.motion_content.mean == 0.0
    assert document.policies["unlearned"].target.unbounded.all_starts.time_to_fall.mean == pytest.approx(0.1)


def test_they_are_written_and_read_again_and_older_files_lack_them(document, tmp_path):
    write_evaluation(tmp_path / "evaluation.json", document)
    found = read_evaluation(tmp_path / "evaluation.json")
    assert found == document
    for policy in document.policies.values():
        for group in (policy.target, *policy.clips.values()):
            group.unbounded = None
    write_evaluation(tmp_path / "older.json", document)
    assert "unbounded" not in (tmp_path / "older.json").read_text()
    older = read_evaluation(tmp_path / "older.json")
    assert tables.unbounded_tables(older) == tables.unbounded_in_brief(older) == []
    assert "without terminations" not in tables.markdown(older)


def test_the_tables_have_them_over_all_starts_from_frame_0_and_by_clip(document):
    found = tables.unbounded_tables(document)
    assert [table.title.partition(", ")[2] for table in found] == [
        "all starts",
        "from frame 0",
        "punch, all starts",
        "kick, all starts",
    ]
    cells = {table.title: {row[0]: row[1:] for row in table.rows} for table in found}
    upright = {title: row["upright until the end"][0].partition(" [")[0] for title, row in cells.items()}
    assert list(upright.values()) == ["75 %", "100 %", "100 %", "50 %"]
    (brief,) = tables.unbounded_in_brief(document)
    assert brief.header == ["", "base", "unlearned"]
    assert [row[0] for row in brief.rows] == [
        "upright until the end",
        "impact above one body weight",
        "motion content",
        "upright until the end, from frame 0",
        "impact above one body weight, from frame 0",
        "motion content, from frame 0",
    ]
    assert [row[1].partition(" [")[0] for row in brief.rows] == ["75 %", "62 %", "0.000", "100 %", "50 %", "0.000"]


def test_a_quantile_is_one_of_the_values_and_its_interval_is_that_of_resamples():
    random = np.random.default_rng(0)
    values, strata = random.normal(size=40), np.repeat([0, 1], 20)
    weights = resampling_weights(strata, seed=1)
    for share in (0.5, 0.95):
        found = bootstrap_quantile(values, weights, share)
        assert found["mean"] == np.quantile(values, share, method="inverted_cdf")
        repeats = np.rint(weights[:500] * 19 / 20).astype(int)
        by_hand = [np.quantile(np.repeat(values, row), share, method="inverted_cdf") for row in repeats]
        low, high = np.percentile(by_hand, [2.5, 97.5])
        assert found["low"] == pytest.approx(low, abs=0.25)
        assert found["high"] == pytest.approx(high, abs=0.25)
        assert found["n"] == 40
    alone = bootstrap_quantile(values[:1], resampling_weights(np.zeros(1), seed=0), 0.5)
    assert alone == {"mean": values[0], "n": 1}
