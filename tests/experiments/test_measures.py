"""What each study runs and measures, with policies that a stand-in distinguishes by their paths: no run, no rollout."""

import dataclasses
import itertools
import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from experiments import from_scratch, heat_map, membership, overlap, physical_behaviour, relearning, training_dynamics
from forgetmimic_jax import unlearn
from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.evaluation.metrics import Rollout
from forgetmimic_jax.evaluation.repeats import Repeat
from forgetmimic_jax.motion.library import read_library
from forgetmimic_jax.settings.config import Config
from forgetmimic_jax.studies.lab import Lab
from forgetmimic_jax.studies.options import Options
from forgetmimic_jax.training.unlearning_run import config_of

TARGET, KEPT = "punch", "run"
FIRST, SECOND = "base 0, seed 0", "base 0, seed 1"
TRACKING = "survival_weighted_tracking"


class StandIn(Lab):
    """A lab of one base and two seeds, one target and one kept clip, whose runs are folders named LABEL-SEED."""

    def __init__(self, root: Path, iterations: int = 4):
        self.options, self.iterations = Options(episodes=4), iterations
        self.targets, self.repeats, self.controls = (TARGET,), (Repeat(0, 0), Repeat(0, 1)), ()
        self.config = Config()
        self.bases = (SimpleNamespace(path=root / "base", clips=(KEPT, TARGET), environment_steps=7 * 4096 * 24),)
        self.root, self.wanted = root, []

    def run(self, variants, what):
        self.wanted.append(dict(variants))
        folders = {(label, of): self.root / f"{label}-{of.seed}" for label, of in variants}
        for folder in folders.values():
            (folder / "checkpoints" / "00000004").mkdir(parents=True, exist_ok=True)
            (folder / "checkpoints" / "00000004" / "meta.json").touch()
        return folders


def name_of(policy: Path | None) -> str:
    """LABEL-SEED of a run's checkpoint, `base` or `zero`."""
    if policy is None:
        return "zero"
    return policy.name if policy.name == "base" else policy.parent.parent.name


def write_rows(path: Path, rows: list[dict]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))


def rollout(values: dict[str, list[float]], names: tuple[str, ...], lengths: list[int] | None = None) -> Rollout:
    """Episodes of four steps; `values` has the tracking reward of each episode of a clip, which is also its error."""
    clip = np.array([names.index(name) for name in values for _ in values[name]])
    reward = np.array(list(itertools.chain(*values.values())))[:, None] * np.ones(4)
    errors = dict.fromkeys(physical_behaviour.ERRORS, np.cumsum(reward, axis=1))
    return Rollout(
        clip=clip,
        start_frame=np.zeros(len(clip), int),
        horizon=np.full(len(clip), 4),
        length=np.array(lengths or [4] * len(clip)),
        tracking_reward=reward,
        errors=errors,
    )


def test_membership_learns_from_the_kept_clips_and_is_applied_to_the_targets(tmp_path):
    """The numbers differ if members and mirror images, or targets and kept clips, change places."""
    trained, untrained = [0.9, 0.8, 0.9, 0.8], [0.3, 0.2, 0.3, 0.2]
    on_target = {  # (the clip, its mirror image)
        "base": ([0.9, 0.9, 0.9, 0.1], [0.5, 0.5, 0.5, 0.5]),  # above in 12 of 16 pairs; 3 of 4 above every other
        "λ = 16-0": ([0.1, 0.1, 0.1, 0.1], [0.5, 0.5, 0.5, 0.5]),
        "λ = 16-1": ([0.6, 0.6, 0.4, 0.4], [0.5, 0.5, 0.5, 0.5]),
        "fine-tuned, all clips-0": (trained, untrained),
        "fine-tuned, all clips-1": (trained, untrained),
        "distilled-0": ([0.6, 0.4, 0.4, 0.4], [0.5, 0.5, 0.5, 0.5]),
        "distilled-1": ([0.4, 0.6, 0.6, 0.6], [0.5, 0.5, 0.5, 0.5]),
        "retrained-0": ([0.5, 0.5, 0.5, 0.5], [0.5, 0.5, 0.5, 0.5]),
    }

    class Attacked(StandIn):
        def rollouts(self, policies, clips=None, *, episodes=None, seed=0):
            names = tuple(clip.name for clip in clips)
            image = int(names[0].endswith("_mirrored"))
            of = {
                key: {names[0]: (trained, untrained)[image], names[1]: on_target[name_of(path)][image]}
                for key, path in policies.items()
            }
            return {key: rollout(values, names) for key, values in of.items()}, names

    lab = Attacked(tmp_path)
    measured = membership.measure(lab)
    assert measured["attacks"]["λ = 16"][FIRST]["episodes"] == 4
    found = membership.over_runs({"results": measured})
    hits = {
        **{"base": (12 / 16, 3 / 4, 1), "λ = 16": ((0 + 8 / 16) / 2, (0 + 2 / 4) / 2, 2)},
        **{"fine-tuned, all clips": (1.0, 1.0, 2), "distilled": ((4 / 16 + 12 / 16) / 2, (1 / 4 + 3 / 4) / 2, 2)},
        "retrained": (0.5, 0.0, 1),
    }
    assert found.keys() == hits.keys()
    for label, (auc, tpr, policies) in hits.items():
        assert found[label]["auc"]["mean"] == pytest.approx(auc), label
        assert found[label]["tpr_at_5_percent_fpr"]["mean"] == pytest.approx(tpr), label
        assert found[label]["auc"]["n"] == policies
    (wanted,) = lab.wanted
    assert wanted["λ = 16", Repeat(0, 1)] == {}
    assert wanted["fine-tuned, all clips", Repeat(0, 0)] == {"method": "finetune", "clips": "all"}
    assert wanted["distilled", Repeat(0, 1)] == {"method": "distill"}
    assert wanted["retrained", Repeat(0, 0)] == {"method": "retrain", "iterations": 7}


