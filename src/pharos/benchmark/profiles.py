"""Diagnosis of an agent: symptoms in its values and behaviour, and the nearest of known faults.

`data/fault_profiles.csv` has the readings of small DQNs and PPOs, healthy ones and ones with a fault of `faults.py`,
each with hyperparameters and seeds of its own; `benchmarks/fault_profiles.py` makes it. Limits of symptoms are the most
extreme healthy agents in it, with a margin, so that no healthy agent of the table is told that something is wrong.
The likeness of a fault is its probability by linear discriminant analysis among all faults of the agent's kind.

Source: Friedman (1989), Regularized discriminant analysis.
"""

import csv
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from pharos.benchmark.doctor import EQUATIONS, readings
from pharos.benchmark.examination import NAMES, PROTOCOL, Examination, examine
from pharos.benchmark.faults import FAULTS, HEALTHY

FILE = Path(__file__).parent / "data" / "fault_profiles.csv"
DECIMALS = 3
LARGEST = 4.0  # deviations within a fault that a reading counts as being away
OWN = 0.5  # weight of the deviations alone in the covariance within a fault
INDEPENDENT = 8  # readings that count as independent evidence
CREDIBLE = 0.6  # likeness from which a fault is said
HEALTHY_ONES = 3.0  # times as many agents that are healthy as agents with any one fault, before anything is seen
BROKEN = 0.5  # mean regret of an agent of which no check and no fault says what is wrong


@dataclass(frozen=True)
class Symptom:
    """A reading that no healthy agent has.

    Attributes:
        reading: its name. is_high: whether it is wrong above the limit, not below.
        margin: beyond the most extreme healthy agent. beyond: what it is beyond besides, whatever healthy agents have.
        wrong: sentence, with {value} for `show(reading)`. advice: what to look at.
        faults: of the library that it is a sign of, the most likely first.
        kind: of agents that it is a symptom of; empty: of all.
    """

    reading: str
    is_high: bool
    margin: float
    beyond: float
    wrong: str
    advice: str
    faults: tuple[str, ...] = ()
    show: Callable[[float], str] = "{:.2f}".format
    kind: str = ""


def _factor(value: float) -> str:
    return f"{10 ** abs(value):.2g} times"


def _gamma(value: float) -> str:
    return f"{1 - 10**-value:.3g}"


def _share(value: float) -> str:
    return f"{10**value:.2g}"


def _percent(value: float) -> str:
    return f"{value:.0%}"


