"""What each study says of the paper's claims, from numbers made up for it."""

import math

import numpy as np
import pytest

from experiments import (
    comparison,
    heat_map,
    membership,
    overlap,
    physical_behaviour,
    relearning,
    training_dynamics,
    validity,
)
from forgetmimic_jax.attacks.pace import sooner_than_control
from forgetmimic_jax.evaluation.relearning import Lasted
from forgetmimic_jax.evaluation.repeats import Repeat
from forgetmimic_jax.evaluation.statistics import over_seeds
from forgetmimic_jax.studies import claim, penalty, samplers, targets
from forgetmimic_jax.studies.findings import mean_gained
from forgetmimic_jax.studies.variants import DEVIATION

REPEATS = [str(Repeat(0, seed)) for seed in range(3)]


def variant(target: list[float], kept: list[float], base: float = 0.6, skill: list[float] | None = None) -> dict:
    """As a study's JSON has it, a seed each of one base."""

    def group(value: float) -> dict:
        return {"success_rate": value, "survival_weighted_tracking": value, "episodes": 4000}

    runs = {
        str(Repeat(0, seed)): {
            "policy": {"target": group(a), "kept": group(b)},
            "base": {"target": group(0.8), "kept": group(base)},
        }
        for seed, (a, b) in enumerate(zip(target, kept, strict=True))
    }
    for run, value in zip(runs.values(), skill or [], strict=False):
        run["policy"]["target"]["skill"] = value
    return {"options": {}, "runs": runs}


def words(findings) -> dict[str, str]:
    return {found.claim: found.word for found in findings}


def test_differences_are_between_runs_of_the_same_repeat():
    found = {"a": variant([0.0, 0.1], [0.5, 0.7]), "b": variant([0.1], [0.45])}
    assert mean_gained(found, "a", None, "kept", "success_rate")["mean"] == pytest.approx(0.0)
    only = mean_gained(found, "a", "b", "kept", "success_rate")
    assert only == {"mean": pytest.approx(0.05), "n": 1, "unit": "seed"}
    assert mean_gained(found, "a", "c", "kept", "success_rate") is None


def test_the_default_run_is_compared_with_its_control_the_ratio_and_zero_actions():
    label, control = (validity.at_length(of) for of in ("λ = 16", validity.CONTROL))
    found = {
        "λ = 8": variant([0.5, 0.52, 0.51], [0.6, 0.6, 0.6]),
        label: variant([0.0, 0.0, 0.0], [0.6, 0.6, 0.6], skill=[-0.1, -0.12, -0.11]),
        control: variant([0.8, 0.8, 0.8], [0.67, 0.68, 0.69]),
    }
    runs = found[label]["runs"].values()
    for steps, ratio, run in zip((9.0, 9.5, 10.0), (0.05, 0.06, 0.07), runs, strict=True):
        run["policy"]["survival_weighted_degradation_ratio"] = ratio
        run["policy"]["target"] |= {"episode_length": steps, DEVIATION: 0.01 * steps}
        run["zero_action"] = {"target": {"episode_length": 17.0, DEVIATION: 0.05}}
    document = {"results": {"variants": found}}
    every = list(validity.findings(document))
    assert [(of.claim.removeprefix(f"{label}: "), of.word) for of in every if of.main] == [
        ("the targets are no longer completed", "holds"),
        ("the skill on the targets is gone", "holds"),
        ("the kept clips stay as they were", "holds"),
    ]
    assert [(of.claim.removeprefix(f"{label}: "), of.word) for of in every if not of.main] == [
        ("λ = 8: the targets are no longer completed", "does not hold"),
        ("λ = 8: the kept clips stay as they were", "holds"),
        ("the kept clips are as after fine-tuning alone", "does not hold"),
        ("the targets' tracking is under a tenth of the kept clips'", "holds"),
        ("the policy lacks the skill and does not end episodes on purpose", "does not hold"),
        ("until it falls it is no further off a target than the zero-action baseline", "does not hold"),
    ]
    assert every[-2].evidence == (
        "length of target episodes minus the zero-action baseline's -7.5 [-8.7, -6.3] steps; bound -1"
    )
    assert every[-1].evidence.startswith(
        "largest key body error minus the zero-action baseline's 0.045 [0.033, 0.057] m, of 0.050 m, on the steps"
    )
    assert validity.answer(document) == (
        f"With {label}, 0 % [0, 0] of the target episodes succeed, -11 % [-13, -9] of the skill is retained (below 0: "
        "worse than with zero actions), and the success rate on the other clips changes by 0 % [-1, 1] against the "
        "base."
    )


