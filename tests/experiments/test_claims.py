import json
import math

import pytest

from experiments import claims
from forgetmimic_jax import sweep
from forgetmimic_jax.evaluation import variants
from forgetmimic_jax.evaluation.statistics import over_seeds
from forgetmimic_jax.studies.claim import judged


@pytest.mark.parametrize(
    ("values", "below", "verdict"),
    [
        ([0.01, 0.02, 0.015], True, "holds"),
        ([0.01, 0.02, 0.015], False, "does not hold"),
        ([0.5, 0.52, 0.51], True, "does not hold"),
        ([0.0, 0.1, 0.05], True, "open"),
        ([0.0, 0.1, 0.05], False, "open"),
        ([0.04], True, "one seed: yes"),
        ([0.04], False, "one seed: no"),
    ],
)
def test_a_claim_holds_where_the_whole_interval_does(values, below, verdict):
    assert judged(over_seeds(values), 0.05, below=below) == verdict


def variant(target: list[float], kept: list[float], base: float = 0.6) -> dict:
    """As the comparison's JSON has it, a seed each."""

    def group(value: float) -> dict:
        return {"success_rate": value, "survival_weighted_tracking": value}

    seeds = {
        str(seed): {
            "policy": {"target": group(a), "kept": group(b)},
            "base": {"target": group(0.8), "kept": group(base)},
        }
        for seed, (a, b) in enumerate(zip(target, kept, strict=True))
    }
    return {"seeds": seeds}


def test_differences_are_between_runs_of_the_same_seed():
    found = {"a": variant([0.0, 0.1], [0.5, 0.7]), "b": variant([0.1], [0.45])}
    assert claims.gained(found, "a", None, "kept", "success_rate")["mean"] == pytest.approx(0.0)
    only = claims.gained(found, "a", "b", "kept", "success_rate")
    assert only == {"mean": pytest.approx(0.05), "n": 1}
    assert claims.gained(found, "a", "c", "kept", "success_rate") is None


def test_the_default_run_is_held_against_its_control_the_asked_ratio_and_doing_nothing():
    label, control = (claims.validity.at_length(of) for of in ("λ = 16", claims.validity.CONTROL))
    found = {label: variant([0.0, 0.0, 0.0], [0.6, 0.6, 0.6]), control: variant([0.8, 0.8, 0.8], [0.67, 0.68, 0.69])}
    for steps, run in zip((9.0, 9.5, 10.0), found[label]["seeds"].values(), strict=True):
        run["policy"]["target"] |= {"episode_length": steps, claims.DEVIATION: 0.01 * steps}
        run["zero_action"] = {"target": {"episode_length": 17.0, claims.DEVIATION: 0.05}}
    estimates = variants.over_seeds([run["policy"] for run in found[label]["seeds"].values()])
    ratio = {"survival_weighted_degradation_ratio": over_seeds([0.05, 0.06, 0.07])}
    found[label]["over_seeds"] = {"policy": {**estimates, **ratio}}
    told = list(claims.of_validity({"results": {"variants": found}}))
    assert [(of.claim.removeprefix(f"{label}: "), of.word) for of in told] == [
        ("the targets no longer succeed", "holds"),
        ("the kept clips stay as they were", "holds"),
        ("the kept clips are what fine-tuning alone gives", "does not hold"),
        ("the targets' tracking is under a tenth of the kept clips'", "holds"),
        ("short episodes mean a lost skill, and not an episode ended on purpose", "does not hold"),
        ("while it stands it is no further off a target than the robot without a policy", "does not hold"),
    ]
    assert (
        told[-2].evidence == "target episodes last -7.5 [-8.7, -6.3] steps on those without a policy of the same seed"
    )
    assert told[-1].evidence.startswith("largest key body error 0.045 [0.033, 0.057] m more than the 0.050 m without")