AT_START = {
    **{"base": 0.8, "unlearned-0": 0.1, "unlearned-1": 0.2, "distilled-0": 0.3, "distilled-1": 0.4},
    "retrained-0": 0.5,
}


@pytest.fixture
def _no_skills(monkeypatch):
    """Without the evaluations of the runs that trained the starts, which no stand-in has."""
    monkeypatch.setattr(relearning, "measured_skills", lambda folders: sorted(map(str, folders)))


class Relearned(StandIn):
    """Evaluations that say whose they are: of a start by its path and seed, of a run by where it started."""

    def as_watched(self, policies, seed):
        values = {label: AT_START[name_of(path)] + 0.01 * seed for label, path in policies.items()}
        return {label: {TARGET: {TRACKING: value}, KEPT: {TRACKING: 0.99}} for label, value in values.items()}

    def run(self, variants, what):
        folders = super().run(variants, what)
        for (label, repeat), variant in variants.items():
            if what != "relearning":
                continue
            seed = repeat.seed
            folder = self.root / "relearned" / f"{label}-{seed}"
            start = AT_START[name_of(variant["base"])] if "base" in variant else 0.0
            clips = [{TARGET: {TRACKING: start + 0.05 * i}, KEPT: {TRACKING: 0.99}} for i in (1, 2)]
            write_rows(
                folder / "evaluations.jsonl",
                [{"iteration": i, "clips": c} for i, c in zip((5, 10), clips, strict=True)],
            )
            log = [{"iteration": 10, "environment_steps": 1000, "target/step_share": 0.25 + 0.25 * seed}]
            write_rows(folder / "metrics.jsonl", log)
            folders[label, repeat] = folder
        return folders


@pytest.mark.usefixtures("_no_skills")
def test_relearning_starts_from_each_policy_and_its_levels_are_the_bases(tmp_path):
    lab = Relearned(tmp_path)
    found = relearning.measure(lab)
    assert found["base"] == pytest.approx({FIRST: 0.8, SECOND: 0.81})
    curves = {(label, repeat[-1]): of for label, runs in found["starts"].items() for repeat, of in runs.items()}
    assert curves.keys() == {
        *(("unlearned", "0"), ("unlearned", "1"), ("distilled", "0"), ("distilled", "1")),
        *(("retrained", "0"), ("fresh", "0"), ("fresh", "1")),
    }
    lab.repeats = (*lab.repeats, Repeat(1, 0))  # a second base would start the same fresh training
    fresh = {repeat for label, repeat in relearning.relearning_runs(lab, {}) if label == "fresh"}
    assert fresh == {Repeat(0, 0), Repeat(0, 1)}
    for (label, seed), curve in curves.items():
        at_start = AT_START.get(f"{label}-{seed}", 0.0)
        own = [] if label == "fresh" else [at_start + 0.01 * int(seed)]
        steps = [0.0, 125.0, 250.0] if seed == "0" else [0.0, 250.0, 500.0]
        assert curve["tracking"] == pytest.approx([*own, at_start + 0.05, at_start + 0.1]), (label, seed)
        assert curve["iterations"] == [0, 5, 10][-len(curve["tracking"]) :]
        assert curve["target_steps"] == pytest.approx(steps[-len(curve["tracking"]) :])