def test_the_comparison_by_hand():
    prefix = f"{comparison.ARFT}, "
    found = {
        comparison.ARFT: variant([0.1, 0.1, 0.1], [0.59, 0.60, 0.61]),
        comparison.CONTROL: variant([0.8, 0.8, 0.8], [0.60, 0.61, 0.62]),
        comparison.PLAIN_ARFT: variant([0.2, 0.2, 0.2], [0.4, 0.4, 0.4]),
        "negated reward, plain PPO": variant([0.0, 0.0, 0.0], [0.1, 0.12, 0.11]),
        "decremental, plain PPO": variant([0.0, 0.0, 0.0], [0.5, 0.51, 0.52]),
        "trajdeleter, plain PPO": variant([0.3, 0.31, 0.32], [0.5, 0.3, 0.4]),
        f"{prefix}uniform clips": variant([0.2, 0.2, 0.2], [0.59, 0.60, 0.61]),
        f"{prefix}uniform clips, wrench": variant([0.3, 0.2, 0.2], [0.6, 0.6, 0.6]),
        f"{prefix}adaptive": variant([0.4, 0.3, 0.2], [0.4, 0.6, 0.5]),
        f"{prefix}adaptive, wrench": variant([0.4, 0.5, 0.6], [0.4, 0.6, 0.5]),
        f"{prefix}frozen": variant([0.6, 0.6, 0.6], [0.6, 0.6, 0.6]),
        f"{prefix}frozen, wrench": variant([0.7, 0.71, 0.7], [0.6, 0.6, 0.6]),
    }
    document = {"results": {"variants": found}}
    every = list(comparison.findings(document))
    assert words(of for of in every if of.main) == {
        "arft keeps the other clips better than negated reward (both plain PPO)": "holds",
        "arft keeps the other clips better than decremental (both plain PPO)": "does not hold",
        "arft keeps the other clips better than trajdeleter (both plain PPO)": "open",
    }
    assert words(of for of in every if not of.main) == {
        "arft forgets more than trajdeleter (both plain PPO)": "holds",
        "λ = 16: the kept clips are as after fine-tuning without an anti-reward": "holds",
        "adaptive sampling resists forgetting": "holds",
        "adaptive sampling costs the kept clips": "open",
        "the feedback of adaptive sampling resists forgetting": "does not hold",
        "the feedback of adaptive sampling costs the kept clips": "open",
    }
    assert "0.29 [0.27, 0.31] (negated reward); -0.11 [-0.13, -0.09] (decremental)" in comparison.answer(document)
    pairs = [(f"{prefix}adaptive{more}", f"{prefix}uniform clips{more}") for more in ("", ", wrench")]
    by_hand = [(0.2 + 0.1) / 2, (0.1 + 0.3) / 2, (0.0 + 0.4) / 2]
    effect = samplers.effect(found, pairs, "target")
    assert effect.pop("unit") == "seed"
    assert effect == pytest.approx(over_seeds(by_hand))
    found[f"{prefix}uniform clips"] = variant([0.2], [0.6])
    assert samplers.effect(found, pairs, "target") == {"mean": pytest.approx(0.15), "n": 1, "unit": "seed"}