def test_the_comparisons_claims_by_hand():
    compared = {
        claims.ARFT: variant([0.1, 0.1, 0.1], [0.59, 0.60, 0.61]),
        claims.comparison.CONTROL: variant([0.8, 0.8, 0.8], [0.60, 0.61, 0.62]),
        claims.PLAIN_ARFT: variant([0.2, 0.2, 0.2], [0.4, 0.4, 0.4]),
        "negated reward, plain PPO": variant([0.0, 0.0, 0.0], [0.1, 0.12, 0.11]),
        "decremental, plain PPO": variant([0.0, 0.0, 0.0], [0.2, 0.21, 0.22]),
        "trajdeleter, plain PPO": variant([0.3, 0.31, 0.32], [0.6, 0.5, 0.55]),
        claims.UNIFORM: variant([0.2, 0.2, 0.2], [0.59, 0.60, 0.61]),
        f"{claims.UNIFORM}, wrench": variant([0.3, 0.2, 0.2], [0.6, 0.6, 0.6]),
        claims.ADAPTIVE: variant([0.4, 0.3, 0.2], [0.4, 0.6, 0.5]),
        f"{claims.ADAPTIVE}, wrench": variant([0.4, 0.5, 0.6], [0.4, 0.6, 0.5]),
        claims.FROZEN: variant([0.6, 0.6, 0.6], [0.6, 0.6, 0.6]),
        f"{claims.FROZEN}, wrench": variant([0.7, 0.71, 0.7], [0.6, 0.6, 0.6]),
    }
    found = {of.claim: of.word for of in claims.of_comparison({"results": {"variants": compared}})}
    assert found == {
        "λ = 16: the kept clips are what fine-tuning without an anti-reward gives": "holds",
        "negated reward, plain PPO, hurts the kept clips more than arft": "holds",
        "decremental, plain PPO, hurts the kept clips more than arft": "holds",
        "trajdeleter, plain PPO, hurts the kept clips more than arft": "does not hold",
        "trajdeleter, plain PPO, forgets less than arft": "holds",
        "adaptive RSI resists forgetting": "holds",
        "adaptive RSI costs the kept clips": "open",
        "the feedback of adaptive RSI resists forgetting": "does not hold",
        "the feedback of adaptive RSI costs the kept clips": "open",
    }
    adaptive = [(claims.ADAPTIVE, claims.UNIFORM), (f"{claims.ADAPTIVE}, wrench", f"{claims.UNIFORM}, wrench")]
    by_hand = [(0.2 + 0.1) / 2, (0.1 + 0.3) / 2, (0.0 + 0.4) / 2]
    assert claims.effect(compared, adaptive, "target") == pytest.approx(over_seeds(by_hand))
    compared[claims.UNIFORM] = variant([0.2], [0.6])
    assert claims.effect(compared, adaptive, "target") == {"mean": pytest.approx(0.15), "n": 1}


def test_a_policy_that_falls_sooner_than_doing_nothing_has_not_lost_a_skill():
    policies = {
        "base": {"0": {"episode_length": [60.0, 64.0]}},
        "zero action": {"0": {"episode_length": [16.0, 18.0]}},
        "λ = 8": {str(seed): {"episode_length": [17.0, 17.0 + seed]} for seed in range(3)},
        "λ = 16": {str(seed): {"episode_length": [5.0, 6.0 + seed]} for seed in range(3)},
    }
    found = [of.word for of in claims.of_physical_behaviour({"results": {"policies": policies}})]
    assert found == ["holds", "does not hold"]
    policies["λ = 8"] = {"0": {"episode_length": [50.0, 52.0]}}
    found = [of.word for of in claims.of_physical_behaviour({"results": {"policies": policies}})]
    assert found == ["not short", "does not hold"]
    measured = ("foot_contact", "joint_limit_violation", claims.DEVIATION)
    for label, values in (("base", (0.6, 0.1, 0.1)), ("zero action", (0.8, 0.2, 0.12))):
        policies[label]["0"] |= {name: [value] for name, value in zip(measured, values, strict=True)}
    for seed, run in policies["λ = 16"].items():
        run |= {name: [value + 0.01 * int(seed)] for name, value in zip(measured, (0.4, 0.09, 0.2), strict=True)}
    found = {
        of.claim.removeprefix("λ = 16: "): of
        for of in claims.of_physical_behaviour({"results": {"policies": policies}})
    }
    assert [of.word for of in list(found.values())[2:]] == ["holds", "open", "does not hold"]
    assert (
        found["the feet are less on the floor than the base's"].evidence
        == "foot contact 0.410 [0.385, 0.435], base 0.600"
    )
    assert list(found.values())[-1].evidence.endswith(
        "on the steps that all survive, 0.210 [0.185, 0.235], zero action 0.120"
    )


