"""The words for a clip in the tables: their bounds are those of the verdict."""

import pytest

from forgetmimic_jax.evaluation.document import ClipResult, Estimate, EvaluationDocument, PolicyResult
from forgetmimic_jax.evaluation.tables import markdown

METRICS = ("tracking_reward", "survival_weighted_tracking", "success_rate", "episode_length")


def policy(target: bool, skill: float | None) -> PolicyResult:
    retained = None if skill is None else Estimate(mean=skill, n=20)
    numbers = dict.fromkeys(METRICS, Estimate(mean=0.5, n=20))
    return PolicyResult(clips={"punch": ClipResult(target=target, skill=retained, **numbers)}, nan_resets=0)


@pytest.mark.parametrize(
    ("target", "skill", "word"),
    [
        *((True, -0.3, "forgotten"), (True, 0.2, "forgotten"), (True, 0.21, "still known"), (True, 0.9, "still known")),
        *((False, 0.8, "kept"), (False, 0.79, "weakened"), (False, 0.5, "weakened"), (False, 0.49, "not kept")),
        *((True, None, "not learned"), (False, None, "not learned")),
    ],
)
def test_the_words_have_the_bounds_of_the_verdict(target, skill, word):
    document = EvaluationDocument(
        schema=1, robot="g1", checkpoint="run", config_hash="", library_hash="", seed=0, episodes=20, targets=["punch"],
        policies={name: policy(target, skill) for name in ("base", "unlearned", "zero_action")},
    )  # fmt: skip
    (row,) = [line for line in markdown(document).splitlines() if line.startswith("| punch ")]
    assert row.split(" | ")[-1] == f"{word} |"