def test_a_policy_that_falls_sooner_than_with_zero_actions_does_not_only_lack_a_skill():
    policies = {
        "base": {"base 0, seed 0": {"episode_length": [60.0, 64.0]}},
        "zero action": {"base 0, seed 0": {"episode_length": [16.0, 18.0]}},
        "λ = 16": {str(Repeat(0, seed)): {"episode_length": [5.0, 6.0 + seed]} for seed in range(3)},
    }
    document = {"results": {"policies": policies}}
    assert [of.word for of in physical_behaviour.findings(document)] == ["does not hold"]
    # means of 5.5, 6 and 6.5 steps
    assert physical_behaviour.answer(document) == (
        "An episode of a target lasts 6.0 [4.8, 7.2] steps; with the base 62.0, with zero actions 17.0."
    )
    for seed, run in enumerate(policies["λ = 16"].values()):
        run["episode_length"] = [17.0, 17.0 + seed]
    measured = ("foot_contact", "joint_limit_violation", DEVIATION)
    for label, values in (("base", (0.6, 0.1, 0.1)), ("zero action", (0.8, 0.2, 0.12))):
        policies[label]["base 0, seed 0"] |= {name: [value] for name, value in zip(measured, values, strict=True)}
    for seed, run in enumerate(policies["λ = 16"].values()):
        run |= {name: [value + 0.01 * seed] for name, value in zip(measured, (0.4, 0.09, 0.2), strict=True)}
    found = list(physical_behaviour.findings(document))
    assert [(of.word, of.main) for of in found] == [
        *(("holds", True), ("does not hold", True), ("holds", False), ("open", False))
    ]
    assert found[1].evidence == (
        "max key body position error, common steps minus the zero action's 0.090 [0.065, 0.115]; bound 0"
    )
    assert found[2].evidence == "foot contact minus the base's -0.190 [-0.215, -0.165]; bound 0"
    # With three bases each run is compared with its own: 0.40 - 0.45, 0.41 - 0.60 and 0.42 - 0.45. The zero-action
    # baseline has no base: 0.20 - 0.12, 0.21 - 0.12 and 0.22 - 0.12.
    runs = policies["λ = 16"].values()
    policies["λ = 16"] = {str(Repeat(base, 0)): run for base, run in enumerate(runs)}
    first = policies["base"]["base 0, seed 0"]
    policies["base"] = {
        str(Repeat(base, 0)): {**first, "foot_contact": [contact]} for base, contact in enumerate((0.45, 0.60, 0.45))
    }
    feet = physical_behaviour.minus(policies, "λ = 16", "base", "foot_contact")
    assert (feet["mean"], feet["n"], feet["unit"]) == (pytest.approx(-0.09), 3, "base")
    assert feet["std"] == pytest.approx(np.std([-0.05, -0.19, -0.03], ddof=1))
    assert physical_behaviour.minus(policies, "λ = 16", "zero action", DEVIATION)["mean"] == pytest.approx(0.09)


def test_the_training_curves_are_compared_with_what_the_paper_reads_off_them():
    def rows(first: dict[str, list[float]], last: dict[str, list[float]]) -> dict:
        runs = {
            repeat: [{name: of[seed] for name, of in at.items()} for at in (first, last)]
            for seed, repeat in enumerate(REPEATS[: len(first["entropy"])])
        }
        return {"iterations": [1, 200], "runs": runs}

    def found(of: dict) -> list[str]:
        return [one.word for one in training_dynamics.findings({"results": {"configurations": of}})]

    start = {"entropy": [5.0] * 3, "wrench_gain": [0.1, 0.11, 0.12], "top_bin_probability": [0.03] * 3}
    end = {"entropy": [4.0, 4.1, 4.2], "wrench_gain": [0.11, 0.13, 0.12], "top_bin_probability": [0.02, 0.021, 0.022]}
    assert found({training_dynamics.A: rows(start, end)}) == ["holds", "open", "does not hold"]
    anti = {"entropy": [5.0] * 3, "target/R_anti": [-10.0, -11.0, -9.0]}
    gone = {"entropy": [5.5, 5.6, 5.7], "target/R_anti": [-0.5, -0.6, -0.7]}
    b = training_dynamics.B
    assert found({b: rows(anti, gone)}) == ["holds", "holds"]
    assert found({b: rows(anti, {**gone, "target/R_anti": [-8.0, -8.1, -8.2]})}) == ["holds", "does not hold"]
    assert found({b: rows({n: v[:1] for n, v in anti.items()}, {n: v[:1] for n, v in gone.items()})}) == [
        "one run: yes",
        "one run: yes",
    ]


def test_training_curves_are_compared_run_by_run_and_not_where_only_means_are_stored():
    runs = {
        "base 0, seed 0": [{"entropy": 5.0}, {"entropy": 4.0}],
        "base 0, seed 1": [{"entropy": 9.0}, {"entropy": 7.0}],
    }
    assert training_dynamics.risen({"runs": runs}, "entropy")["mean"] == -1.5
    assert training_dynamics.risen({"runs": runs}, "entropy", 0.2)["mean"] == pytest.approx(0.5 * (3.0 + 5.2))
    assert training_dynamics.risen({"rows": [{}, {}]}, "entropy") is None