def test_the_training_curves_are_held_against_what_the_paper_reads_off_them():
    def rows(first: dict[str, list[float]], last: dict[str, list[float]]) -> dict:
        return {"rows": [{name: over_seeds(values) for name, values in at.items()} for at in (first, last)]}

    def told(of: dict) -> list[str]:
        return [of.word for of in claims.of_training_dynamics({"results": {"configurations": of}})]

    start = {"entropy": [5.0] * 3, "wrench_gain": [0.1, 0.11, 0.12], "top_bin_probability": [0.03] * 3}
    end = {"entropy": [4.0, 4.1, 4.2], "wrench_gain": [0.11, 0.13, 0.12], "top_bin_probability": [0.02, 0.021, 0.022]}
    assert told({"A: λ = 2": rows(start, end)}) == ["holds", "open", "does not hold"]
    anti = {"entropy": [5.0] * 3, "target/R_anti": [-10.0, -11.0, -9.0]}
    gone = {"entropy": [5.5, 5.6, 5.7], "target/R_anti": [-0.5, -0.6, -0.7]}
    assert told({"B: λ = 8": rows(anti, gone)}) == ["holds", "holds"]
    assert told({"B: λ = 8": rows(anti, {**gone, "target/R_anti": [-8.0, -8.1, -8.2]})}) == ["holds", "does not hold"]
    assert told({"B: λ = 8": rows({n: v[:1] for n, v in anti.items()}, {n: v[:1] for n, v in gone.items()})}) == [
        "one seed: yes",
        "one seed: yes",
    ]


def test_two_intervals_differ_by_no_more_than_both_say():
    last, first = over_seeds([4.0, 5.0, 6.0]), over_seeds([1.0, 2.0, 3.0])
    found = claims.difference(last, first)
    half = 4.302652729911275 * 1.0 / 3**0.5  # Student's t of two degrees of freedom
    assert found == {"mean": 3.0, "n": 3, "low": pytest.approx(3 - 2 * half), "high": pytest.approx(3 + 2 * half)}


def swept(skills: dict[float, list[float]]) -> dict:
    """As the JSON of the penalties has it: by penalty, the skill of each seed."""
    return {
        str(penalty): {
            "options": {"penalty": penalty},
            "seeds": {str(seed): {"policy": {"target": {"skill": skill}}} for seed, skill in enumerate(of)},
            "over_seeds": {"lambda_crit": over_seeds([7.6, 7.7, 7.8])},
        }
        for penalty, of in skills.items()
    }


@pytest.mark.parametrize(
    ("skills", "word", "evidence"),
    [
        # 4 x 2^(0.4 / 0.8), 4 x 2^(0.4 / 0.78) and 4 x 2^(0.4 / 0.79)
        ({4.0: [0.9, 0.9, 0.9], 8.0: [0.1, 0.12, 0.11]}, "holds", "5.7 [5.6, 5.7], mean of 3 seed(s)"),
        # 8 x 2^(0.4 / 0.8)
        ({8.0: [0.9, 0.9, 0.9], 16.0: [0.1, 0.1, 0.1]}, "does not hold", "11.3 [11.3, 11.3], mean of 3 seed(s)"),
        # the second seed's half is gone below 4: 5.7, at most 4 and 5.7 are below 8 in the mean, [2.7, 7.5]
        ({4.0: [0.9, 0.3, 0.9], 8.0: [0.1, 0.05, 0.1]}, "holds", "5.7, below 4, 5.7, seed by seed"),
        ({4.0: [0.3, 0.3, 0.3], 8.0: [0.1, 0.1, 0.1]}, "holds", "below 4, below 4, below 4, seed by seed"),
        # one seed needs more than was tried
        ({4.0: [0.9, 0.9, 0.9], 8.0: [0.1, 0.1, 0.9]}, "open", "5.7, 5.7, above 8, seed by seed"),
        ({4.0: [0.9, 0.9, 0.9], 16.0: [0.9, 0.9, 0.9]}, "does not hold", "above 16, above 16, above 16, seed by seed"),
        # below the smallest says nothing of a bound that is smaller still
        ({12.0: [0.3, 0.3, 0.3], 16.0: [0.1, 0.1, 0.1]}, "open", "below 12, below 12, below 12, seed by seed"),
        ({4.0: [0.3, 0.9, 0.9], 16.0: [0.1, 0.9, 0.9]}, "open", "below 4, above 16, above 16, seed by seed"),
        ({4.0: [0.3]}, "one seed: yes", "below 4, seed by seed"),
        ({16.0: [0.9]}, "one seed: no", "above 16, seed by seed"),
        ({16.0: [0.3]}, "open", "below 16, seed by seed"),
    ],
)
def test_half_of_the_skill_gone_below_w_is_asked_of_every_seed(skills, word, evidence):
    (found,) = claims.of_penalty({"results": {"variants": swept(skills)}})
    assert found.word == word
    assert found.evidence.startswith(f"half of the skill is gone at λ = {evidence}; λ_crit on the base's steps 7.70")