SYMPTOMS = (
    Symptom(
        "equal_seeds",
        True,
        0.2,
        0.5,
        "two seeds did exactly the same on {value} of the worlds; they ought to differ",
        "seed random numbers with the seed that you are given, and env.reset in its first call alone",
        ("seeds_ignored",),
        _percent,
    ),
    Symptom(
        "wavering",
        True,
        1.0,
        -4.0,
        "asked about the same observations in another order, it gives other values (by {value} of the largest)",
        "switch dropout, noise and normalisation by batches off when it is judged; look for a wrong reshape",
        (),
        _share,
    ),
    Symptom(
        "deaf_last",
        True,
        0.2,
        0.5,
        "on {value} of the worlds the last number of the observation changes nothing",
        "look at slices of observations ([:-1], range(n - 1)) and at the number of inputs of the network",
        ("last_feature_lost",),
        _percent,
    ),
    Symptom(
        "deaf",
        True,
        0.1,
        0.3,
        "{value} of the numbers of observations change nothing",
        "look for dead units (a learning rate or pixels far too large), and for inputs that are cut off",
        ("bytes_not_divided", "learning_rate_high"),
        _percent,
    ),
    Symptom(
        "overlap_shifted",
        True,
        0.05,
        0.0,
        "the policy that is judged agrees better (by {value}) with what it did while learning if its actions are "
        "shifted by one",
        "compare the action that is executed with the one that is chosen: an index from 1, an offset, a mapping",
        ("action_off_by_one",),
    ),
    Symptom(
        "through_ends",
        False,
        0.1,
        -0.1,
        "values go on after the end of an episode: errors at ends are {value} smaller if the value of the terminal "
        "state is added",
        "multiply the next value by (1 - terminated)",
        ("terminal_bootstrapped", "value_without_mask"),
        _factor,
    ),
    Symptom(
        "to_next_episode",
        False,
        0.1,
        -0.1,
        "values go on into the next episode: errors at ends are {value} smaller if the value of the first state is "
        "added",
        "multiply the next value, and the running advantage, by (1 - done), with the done of the same step",
        ("value_without_mask",),
        _factor,
    ),
    Symptom(
        "cut_share",
        True,
        0.25,
        0.45,
        "values stop at the time limit: they are {value} of the way to those for which a truncated episode has ended",
        "bootstrap where truncated: only terminated ends a return",
        ("truncation_as_end",),
        _percent,
    ),
    Symptom(
        "signs",
        False,
        0.3,
        -0.8,
        "values are those of the signs of rewards: errors are {value} smaller",
        "look for clipped rewards (a wrapper of Atari), or divide by the largest instead",
        ("rewards_clipped",),
        _factor,
    ),
    Symptom(
        "earlier_reward",
        False,
        0.1,
        -0.1,
        "each step has the reward of the step before: errors are {value} smaller",
        "look at the order in which a transition is stored: reward after step, not before",
        ("rewards_shifted",),
        _factor,
    ),
    Symptom(
        "itself",
        False,
        0.1,
        -0.3,
        "what comes after a state is the state itself: errors are {value} smaller",
        "look for an observation that is overwritten before it is stored; copy the array",
        ("next_is_observation",),
        _factor,
    ),
    Symptom(
        "mean",
        False,
        0.1,
        -0.2,
        "values are those of random play from the next step on: errors are {value} smaller",
        "take the maximum over the axis of actions, not the mean",
        ("mean_backup",),
        _factor,
    ),
    Symptom(
        "negative",
        False,
        0.1,
        -0.1,
        "rewards have the wrong sign: errors are {value} smaller",
        "look for a loss or cost where a reward is expected",
        (),
        _factor,
    ),
    Symptom(
        "gamma",
        False,
        0.2,
        0.7,
        "the discount that fits its values best is {value}",
        "look at gamma; at powers of it in returns of several steps; at a value that is not propagated",
        ("gamma_half",),
        _gamma,
    ),
    Symptom(
        "forgets",
        False,
        0.2,
        -0.3,
        "values are right where it was of late, and {value} further off elsewhere",
        "use a larger replay buffer, or more minibatches between two policies",
        ("replay_too_small",),
        _factor,
    ),
    Symptom(
        "slope",
        False,
        0.3,
        -1.0,
        "rewards enter its values with the factor {value} in place of 1",
        "look at rewards that are stored, scaled or clipped on their way into the loss, and at the learning rate",
        ("rewards_shifted", "learning_rate_low"),
        _share,
    ),
    Symptom(
        "consistency",
        True,
        0.1,
        -0.4,
        "values are far from their own backup: the residual is {value} of the deviation of the backup",
        "look at the target network, at the loss, and at learning rates",
        ("target_never_copied", "learning_rate_low", "learning_rate_high", "rollout_reshaped"),
        _share,
    ),
    Symptom(
        "size",
        True,
        0.2,
        0.3,
        "values differ {value} as much as exact ones",
        "look at the learning rate, at the target network, at undivided pixels, at the done mask",
        ("learning_rate_high", "bytes_not_divided", "terminal_bootstrapped"),
        _factor,
    ),
    Symptom(
        "size",
        False,
        0.2,
        -0.3,
        "values differ {value} less than exact ones",
        "look at the learning rate, at the number of updates, at the target network, at clipped rewards",
        ("learning_rate_low", "rewards_clipped"),
        _factor,
    ),
    Symptom(
        "random",
        True,
        0.02,
        0.9,
        "its actions are still random at the end of training: {value} of the entropy of uniform play",
        "look at the schedule of epsilon, at the entropy bonus, and at the sign of the loss",
        ("epsilon_stuck",),
        _percent,
    ),
    Symptom(
        "coverage",
        False,
        0.02,
        0.9,
        "it has seen {value} of the states, fewer than any healthy agent",
        "look at exploration: epsilon at the beginning, the entropy bonus and its sign",
        ("never_explores", "entropy_penalised"),
        _percent,
    ),
    Symptom(
        "certain",
        False,
        0.02,
        0.95,
        "the policy that is judged gives {value} to its likeliest action, less than any healthy agent of its kind",
        "play greedily when a learner of values is judged; look at the temperature and at the entropy bonus",
        ("plays_at_random",),
        _percent,
        "dqn",
    ),
    Symptom(
        "behind",
        False,
        0.05,
        -0.2,
        "what it did while learning was better than the policy that is judged, by {value} of the way to random play",
        "judge the network that has learnt, in the mode and with the normalisation in which it was trained",
        ("action_off_by_one", "plays_at_random"),
        "{:.2f}".format,
    ),
)
"""In the order in which they are told."""


