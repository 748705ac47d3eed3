"""Returns of agents while they learn, exploration included, beside the policies that are judged.

Regret of play is the normalised regret of the returns of episodes that ended in the last third of a run: 0 is optimal,
1 as uniform play. A learner of values plays a little worse than its greedy policy. If it plays at random to the end,
it explores too long. If it plays far better than the policy that is judged, another policy is judged.

`data/baseline_play.csv` has the regret of play of shipped baselines, whose results have none, from three seeds:
`benchmarks/baseline_play.py` makes it.
"""

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pharos.system.wording import pluralize

if TYPE_CHECKING:
    from pharos.benchmark.results import AgentResults

PLAY_FILE = Path(__file__).parent / "data" / "baseline_play.csv"
LAST_THIRD = 1 / 3  # of the evaluations
LEARNT_REGRET = 0.5  # up to which an agent is clearly better than uniform play
RANDOM_REGRET = 0.8  # of play, from which it looks like uniform play
LEAST_TASKS = 3  # that count, for anything to be said
SHARE_AT_RANDOM = 0.5  # share of tasks that are learnt and played at random, from which an agent is told so
BETTER_PLAYED = 0.1  # of regret, by which play is better than the policies that are judged, on the median task
CAPPED_REGRET = 1.5  # of policies, that counts; play that is better than optimal is luck, and counts as optimal


def num_late(evaluations: int) -> int:
    """Evaluations in the last third of a run."""
    return round(evaluations * LAST_THIRD)


def late_play(rows: Sequence[Mapping[str, Any]], result: Mapping[str, Any]) -> dict[str, float]:
    """`regret` of play in the last third of a run, and the number of `episodes` that ended there.

    Args:
        rows: of the curve, before the first step and at each evaluation. result: of the run.
    Returns:
        Empty if no episode ended there, or regret cannot be normalised.
    """
    first, last = rows[len(rows) - 1 - num_late(len(rows) - 1)], rows[-1]
    episodes = last["episodes"] - first["episodes"]
    lost = last["cumulative_realised_regret"] - first["cumulative_realised_regret"]
    optimal, uniform = result.get("value_optimal"), result.get("value_uniform")
    if not episodes or optimal is None or uniform is None or not math.isfinite(lost):
        return {}
    spread = optimal - uniform
    return {"regret": lost / episodes / spread, "episodes": float(episodes)} if spread > 0 else {}


def mean_play(runs: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Mean over the runs of a task of what `late_play` returns. Empty if a run lacks it."""
    return {name: float(np.mean([run[name] for run in runs])) for name in ("regret", "episodes")} if all(runs) else {}


def play_of(results: "AgentResults") -> dict[str, float]:
    """Regret of play by task, of tasks with curves. Results that were made before it was recorded have none."""
    stored = results.record.get("play")
    entries = stored.items() if isinstance(stored, Mapping) else ()
    return {
        name: float(facts["regret"])
        for name, facts in entries
        if name in results.curves and isinstance(facts, Mapping) and _is_number(facts.get("regret"))
    }


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


@cache
def _shipped_play() -> Mapping[str, Mapping[str, float]]:
    with open(PLAY_FILE, encoding="utf-8", newline="") as lines:
        rows = [*csv.DictReader(lines)]
    names = [name for name in rows[0] if name != "task"]
    return {name: {row["task"]: float(row[name]) for row in rows if row[name]} for name in names}


def baseline_play(results: "AgentResults") -> Mapping[str, float]:
    """Regret of play by task of what an agent stands beside: its own, else of the shipped baseline of its name."""
    own = play_of(results)
    return own or (_shipped_play().get(results.agent, {}) if results.suite == "v1" else {})


# What it says ---------------------------------------------------------------------------------------------------------


def late_regret(results: "AgentResults") -> dict[str, float]:
    """Normalised regret of the policies that are judged in the last third, mean of the runs, by task."""
    return {name: float(curve[:, -num_late(curve.shape[1]) :].mean()) for name, curve in results.curves.items()}


def play_and_policy(results: "AgentResults", beside: "AgentResults") -> dict[str, tuple[float, float]]:
    """Regret of play and of the policies that are judged, both of the last third, by task.

    Of tasks that the agent beside it plays better than at random by then: its regret of play is at most LEARNT_REGRET.
    """
    if not (own := play_of(results)):
        return {}
    late, theirs = late_regret(results), baseline_play(beside)
    return {name: (own[name], late[name]) for name in own if theirs.get(name, math.inf) <= LEARNT_REGRET}


@dataclass(frozen=True)
class PlaySymptom:
    """A symptom of what an agent plays at the end of training.

    Attributes:
        name: "random_play" or "played_better". value, limit, largest: its number, from where on it is a symptom, and
            the largest that it can be. wrong: what is wrong, in words. advice: what to look at.
    """

    name: str
    value: float
    limit: float
    largest: float
    wrong: str
    advice: str


def play_symptoms(ours: "AgentResults", beside: "AgentResults", name: str) -> list[PlaySymptom]:
    """Symptoms of what an agent plays at the end of training: random play, or better play than its policies'.

    Args:
        beside: the baseline that it is compared with. name: of the baseline.
    """
    pairs, symptoms = play_and_policy(ours, beside), []
    learnt = {task: play for task, (play, policy) in pairs.items() if policy <= LEARNT_REGRET}
    at_random = sum(play >= RANDOM_REGRET for play in learnt.values())
    if len(learnt) >= LEAST_TASKS and at_random > SHARE_AT_RANDOM * len(learnt):
        wrong = (
            f"it still plays at random at the end of training, on {at_random} of {pluralize(len(learnt), 'task')} that "
            f"its policy has learnt, as {name} does not"
        )
        advice = "look whether epsilon falls, in how many steps, and whether exploration ends"
        symptoms.append(PlaySymptom("random_play", at_random / len(learnt), SHARE_AT_RANDOM, 1.0, wrong, advice))
    gains = [min(policy, CAPPED_REGRET) - max(play, 0.0) for play, policy in pairs.values() if play <= LEARNT_REGRET]
    if len(gains) >= LEAST_TASKS and (gain := float(np.median(gains))) > BETTER_PLAYED:
        wrong = (
            f"what it plays at the end of training is better than the policy that is judged, by {gain:.2f} of regret "
            f"on the median of {pluralize(len(gains), 'task')}"
        )
        advice = "look whether the policy that is judged is the one that is played: its actions, mode and normalisation"
        symptoms.append(PlaySymptom("played_better", gain, BETTER_PLAYED, CAPPED_REGRET, wrong, advice))
    return symptoms