def test_half_of_the_skill_is_gone_between_two_penalties_before_the_first_or_after_the_last():
    crossed = 8.0 * 2.0 ** (0.2 / 0.6)
    assert sweep.half_gone({16.0: 0.1, 4.0: 0.9, 8.0: 0.7}) == pytest.approx((crossed, crossed))
    assert sweep.half_gone({4.0: 0.3, 8.0: 0.7, 16.0: 0.1}) == (0.0, 4.0)
    assert sweep.half_gone({4.0: 0.5}) == (0.0, 4.0)
    assert sweep.half_gone({4.0: 0.9, 16.0: 0.6}) == (16.0, math.inf)


def test_wear_is_what_the_kept_clips_lose_of_their_start():
    def judged(end: list[float]) -> claims.Finding:
        groups = [{"kept": {"survival_weighted_tracking": over_seeds(of)}} for of in ([0.8, 0.8, 0.8], [0.1] * 3, end)]
        return next(claims.of_heat_map({"asked": {"iterations": 1000}, "results": {"groups": groups}}))

    assert judged([0.78, 0.79, 0.80]).word == "holds"
    assert judged([0.5, 0.51, 0.52]).word == "does not hold"
    assert judged([0.7, 0.8, 0.75]).word == "open"
    assert judged([0.7, 0.8, 0.75]).claim == "1,000 iterations do not wear the kept clips down"


def test_any_motion_is_forgotten_and_the_others_stay():
    runs = {"run": variant([0.0, 0.0, 0.0], [0.4, 0.41, 0.42]), "dance": variant([0.0, 0.0, 0.0], [0.6, 0.6, 0.6])}
    for label, skill in (("run", [0.1, 0.12, 0.11]), ("dance", [0.5, 0.52, 0.51])):
        runs[label]["over_seeds"] = {"policy": {"target": {"skill": over_seeds(skill)}}}
    told = claims.of_motion_types({"asked": {"robot": "g1"}, "results": {"variants": runs}})
    assert [(of.claim, of.word) for of in told] == [
        ("run can be forgotten on the G1", "holds"),
        ("run: the kept clips stay as they were", "does not hold"),
        ("dance can be forgotten on the G1", "does not hold"),
        ("dance: the kept clips stay as they were", "holds"),
    ]


@pytest.mark.parametrize(
    ("auc", "hits", "verdict"),
    [
        ([0.9, 0.92, 0.91], [0.9, 0.9, 0.91], "evidence that it was trained on them"),
        ([0.1, 0.12, 0.11], [0.0, 0.0, 0.0], "the targets are done worse than their images"),
        ([0.4, 0.5, 0.6], [0.0, 0.1, 0.05], "this probe finds no evidence"),
        ([0.4, 0.5, 0.6], [0.2, 0.21, 0.22], "the AUC finds no evidence, the hits"),
        ([0.9], [0.9], "one policy"),
    ],
)
def test_membership_is_told_by_the_auc_and_by_the_hits(auc, hits, verdict):
    of = {"auc": over_seeds(auc), "tpr_at_5_percent_fpr": over_seeds(hits)}
    asked = {"targets": ["punch", "kick"], "episodes": 20}
    (told,) = claims.of_membership({"asked": asked, "results": {"policies": {"base": of}}})
    assert told.word.startswith(verdict)
    assert told.evidence.endswith("guessing 0.07")  # of 41 alike, one is among the first three with a chance of 3 in 41