def swept(skills: dict[float, list[float]]) -> dict:
    """As the JSON of the penalties has it: by penalty, the skill of each seed."""
    return {
        str(penalty): {
            "options": {"penalty": str(penalty)},
            "runs": {
                str(Repeat(0, seed)): {"policy": {"target": {"skill": skill}}, "lambda_crit": 7.6 + 0.1 * seed}
                for seed, skill in enumerate(of)
            },
        }
        for penalty, of in skills.items()
    }


@pytest.mark.parametrize(
    ("skills", "word", "evidence"),
    [
        # 4 x 2^(0.4 / 0.8), 4 x 2^(0.4 / 0.78) and 4 x 2^(0.4 / 0.79)
        ({4.0: [0.9, 0.9, 0.9], 8.0: [0.1, 0.12, 0.11]}, "holds", "5.7 [5.6, 5.7]"),
        # 8 x 2^(0.4 / 0.8)
        ({8.0: [0.9, 0.9, 0.9], 16.0: [0.1, 0.1, 0.1]}, "one value", "11.3"),
        # the second seed's half is gone below 4: 5.7, at most 4 and 5.7 are below 8 in the mean, [2.7, 7.5]
        ({4.0: [0.9, 0.3, 0.9], 8.0: [0.1, 0.05, 0.1]}, "holds", "5.7, below 4, 5.7 (run by run)"),
        ({4.0: [0.3, 0.3, 0.3], 8.0: [0.1, 0.1, 0.1]}, "open", "below 4, below 4, below 4 (run by run)"),
        # one seed needs more than was tried
        ({4.0: [0.9, 0.9, 0.9], 8.0: [0.1, 0.1, 0.9]}, "open", "5.7, 5.7, above 8 (run by run)"),
        ({4.0: [0.9, 0.9, 0.9], 16.0: [0.9, 0.9, 0.9]}, "open", "above 16, above 16, above 16 (run by run)"),
        # below the smallest says nothing of a bound that is smaller still
        ({12.0: [0.3, 0.3, 0.3], 16.0: [0.1, 0.1, 0.1]}, "open", "below 12, below 12, below 12 (run by run)"),
        ({4.0: [0.3, 0.9, 0.9], 16.0: [0.1, 0.9, 0.9]}, "open", "below 4, above 16, above 16 (run by run)"),
        ({4.0: [0.3]}, "one run: yes", "below 4 (run by run)"),
        ({16.0: [0.9]}, "one run: no", "above 16 (run by run)"),
        ({16.0: [0.3]}, "open", "below 16 (run by run)"),
    ],
)
def test_half_of_the_skill_gone_below_w_is_checked_in_every_run(skills, word, evidence):
    document = {"results": {"variants": swept(skills)}}
    (found,) = penalty.findings(document)
    assert found.word == word
    assert found.evidence.startswith(f"half of the skill on the targets is gone at λ = {evidence}; bound 8; λ_crit on")
    if len(skills[next(iter(skills))]) == 3:
        assert found.evidence.endswith("λ_crit on the base's steps 7.70 [7.45, 7.95]")


def test_half_of_the_skill_is_gone_between_two_penalties_before_the_first_or_after_the_last():
    crossed = 8.0 * 2.0 ** (0.2 / 0.6)
    assert penalty.half_gone({16.0: 0.1, 4.0: 0.9, 8.0: 0.7}) == pytest.approx((crossed, crossed))
    assert penalty.half_gone({4.0: 0.3, 8.0: 0.7, 16.0: 0.1}) == (0.0, 4.0)
    assert penalty.half_gone({4.0: 0.5}) == (0.0, 4.0)
    assert penalty.half_gone({4.0: 0.9, 16.0: 0.6}) == (16.0, math.inf)