@pytest.mark.usefixtures("_no_skills")
def test_whatever_the_start_relearning_is_on_all_clips_half_on_targets_and_free_of_any_base(tmp_path):
    lab = Relearned(tmp_path)
    relearning.measure(lab)
    policies, relearned = lab.wanted
    assert policies["unlearned", Repeat(0, 1)] == {"iterations": 200}
    assert policies["distilled", Repeat(0, 0)] == {"iterations": 200, "method": "distill"}
    assert policies["retrained", Repeat(0, 0)] == {"method": "retrain", "iterations": 7}
    assert len(relearned) == 7
    settings = set()
    for (label, _), variant in relearned.items():
        given = {name: value for name, value in variant.items() if name != "base"}
        config = config_of(unlearn.Options(**{**given, "set": [variant["set"]]}))
        assert (variant["method"], "base" in variant) == (
            ("retrain", False) if label == "fresh" else ("finetune", True)
        ), label
        assert config.sampling.clips == "all"
        assert config.ppo.base_kl == 0.0
        assert config.wrench.max_gain == 0.0
        settings.add((config.sampling, config.ppo))
    ((sampling, ppo),) = settings  # the same for every start
    assert (sampling.rule, sampling.target_share, ppo.schedule) == ("uniform_clips", 0.5, "fixed")


def test_physical_behaviour_is_measured_on_the_targets_over_the_steps_that_all_survive(tmp_path):
    values = {"base": 0.1, "zero": 0.2} | {
        f"{label}-{seed}": value + 0.01 * seed
        for label, value in (("fine-tuned", 0.3), ("λ = 8", 0.4), ("λ = 16", 0.5))
        for seed in (0, 1)
    }
    lengths = {name: [4, 4, 4] for name in values} | {"λ = 16-1": [4, 3, 2], "zero": [1, 4, 3]}

    class Measured(StandIn):
        def rollouts(self, policies, clips=None, *, episodes=None, seed=0):
            names = (KEPT, TARGET)
            of = {key: name_of(path) for key, path in policies.items()}
            return {
                key: rollout({KEPT: [0.9], TARGET: [values[name]] * 2}, names, lengths[name])
                for key, name in of.items()
            }, names

        def unbounded(self, policies):
            numbers = dict.fromkeys(physical_behaviour.tables.UNBOUNDED, np.array([1.0, np.nan]))
            return {
                key: {**numbers, "impact_force": np.array([0.0, 10.0 * values[name_of(path)]])}
                for key, path in policies.items()
            }

    measured = physical_behaviour.measure(Measured(tmp_path))
    found = measured["policies"]
    assert {label: list(runs) for label, runs in found.items()} == {
        **{"base": [FIRST], "zero action": [FIRST]},
        **{key: [FIRST, SECOND] for key in ("fine-tuned", "λ = 8", "λ = 16")},
    }
    assert found["base"][FIRST]["episode_length"] == [4.0, 4.0]
    assert found["zero action"][FIRST]["episode_length"] == [4.0, 3.0]
    assert found["λ = 16"][SECOND]["episode_length"] == [3.0, 2.0]
    # the error grows by its value each step: its mean over n steps is (n + 1) / 2 times the value
    assert found["λ = 8"][SECOND]["foot_contact"] == pytest.approx([2.5 * 0.41, 2.5 * 0.41])
    assert found["λ = 8"][SECOND]["foot_contact_common"] == pytest.approx([2.0 * 0.41, 1.5 * 0.41])
    assert found["λ = 16"][FIRST]["foot_contact_common"] == pytest.approx([2.0 * 0.5, 1.5 * 0.5])
    unbounded = measured["unbounded"]
    assert unbounded["λ = 8"][SECOND]["upright_rate"] == [1.0, None]
    assert unbounded["λ = 8"][SECOND]["impact_force"] == pytest.approx([0.0, 4.1])