def test_what_comes_back_sooner_than_it_is_learned_was_not_forgotten():
    def curve(at: int) -> dict:
        tracking = [0.9 if step >= at else 0.1 for step in range(6)]
        return {"iterations": list(range(6)), "target_steps": [100.0 * step for step in range(6)], "tracking": tracking}

    def found(unlearned: list[int], distilled: list[int]) -> claims.Finding:
        starts = {
            label: {str(seed): curve(at) for seed, at in enumerate(of)}
            for label, of in (("unlearned", unlearned), ("distilled", distilled))
        }
        every = list(claims.of_relearning({"results": {"base": dict.fromkeys("012", 0.9), "starts": starts}}))
        assert len({of.word for of in every}) == 1
        return every[0]

    sooner = found([1, 2, 1], [4, 4, 4])
    assert sooner.word == "does not hold"
    assert sooner.evidence.startswith("-267 [-410, -123] target steps more than the 400 of the distilled one")
    assert found([3, 4, 3], [1, 1, 1]).word == "holds"
    assert found([1, 2, 1], [1, 1, 4]).word == "open"
    never = found([1, 2, 1], [4, 9, 9])
    assert never.word == "does not hold"  # later than their runs' ends, which is late enough
    assert never.evidence.endswith("not reached, counted with the run's end: distilled in 2 of 3 runs")
    assert found([1, 9, 1], [4, 4, 4]).word == "open"
    assert found([4], [1]).word == "one seed: yes"
    assert found([4], [9]).word == "one seed: no"
    assert found([9], [4]).word == "open"


def test_relearning_is_held_against_every_control_and_says_which_one_starts_near_the_level():
    def curve(at: int, first: float) -> dict:
        tracking = [first, *(0.9 if step >= at else 0.1 for step in range(1, 6))]
        return {"iterations": list(range(6)), "target_steps": [100.0 * step for step in range(6)], "tracking": tracking}

    def seeds(at: int, first: float) -> dict:
        return {str(seed): curve(at, first) for seed in range(3)}

    starts = {"unlearned": seeds(2, 0.1), "distilled": seeds(3, 0.4), "fresh": seeds(4, 0.09)}
    told = list(claims.of_relearning({"results": {"base": dict.fromkeys("012", 0.9), "starts": starts}}))
    assert [of.word for of in told] == ["the control starts near it", *["does not hold"] * 5]
    assert told[0].evidence.endswith("which starts at 44%")
    assert "than a fresh policy needs" in told[3].claim
    del starts["fresh"]["0"]["iterations"][0]
    first = claims.at_first({"base": dict.fromkeys("012", 0.9), "starts": starts}, "fresh")
    assert first == {"1": pytest.approx(0.1), "2": pytest.approx(0.1)}


def test_the_table_names_what_is_not_measured(tmp_path):
    runs = variant([0.0, 0.0, 0.0], [0.6, 0.6, 0.6])
    success = variants.over_seeds([{"success_rate": 0.0, "episodes": 40}] * 3)["success_rate"]
    skill = over_seeds([0.1, 0.12, 0.11])
    runs["over_seeds"] = {"policy": {"target": {"success_rate": success, "skill": skill}}}
    document = {"asked": {"seeds": 3}, "results": {"variants": {"λ = 16": runs}}}
    (tmp_path / "g1").mkdir()
    (tmp_path / "g1" / "validity.json").write_text(json.dumps(document))
    text = claims.table(tmp_path)
    rows = [line for line in text.splitlines() if line.startswith("| [validity]")]
    assert len(rows) == 3
    assert all("**holds**" in row and row.endswith("| 3 |") for row in rows)
    assert "0 % [0, 3]" in rows[0]
    assert "Not measured yet: comparison, penalty," in text


def test_the_readmes_table_is_that_of_the_stored_numbers():
    text = claims.README.read_text()
    assert claims.BLOCK.search(text)
    assert claims.BLOCK.sub(lambda block: f"{block[1]}{claims.table()}{block[2]}", text) == text, "run `make tables`"