# Profiles -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Profile:
    """Readings of an agent with a fault, or a healthy one. kind: "dqn" or "ppo"."""

    kind: str
    fault: str
    readings: Mapping[str, float]


@cache
def shipped() -> tuple[Profile, ...]:
    """Profiles of the library."""
    with open(FILE, encoding="utf-8", newline="") as lines:
        return tuple(
            Profile(row.pop("agent"), row.pop("fault"), {name: float(text) for name, text in row.items() if text})
            for row in csv.DictReader(lines)
        )


def kind_of(numbers: Mapping[str, float]) -> str:
    """Kind of agent: "dqn" if the readings are of values of actions, "ppo" if of values of states, empty if of none."""
    if "consistency" not in numbers:
        return ""
    return "dqn" if "own" in numbers else "ppo"


def likeness(numbers: Mapping[str, float], library: Sequence[Profile]) -> dict[str, float]:
    """Probability of each fault of a library, "none" among them, the largest first; they sum to 1.

    Readings are counted in their deviation within faults, and differences of more than LARGEST as so many. A reading
    that is missing on one side says nothing.
    """
    names = [name for name in numbers if all(name in each.readings for each in library)]
    rows = np.array([[each.readings[name] for name in names] for each in library])
    faults = sorted({each.fault for each in library})
    members = [np.array([each.fault == fault for each in library]) for fault in faults]
    within = np.concatenate([rows[own] - rows[own].mean(axis=0) for own in members])
    freedom = max(len(rows) - len(faults), 1)
    deviations = np.sqrt((within**2).sum(axis=0) / freedom) + 0.05 * rows.std(axis=0) + 1e-3
    x = np.array([numbers[name] for name in names])
    standard = within / deviations
    covariance = (1 - OWN) * standard.T @ standard / freedom + OWN * np.eye(len(names))
    scores = []
    for own in members:
        z = np.clip((x - rows[own].mean(axis=0)) / deviations, -LARGEST, LARGEST)
        scores.append(-0.5 * float(z @ np.linalg.solve(covariance, z)) * own.sum() / (own.sum() + 1))
    powers = np.exp((np.array(scores) - max(scores)) * min(1.0, INDEPENDENT / len(names)))
    powers *= [HEALTHY_ONES if fault == HEALTHY else 1.0 for fault in faults]
    ranked = sorted(zip(faults, powers / powers.sum(), strict=True), key=lambda each: -each[1])
    return {fault: float(share) for fault, share in ranked}


@dataclass(frozen=True)
class Accuracy:
    """Shares of agents for which the likeness was right, of those that were left out of the library.

    Attributes:
        agents: how many. first: share of those with a fault whose fault was the likeliest; three: among three.
        healthy: share of healthy ones without a symptom and without a fault that is likely.
    """

    agents: int
    first: float
    three: float
    healthy: float


def suspect(shares: Mapping[str, float]) -> str | None:
    """The fault that is likely enough to be said, if there is one."""
    fault, share = next(iter(shares.items()))
    return fault if fault != HEALTHY and share > CREDIBLE else None