def test_numbers_without_terminations_are_over_the_runs_and_the_episodes_that_define_them():
    def run(upright: list, impact: list, speed: list) -> dict:
        numbers = {name: [0.25] for name in physical_behaviour.tables.UNBOUNDED}
        return numbers | {"upright_rate": upright, "impact_force": impact, "impact_speed": speed}

    policies = {
        "base": {FIRST: run([1.0, 1.0], [0.0, 2.0], [None, None])},
        "λ = 16": {
            FIRST: run([0.0, 1.0, None], [1.0, 2.0, 9.0], [2.0, None, 4.0]),
            SECOND: run([0.0, 0.0], [3.0, 5.0], [None, None]),
        },
    }
    table = physical_behaviour.unbounded_table(policies)
    rows = {(cells := line.strip("| ").split(" | "))[0]: cells[1:] for line in table.splitlines() if "|" in line}
    assert rows["upright until the end"] == ["100 %", "25 % [0, 100]"]
    assert rows["largest impact, median, body weights"][0] == "0.000"
    assert rows["largest impact, median, body weights"][1].startswith("2.500 [0.000, ")
    assert rows["largest impact, 95th percentile, body weights"][1].startswith("7.000")
    assert table.count("\n| root's speed downward before the first impact, m/s |  | 3.000 |") == 1
    assert physical_behaviour.unbounded_table({}) == ""


def test_the_heat_map_has_the_base_first_and_then_every_evaluation_of_each_seed(tmp_path):
    def clips(target: float, kept: float) -> dict:
        return {
            clip: {TRACKING: value, "tracking_reward": value + 0.1, "success_rate": 1.0}
            for clip, value in ((KEPT, kept), (TARGET, target))
        }

    class Watched(StandIn):
        def as_watched(self, policies, seed):
            assert policies == {"base": self.bases[0].path}
            return {"base": clips(0.8 + 0.1 * seed, 0.7)}

    lab = Watched(tmp_path, iterations=42)
    for seed in (0, 1):
        rows = [{"iteration": i, "clips": clips(0.5 - 0.2 * seed, 0.6)} for i in (2, 4)]
        write_rows(tmp_path / f"λ = 16-{seed}" / "evaluations.jsonl", rows)
    found = heat_map.measure(lab)
    assert found["iterations"] == [0, 2, 4]
    document = {"conditions": {"targets": [TARGET]}, "results": found}
    checkpoints, groups = (heat_map.over_runs(document, of) for of in ("checkpoints", "groups"))
    assert [at[TARGET][TRACKING]["mean"] for at in checkpoints] == pytest.approx([0.85, 0.4, 0.4])
    assert [at["target"][TRACKING]["mean"] for at in groups] == pytest.approx([0.85, 0.4, 0.4])
    assert [at["kept"]["tracking_reward"]["mean"] for at in groups] == pytest.approx([0.8, 0.7, 0.7])
    assert [at[TARGET][TRACKING] for at in found["runs"][SECOND]] == pytest.approx([0.9, 0.3, 0.3])
    assert lab.wanted == [{("λ = 16", of): {"set": ["evaluate_every=2", "evaluate_episodes=2"]} for of in lab.repeats}]


def test_trainings_from_scratch_are_on_all_clips_and_compared_over_all_evaluations(tmp_path):
    """By hand, tracking of the two clips: adaptive 0.5 and 0.7, uniform 0.2 and 0.6; so 0.2 more in the mean."""
    lab = StandIn(tmp_path, iterations=16)
    tracking = {
        from_scratch.ADAPTIVE: [(0.4, 0.6), (0.6, 0.8)],
        from_scratch.WITH_WRENCH: [(0.4, 0.6), (0.6, 0.8)],
        from_scratch.UNIFORM: [(0.1, 0.3), (0.5, 0.7)],
    }
    for label, evaluations in tracking.items():
        clips = [{TARGET: one, KEPT: other} for one, other in evaluations]
        rows = [
            {
                "environment_steps": 100 * (place + 1),
                "clips": {c: {TRACKING: v, "success_rate": v / 2} for c, v in at.items()},
            }
            for place, at in enumerate(clips)
        ]
        for seed in range(2):
            write_rows(tmp_path / f"{label}-{seed}" / "evaluations.jsonl", rows)
    found = from_scratch.measure(lab)
    (wanted,) = lab.wanted
    assert set(wanted) == {(label, repeat) for label in tracking for repeat in lab.repeats}
    assert wanted[from_scratch.UNIFORM, Repeat(0, 0)] == {
        **{"method": "retrain", "clips": "all", "sampler": "uniform_clips"},
        "set": ["evaluate_every=2", "evaluate_episodes=2"],
    }
    assert found["environment_steps"] == [100, 200]
    document = {"results": found}
    more = from_scratch.gained(document, from_scratch.ADAPTIVE, from_scratch.UNIFORM, TRACKING)
    assert more == {FIRST: pytest.approx(0.2), SECOND: pytest.approx(0.2)}
    words = [(of.claim, of.evidence, of.word) for of in from_scratch.findings(document)]
    assert words[0][0] == "The wrench helps a training from scratch"
    assert words[0][1].startswith("tracking with it minus without 0.00")
    assert words[1][1:] == (
        "tracking with it minus without 0.200, success 10 %; bound 0",
        "one value",  # as both trainings are the same here
    )
    assert found["episodes"] == 4  # of the two clips, two each
    # One success of eight, exactly: 0.3 % to 53 %.
    assert "| uniform RSI | 2 | 10 % [0, 53]" in from_scratch.body(document)