def test_wear_is_what_the_kept_clips_lose_of_their_start():
    def found(end: list[float], start: tuple[float, ...] = (0.8, 0.8, 0.8)):
        runs = {
            repeat: [{"run": {name: value for name in heat_map.SHOWN}} for value in (start[seed], 0.1, end[seed])]
            for seed, repeat in enumerate(REPEATS)
        }
        for run in runs.values():
            for at in run:
                at["kick"] = dict.fromkeys(heat_map.SHOWN, 0.3)
        document = {
            "conditions": {"iterations": 1000, "targets": ["kick"]},
            "results": {"iterations": [0, 500, 1000], "runs": runs},
        }
        (one,) = heat_map.findings(document)
        return one

    assert found([0.78, 0.79, 0.80]).word == "holds"
    assert found([0.5, 0.51, 0.52]).word == "does not hold"
    assert found([0.7, 0.8, 0.75]).word == "open"
    # Every run is compared with its own start: 0.3 - 0.285, 0.61 - 0.57 and 0.88 - 0.855.
    paired = found([0.30, 0.61, 0.88], start=(0.3, 0.6, 0.9))
    assert (
        paired.evidence
        == "kept tracking at the end minus 95 % of that at the start 0.027 [-0.005, 0.058]; bound 0"
        + ("; with this mean and spread 4 seeds would decide")
    )
    assert found([0.7, 0.8, 0.75]).claim == "the kept clips are not worn down after 1,000 iterations"


def test_any_motion_is_forgotten_and_the_others_stay():
    runs = {
        "run": variant([0.0, 0.0, 0.0], [0.4, 0.41, 0.42], skill=[0.1, 0.12, 0.11]),
        "dance": variant([0.0, 0.0, 0.0], [0.6, 0.6, 0.6], skill=[0.5, 0.52, 0.51]),
    }
    found = targets.findings({"conditions": {"robot": "g1"}, "results": {"variants": runs}})
    assert words(found) == {
        "run: forgotten on the G1": "holds",
        "run: the kept clips stay as they were": "does not hold",
        "dance: forgotten on the G1": "does not hold",
        "dance: the kept clips stay as they were": "holds",
    }


@pytest.mark.parametrize(
    ("auc", "hits", "expected"),
    [
        ([0.9, 0.92, 0.91], [0.9, 0.9, 0.91], ["does not hold", "does not hold"]),
        ([0.1, 0.12, 0.11], [0.0, 0.0, 0.0], ["does not hold", "holds"]),  # marked by having been forgotten
        ([0.4, 0.5, 0.6], [0.0, 0.1, 0.05], ["open", "open"]),
        ([0.4, 0.5, 0.6], [0.2, 0.21, 0.22], ["open", "does not hold"]),
        ([0.9], [0.9], ["open", "one run: no"]),
    ],
)
def test_membership_shows_in_the_auc_on_either_side_and_in_the_hits(auc, hits, expected):
    of = {
        repeat: {"auc": one, "tpr_at_5_percent_fpr": other, "episodes": 40}
        for repeat, one, other in zip(REPEATS, auc, hits, strict=False)
    }
    wanted = {"targets": ["punch", "kick"], "episodes": 20}
    found = list(membership.findings({"conditions": wanted, "results": {"attacks": {"λ = 16": of}}}))
    assert [one.word for one in found] == expected
    assert [one.main for one in found] == [True, False]
    of |= {repeat: one | {"marked_at_5_percent_fpr": 1.0 - one["auc"]} for repeat, one in of.items()}
    more = list(membership.findings({"conditions": wanted, "results": {"attacks": {"λ = 16": of}}}))
    assert [one.word for one in more[:2]] == expected
    assert ("marked at 5 % FPR" in more[2].evidence, more[2].main) == (True, False)
    assert "; guessing 0.07" in found[1].evidence  # of 41 alike, one is among the first three in 3 of 41 cases


def curve(at: int, first: float = 0.1) -> dict:
    """Tracking of 0.9 from iteration `at` on, 0.1 before, `first` at the start; 100 target steps an iteration."""
    tracking = [first, *(0.9 if step >= at else 0.1 for step in range(1, 6))]
    return {"iterations": list(range(6)), "target_steps": [100.0 * step for step in range(6)], "tracking": tracking}


def relearned(unlearned: list[int], distilled: list[int]) -> list:
    starts = {
        label: {str(Repeat(0, seed)): curve(at) for seed, at in enumerate(of)}
        for label, of in (("unlearned", unlearned), ("distilled", distilled))
    }
    return list(relearning.findings({"results": relearning_results(starts)}))


GOOD = {"mean": 0.9, "low": 0.85, "n": 9}  # of the kept clips' skill


