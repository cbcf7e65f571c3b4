import json

import pytest

from experiments import claims
from forgetmimic_jax.evaluation import variants
from forgetmimic_jax.evaluation.statistics import over_seeds


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
    assert claims.judged(over_seeds(values), 0.05, below=below) == verdict


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
        run["policy"]["target"]["episode_length"] = steps
        run["zero_action"] = {"target": {"episode_length": 17.0}}
    estimates = variants.over_seeds([run["policy"] for run in found[label]["seeds"].values()])
    ratio = {"survival_weighted_degradation_ratio": over_seeds([0.05, 0.06, 0.07])}
    found[label]["over_seeds"] = {"policy": {**estimates, **ratio}}
    told = list(claims.of_validity({"results": {"variants": found}}))
    assert [(of.claim.removeprefix(f"{label}: "), of.verdict) for of in told] == [
        ("the targets no longer succeed", "holds"),
        ("the kept clips stay as they were", "holds"),
        ("the kept clips are what fine-tuning alone gives", "does not hold"),
        ("the targets' tracking is under a tenth of the kept clips'", "holds"),
        ("short episodes mean a lost skill, and not an episode ended on purpose", "does not hold"),
    ]
    assert (
        told[-1].evidence == "target episodes last -7.5 [-8.7, -6.3] steps on those without a policy of the same seed"
    )


def test_the_comparisons_claims_by_hand():
    compared = {
        claims.ARFT: variant([0.1, 0.1, 0.1], [0.59, 0.60, 0.61]),
        claims.comparison.CONTROL: variant([0.8, 0.8, 0.8], [0.60, 0.61, 0.62]),
        claims.PLAIN_ARFT: variant([0.2, 0.2, 0.2], [0.4, 0.4, 0.4]),
        "decremental, plain PPO": variant([0.0, 0.0, 0.0], [0.2, 0.21, 0.22]),
        "trajdeleter, plain PPO": variant([0.3, 0.31, 0.32], [0.6, 0.5, 0.55]),
        claims.UNIFORM: variant([0.2, 0.2, 0.2], [0.59, 0.60, 0.61]),
        f"{claims.UNIFORM}, wrench": variant([0.3, 0.2, 0.2], [0.6, 0.6, 0.6]),
        claims.ADAPTIVE: variant([0.4, 0.3, 0.2], [0.4, 0.6, 0.5]),
        f"{claims.ADAPTIVE}, wrench": variant([0.4, 0.5, 0.6], [0.4, 0.6, 0.5]),
    }
    found = {of.claim: of.verdict for of in claims.of_comparison({"results": {"variants": compared}})}
    assert found == {
        "λ = 16: the kept clips are what fine-tuning without an anti-reward gives": "holds",
        "decremental, plain PPO, hurts the kept clips more than arft": "holds",
        "trajdeleter, plain PPO, hurts the kept clips more than arft": "does not hold",
        "trajdeleter, plain PPO, forgets less than arft": "holds",
        "adaptive RSI resists forgetting": "holds",
        "adaptive RSI costs the kept clips": "open",
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
    found = [of.verdict for of in claims.of_physical_behaviour({"results": {"policies": policies}})]
    assert found == ["holds", "does not hold"]
    policies["λ = 8"] = {"0": {"episode_length": [50.0, 52.0]}}
    found = [of.verdict for of in claims.of_physical_behaviour({"results": {"policies": policies}})]
    assert found == ["not short", "does not hold"]


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
        assert len({of.verdict for of in every}) == 1
        return every[0]

    sooner = found([1, 2, 1], [4, 4, 4])
    assert sooner.verdict == "does not hold"
    assert sooner.evidence.startswith("-267 [-410, -123] target steps more than the 400 of the distilled one")
    assert found([3, 4, 3], [1, 1, 1]).verdict == "holds"
    assert found([1, 2, 1], [1, 1, 4]).verdict == "open"
    never = found([1, 2, 1], [4, 9, 9])
    assert never.verdict == "does not hold"  # later than their runs' ends, which is late enough
    assert never.evidence.endswith("not reached, counted with the run's end: distilled in 2 of 3 runs")
    assert found([1, 9, 1], [4, 4, 4]).verdict == "open"
    assert found([4], [1]).verdict == "one seed: yes"
    assert found([4], [9]).verdict == "one seed: no"
    assert found([9], [4]).verdict == "open"


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