@cache
def accuracy(kind: str) -> Accuracy:
    """Accuracy of the shipped library for a kind of agent, each of its agents left out in turn."""
    library = [each for each in shipped() if each.kind == kind]
    ranks, healthy = [], []
    for place, each in enumerate(library):
        rest = library[:place] + library[place + 1 :]
        if each.fault not in {other.fault for other in rest}:
            continue
        shares = likeness(each.readings, rest)
        order = [*shares]
        if each.fault == HEALTHY:
            healthy.append(not failed(each.readings, rest) and suspect(shares) is None)
        else:
            ranks.append(order.index(each.fault))
    places = np.array(ranks)
    if not ranks or not healthy:
        return Accuracy(0, float("nan"), float("nan"), float("nan"))
    return Accuracy(
        len(ranks) + len(healthy), float((places == 0).mean()), float((places < 3).mean()), float(np.mean(healthy))
    )


# Diagnosis ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Finding:
    """A symptom that is there: the reading and the limit that no healthy agent passes, in words, and what to try."""

    reading: str
    value: float
    limit: float
    wrong: str
    advice: str


def failed(numbers: Mapping[str, float], library: Sequence[Profile]) -> list[Finding]:
    """Findings of symptoms that are there, in the order of SYMPTOMS; of equations the one that fits best.

    Args:
        numbers: readings of an agent. library: profiles, of which the healthy ones set limits.
    """
    healthy = [each.readings for each in library if each.fault == HEALTHY]
    findings = []
    for symptom in SYMPTOMS:
        values = [each[symptom.reading] for each in healthy if symptom.reading in each]
        if symptom.reading not in numbers or not values or symptom.kind not in ("", kind_of(numbers)):
            continue
        value, sign = numbers[symptom.reading], 1 if symptom.is_high else -1
        limit = sign * max(*(sign * each + symptom.margin for each in values), sign * symptom.beyond)
        if sign * value > sign * limit:
            wrong = symptom.wrong.format(value=symptom.show(value))
            findings.append(Finding(symptom.reading, value, limit, wrong, symptom.advice))
    equations = [each for each in findings if each.reading in EQUATIONS]
    best = min(equations, key=lambda each: each.value - each.limit, default=None)
    return [each for each in findings if each not in equations or each is best]


@dataclass(frozen=True)
class Diagnosis:
    """Result of `diagnose`.

    Attributes:
        agent: its label. kind: "dqn", "ppo", or empty if it offers no values.
        verdict: one sentence.
        findings: symptoms that are there, the plainest first.
        likeness: probability of each known fault, "none" among them, the largest first.
        accuracy: how often the likeness was right for agents that the library did not have.
        scores: by world, 1 optimal and 0 as uniform play, mean of the seeds.
        readings: all numbers, see `doctor.readings`.
    """

    agent: str
    kind: str
    verdict: str
    findings: tuple[Finding, ...]
    likeness: Mapping[str, float]
    accuracy: Accuracy
    scores: Mapping[str, float]
    readings: Mapping[str, float]

    @property
    def is_healthy(self) -> bool:
        """Whether no check has found anything, and no fault is likely."""
        score = sum(self.scores.values()) / len(self.scores)
        return not self.findings and suspect(self.likeness) is None and score > BROKEN

    @property
    def how_often(self) -> str:
        """A sentence on how far the likeness can be trusted."""
        right = self.accuracy
        if not right.agents:
            return "The table has one agent with each fault, so nothing is known of how often the likeness is right."
        return (
            f"Of {right.agents} agents, each left out of the table in turn, the fault was the likeliest for "
            f"{right.first:.0%}, among three for {right.three:.0%}; {right.healthy:.0%} of the healthy ones were "
            f"called healthy."
        )

    def nearest(self) -> list[tuple[str, float, str]]:
        """The three likeliest faults: name, "healthy" for none; likeness; in words."""
        words = meanings(self.kind)
        three = list(self.likeness.items())[:3]
        return [("healthy" if name == HEALTHY else name, share, words.get(name, "")) for name, share in three]

    def to_dict(self) -> dict[str, Any]:
        """The attributes, JSON-able."""
        entry = {name: value for name, value in vars(self).items() if name not in ("findings", "accuracy")}
        return {
            **entry,
            "healthy": self.is_healthy,
            "findings": [vars(each) for each in self.findings],
            "accuracy": vars(self.accuracy),
        }

    def __str__(self) -> str:
        """The page, as Markdown."""
        lines = [f"# Diagnosis of {self.agent}", "", self.verdict, ""]
        if self.findings:
            lines += ["## What no healthy agent shows", ""]
            lines += [f"{k}. {each.wrong}. *Try:* {each.advice}." for k, each in enumerate(self.findings, start=1)]
            lines.append("")
        lines += ["## Nearest known agents", "", "| likeness | fault | |", "|---:|---|---|"]
        lines += [f"| {share:.2f} | {name} | {text} |" for name, share, text in self.nearest()]
        lines += ["", self.how_often, "", "## Scores", "", "| world | score |", "|---|---:|"]
        lines += [f"| {name} | {score:.2f} |" for name, score in self.scores.items()]
        return "\n".join(lines) + "\n"