def relearning_results(starts: dict, kept: float = 0.9) -> dict:
    """The study's JSON with controls that retain so much of the kept clips' skill, at the least."""
    skill = {"mean": kept + 0.05, "low": kept, "high": kept + 0.1, "n": 200}
    base = dict.fromkeys(REPEATS, 0.9)
    return {"base": base, "starts": starts, "kept_skill": {label: dict.fromkeys(REPEATS, skill) for label in starts}}


@pytest.mark.parametrize(
    ("unlearned", "distilled", "word"),
    [
        ([1, 2, 1], [4, 4, 4], "does not hold"),
        ([3, 4, 3], [1, 1, 1], "holds"),
        ([1, 2, 1], [1, 1, 4], "open"),
        ([1, 2, 1], [4, 9, 9], "does not hold"),  # later than their runs' ends, which is late enough
        ([1, 9, 1], [4, 4, 4], "open"),
        ([9, 9, 9], [1, 2, 1], "holds"),  # never, where the control gets there
        ([9, 9, 9], [9, 9, 9], "open"),
        ([4], [1], "one run: yes"),
        ([4], [9], "one run: no"),
        ([9], [4], "one run: yes"),
        ([9], [9], "open"),
    ],
)
def test_what_comes_back_sooner_than_it_is_learned_was_not_forgotten(unlearned, distilled, word):
    found = relearned(unlearned, distilled)
    assert len(found) == len(relearning.LEVELS)
    assert {one.word for one in found} == {word}
    assert [one.main for one in found] == [False, True, False]


def overlap_document(retained: dict[str, list[float]], distances: dict[str, float]) -> dict:
    """One target, `kick`; the kept clips' retention by repeat, of clips that the base tracks at 0.5."""
    runs = {
        repeat: {
            "policy": {"clips": {clip: 0.5 * of[place] for clip, of in retained.items()}, "target": {"skill": 0.1}},
            "base": {"clips": {**dict.fromkeys(retained, 0.5), "lost": 0.04}},
        }
        for place, repeat in enumerate(REPEATS)
    }
    results = {"variants": {"kick": {"options": {}, "runs": runs}}, "distances": {"kick": distances}}
    return {"conditions": {"neighbours": {"kick": "spinkick"}}, "results": results}


def test_what_is_near_a_target_loses_more_by_rank_and_against_the_others():
    far = {"spinkick": 0.1, "punch": 0.2, "run": 0.3, "walk": 0.4, "lost": 0.05}
    retained = {"spinkick": [0.5, 0.6, 0.7], "punch": [0.9, 0.8, 0.9], "run": [0.8, 0.9, 1.0], "walk": [1.0, 1.0, 1.1]}
    document = overlap_document(retained, far)
    # Ranks 1 3 2 4, 1 2 3 4 and 1 2 3 4 of retention: 1 - 6 * 2 / (4 * 15) = 0.8, then 1 and 1.
    assert overlap.correlations(document["results"]) == pytest.approx(dict(zip(REPEATS, (0.8, 1.0, 1.0), strict=True)))
    rises, less, gone = overlap.findings(document)
    assert (rises.word, rises.main, less.word, less.main, gone.main) == ("holds", True, "holds", False, False)
    # 0.5 - 0.9, 0.6 - 0.9 and 0.7 - 1.0
    assert less.evidence == "retention of spinkick minus the other kept clips' mean -33 % [-48, -19]; bound 0 %"
    assert overlap.answer(document).endswith("of the others: -33 % [-48, -19] (spinkick, with kick forgotten).")
    near_kept = {"spinkick": [1.0] * 3, "punch": [0.9, 0.8, 0.9], "run": [0.7, 0.85, 0.7], "walk": [0.6] * 3}
    turned = overlap_document(near_kept, far)
    assert [of.word for of in overlap.findings(turned)][:2] == ["does not hold", "does not hold"]


def test_the_evidence_of_relearning_names_the_steps_and_who_never_got_there():
    assert relearned([1, 2, 1], [4, 4, 4])[0].evidence == (
        "target steps until 50 %, unlearned minus distilled -267 [-410, -123]; bound 0; distilled 400"
    )
    assert relearned([1, 2, 1], [4, 9, 9])[0].evidence.endswith("; distilled never got there in 2 of 3 runs")