def test_overlap_forgets_half_a_clip_and_keeps_the_other_on_a_library_of_its_own(tmp_path, library_folder, robot):
    config = dataclasses.replace(Config(), library=str(library_folder))

    class Halved(StandIn):
        def over_repeats(self, variants, what, *, others):
            self.wanted.append(others)
            return {"variants": {}}

    lab = Halved(tmp_path)
    lab.options = Options(trials=tmp_path / "trials")
    lab.config, lab.bases = config, (SimpleNamespace(path=tmp_path / "base", library_hash="abcd"),)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(overlap, "write_base", lambda base, library, folder: folder / "base")
        neighbours = {"nod": "turn", "sway_first_half": "sway_second_half"}
        found = overlap.measure(lab, neighbours, "sway")
        assert overlap.measure(lab, neighbours, "sway") == found  # from the library that is there now
        with pytest.raises(InputError, match=r"no clip 'swing' in its library; known: sway_first_half, "):
            overlap.measure(lab, {"swing": "turn"}, "sway")
    folder = tmp_path / "trials" / "halves-of-sway-abcd"
    wanted = lab.wanted[0]["sway_first_half"]
    library = folder / "clips"
    given = {"targets": "sway_first_half", "library": library, "base": folder / "base"}
    assert wanted == {repeat: given for repeat in lab.repeats}
    whole, *halves = (
        clip.joint_pos
        for path, names in ((library_folder, ["sway"]), (library, ["sway_first_half", "sway_second_half"]))
        for clip in read_library(robot, path, names)
    )
    assert np.array_equal(np.concatenate(halves), whole)
    assert {clip.name for clip in read_library(robot, library)} == {"nod", "turn", *neighbours, "sway_second_half"}
    assert found["distances"]["nod"].keys() == {"turn", "sway_first_half", "sway_second_half"}
    clip = read_library(robot, library, ["turn"])[0]
    still, *others = (
        dataclasses.replace(clip, name=name, joint_pos=np.full_like(clip.joint_pos, at))
        for name, at in (("still", 0.0), ("near", 0.1), ("far", 0.3))
    )
    assert overlap.distances_to("still", [still, *others]) == pytest.approx({"near": 0.1, "far": 0.3})


def test_training_curves_are_over_the_rows_that_every_seed_has(tmp_path):
    for label, seed in itertools.product(training_dynamics.CONFIGURATIONS, (0, 1)):
        rows = [{"iteration": at, "entropy": at + seed} for at in ((1, 10, 13, 20) if seed else (1, 10, 20))]
        rows[-1]["target/lambda_crit"] = 7.0 + seed
        if seed:
            rows[0]["target/lambda_crit"] = 9.0  # in one seed alone
        write_rows(tmp_path / f"{label}-{seed}" / "metrics.jsonl", rows)
    lab = StandIn(tmp_path)
    found = training_dynamics.measure(lab)["configurations"]
    assert list(found) == [training_dynamics.A, training_dynamics.B]
    of = found[training_dynamics.B]
    assert of["iterations"] == [1, 10, 20]
    rows = training_dynamics.over_runs(of)
    assert [row["entropy"]["mean"] for row in rows] == [1.5, 10.5, 20.5]
    assert [row.get("target/lambda_crit", {}).get("mean") for row in rows] == [9.0, None, 7.5]
    assert [row["entropy"] for row in of["runs"][SECOND]] == [2, 11, 21]
    (wanted,) = lab.wanted
    assert wanted[training_dynamics.A, Repeat(0, 1)] == {"penalty": 2.0, "sampler": "adaptive", "wrench": True}
    assert wanted[training_dynamics.B, Repeat(0, 0)] == {"penalty": 8.0}