def meanings(kind: str) -> dict[str, str]:
    """Faults in words; of all kinds if it is empty."""
    return {name: text for agent, table in FAULTS.items() if kind in ("", agent) for name, text in table.items()}


def diagnose(
    agent: str | Callable[..., Any],
    *,
    hyperparameters: Mapping[str, Any] | None = None,
    worlds: Sequence[str] = NAMES,
    seeds: Sequence[int] = (0, 1),
    steps: int = PROTOCOL.steps,
    tell: Callable[[float, str], object] = lambda share, text: None,
) -> Diagnosis:
    """Train an agent on twelve small worlds, and say what is wrong with it, by which number, and what to try.

    Its policies are asked for `q_values(observations)`, (N, A), or `values(observations)`, (N,), if they offer them, as
    policies of Stable-Baselines3 do. These values are compared with exact ones. Without them only behaviour is judged.

    Args:
        agent, hyperparameters, worlds, seeds, steps, tell: as `examine` takes them. Limits and likeness come from
            agents with all worlds, two seeds and 4,000 steps.
    Raises:
        ParameterError: it is no agent, or it yields no policy.
        PharosError: its code raises something, SystemExit included.
    Cost: 24 runs of 4,000 steps, in this process.
    """
    label = agent if isinstance(agent, str) else getattr(agent, "__qualname__", repr(agent))
    options: dict[str, Any] = {"hyperparameters": hyperparameters, "worlds": worlds, "seeds": seeds, "steps": steps}
    return diagnosis_of(examine(agent, tell=tell, **options), label)


def diagnosis_of(examinations: Sequence[Examination], label: str) -> Diagnosis:
    """The diagnosis that follows from what was seen."""
    numbers = readings(examinations)
    kind = kind_of(numbers)
    library = [each for each in shipped() if kind in ("", each.kind)]
    findings = failed(numbers, library)
    shares = likeness(numbers, library)
    scores = {
        name: 1 - float(np.mean([each.regret for each in examinations if each.name == name]))
        for name in dict.fromkeys(each.name for each in examinations)
    }
    verdict = _verdict(findings, shares, kind, float(np.mean([*scores.values()])))
    trusted = accuracy(kind) if kind else accuracy("dqn")
    return Diagnosis(label, kind, verdict, tuple(findings), shares, trusted, scores, numbers)


def _verdict(findings: Sequence[Finding], shares: Mapping[str, float], kind: str, score: float) -> str:
    fault = suspect(shares)
    like = f"it is most like an agent in which {meanings(kind)[fault]} ({shares[fault]:.2f})" if fault else ""
    if findings:
        return f"Something is wrong: {findings[0].wrong}{'; ' * bool(like)}{like}."
    if fault:
        return f"No single number is unlike those of healthy agents, but {like}."
    if score < BROKEN:
        return f"It learns little (mean score {score:.2f}), and is like none of the known faults."
    return "Nothing is wrong that these worlds and checks can see."