@pytest.mark.parametrize("unlearned", [1, 2, 3, 9])
@pytest.mark.parametrize("control", [1, 3, 4, 9])
def test_the_study_says_nothing_against_the_verdicts_rule(unlearned, control):
    def lasted(at: int) -> Lasted:
        return Lasted(min(at, 5), 100.0 * min(at, 5), at <= 4)

    sooner = sooner_than_control(lasted(unlearned), lasted(control))  # by half, for the verdict
    word = relearned([unlearned], [control])[1].word
    assert (sooner, word) not in {(True, "one run: yes"), (False, "open")}
    if word == "one run: yes":
        assert sooner is False
    if sooner:
        assert word == "one run: no"


def test_relearning_is_compared_with_every_control_but_a_random_one_and_says_which_one_starts_near_the_level():
    def seeds(first_at: int, first: float) -> dict:
        return {repeat: curve(first_at, first) for repeat in REPEATS}

    # As many target steps an iteration more as makes the runs differ: 100, 101 and 102.
    starts = {"unlearned": seeds(2, 0.1), "distilled": seeds(3, 0.4), "fresh": seeds(4, 0.09)}
    for runs in starts.values():
        for place, of in enumerate(runs.values()):
            of["target_steps"] = [(100.0 + place) * step for step in range(6)]
    found = list(relearning.findings({"results": relearning_results(starts)}))
    assert [of.word for of in found] == ["the control starts near it", *["does not hold"] * 2]
    assert [of.main for of in found] == [False, True, False]
    assert (found[0].p, found[0].main) == (None, False)
    assert found[0].evidence.endswith(", and starts at 44 %")
    del starts["fresh"][REPEATS[0]]["iterations"][0]
    first = relearning.at_first({"base": dict.fromkeys(REPEATS, 0.9), "starts": starts}, "fresh")
    assert first == {repeat: pytest.approx(0.1) for repeat in REPEATS[1:]}


def test_a_control_that_lost_the_kept_clips_decides_nothing():
    starts = {"unlearned": {of: curve(1) for of in REPEATS}, "distilled": {of: curve(4) for of in REPEATS}}
    poor = relearning_results(starts, kept=0.79)
    assert {(of.word, of.main, of.n) for of in relearning.findings({"results": poor})} == {
        ("the control is unusable", False, 0)
    }
    assert claim.answer("c", relearning.findings({"results": poor})).word == "not measured"
    assert relearning.answer({"results": poor}).endswith("on them: unusable (distilled, kept skill 84 % [79, 89]).")
    assert relearning.competent(relearning_results(starts, kept=0.8), "distilled") == REPEATS
    # One of three that is unusable leaves two, which the words are about.
    poor["kept_skill"]["distilled"] |= {of: GOOD for of in REPEATS[1:]}
    found = list(relearning.findings({"results": poor}))[1]
    assert (found.n, found.main) == (2, True)
    assert found.evidence.endswith("; 1 more distilled unusable")
    del poor["kept_skill"]
    assert "distilled: unknown of the kept clips' skill" in next(iter(relearning.findings({"results": poor}))).evidence


def test_a_retrained_policy_beside_one_of_three_bases_is_one_run_and_a_run_that_never_got_there_only_bounds():
    repeats = [str(Repeat(base, 0)) for base in range(3)]
    starts = {"unlearned": dict(zip(repeats, map(curve, (1, 2, 1)), strict=True)), "retrained": {repeats[0]: curve(4)}}
    starts["distilled"] = dict(zip(repeats, map(curve, (4, 9, 9)), strict=True))
    results = relearning_results(starts)
    results["base"] = dict.fromkeys(repeats, 0.9)
    results["kept_skill"] = {label: dict.fromkeys(repeats, GOOD) for label in starts}
    found = {(of.claim.split()[-3], of.main): of for of in relearning.findings({"results": results})}
    assert (found["retrained", True].word, found["retrained", True].n) == ("one run: no", 1)
    assert (found["distilled", True].n, found["distilled", True].unit) == (3, "base")
    # 100 - 400, and at the ends of two runs 200 - 500 and 100 - 500
    assert relearning.answer({"results": results}).endswith(
        "-300, at most -300, at most -400 (run by run) (distilled, n = 3 bases); -300 (retrained, n = 1)."
    )
