"""Diagnosis of an agent: symptoms in its values and behaviour, and the nearest of known faults.

`data/fault_profiles.csv` has the readings of small DQNs and PPOs, healthy ones and ones with a fault of `faults.py`,
each with hyperparameters and seeds of its own. `benchmarks/fault_profiles.py` makes it. Limits of symptoms are the most
extreme healthy agents in it, with a margin, so that no healthy agent of the table gets a finding.
The likeness of a fault is its probability by linear discriminant analysis among all faults of the agent's kind. An
agent that is far from all of them is like none of the known ones.

`data/fault_scores.csv` has the `run_readings` of the same agents on `SCORED_TASKS` and `IMAGE_TASK` of the suite v1,
for finished runs.

Source: Friedman (1989), Regularized discriminant analysis.
"""

import csv
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from types import MappingProxyType

import numpy as np

from pharos.benchmark.doctor import EQUATIONS
from pharos.benchmark.faults import FAMILIES, HEALTHY, alike
from pharos.benchmark.play import num_late

PROFILES_FILE = Path(__file__).parent / "data" / "fault_profiles.csv"
SCORES = PROFILES_FILE.with_name("fault_scores.csv")
SCORED_TASKS = (
    "frozen_lake-5-0-vector-random-0.1",
    "mini_grid_empty-8x8-one_hot-random-0.1",
    "deep_sea-8-one_hot",
    "umbrella_chain-22-hash",
)
"""Tasks of the suite v1 whose scores tell faults apart. A run that lacks one is not compared."""
IMAGE_TASK = "simple_grid-4-4-simple_image"
"""The core task of v1 that is seen as an image. It is compared if the run has it."""
SIGN = 3.0  # times as likely as before is a fault that a finding is a sign of
DECIMALS = 3
LARGEST = 4.0  # deviations within a fault that a reading counts as being away
DIAGONAL_WEIGHT = 0.5  # weight of the deviations alone in the covariance within a fault
INDEPENDENT = 8  # readings that count as independent evidence
LEAST_MARGIN = 0.3  # of a symptom's margin, that is added to the deviation of healthy agents
CREDIBLE = 0.6  # likeness from which a fault is said
HEALTHY_ONES = 3.0  # times as many agents that are healthy as agents with any one fault, before anything is seen
FARTHEST = 1.45  # mean squared deviation from the nearest fault up to which an agent is like a known one
ASIDE = ("on_policy", "on_policy_gap", "cut_partial_late", "itself_late")  # readings that are no part of the likeness
ON_POLICY_GAP = -0.03  # of residuals; agents of the table, which take the largest next value, have -0.014 to 0.42
BROKEN = 0.5  # mean regret of an agent of which no check and no fault says what is wrong


@dataclass(frozen=True)
class Symptom:
    """A reading that no healthy agent has.

    Attributes:
        reading: its name. is_high: whether it is wrong above the limit, not below.
        margin: beyond the most extreme healthy agent. beyond: what it is beyond besides, whatever healthy agents have.
        wrong: sentence, with {value} for `show(reading)`. advice: what to look at.
        faults: of the library that it is a sign of, the most likely first.
        kind: of agents that it is a symptom of, or empty for all.
        also: another reading that has to be beyond its limit as well, with the same margin and `beyond`: of lately
            visited states, as values that lag behind elsewhere look like it. Empty for none.
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
    also: str = ""

    def limit(self, healthy: Sequence[Mapping[str, float]], reading: str = "") -> float:
        """The limit by the readings of healthy agents, of its own reading or another one. No limit if they lack it."""
        sign, name = 1 if self.is_high else -1, reading or self.reading
        values = [sign * each[name] for each in healthy if name in each]
        return sign * (max(max(values) + self.margin, sign * self.beyond) if values else np.inf)

    def is_there(self, numbers: Mapping[str, float], healthy: Sequence[Mapping[str, float]]) -> bool:
        """Whether the readings of an agent are beyond the limits of healthy ones."""
        sign = 1 if self.is_high else -1
        names = [self.reading, self.also] if self.also else [self.reading]
        return all(sign * numbers.get(name, -sign * np.inf) > sign * self.limit(healthy, name) for name in names)


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
        also="cut_partial_late",
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
        also="itself_late",
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
        lambda value: f"{abs(value):.2f}",
    ),
)
"""All symptoms; those of one agent are told in the order of their strength."""


# Profiles -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Profile:
    """Readings of an agent with a fault, or a healthy one. kind: "dqn" or "ppo"."""

    kind: str
    fault: str
    readings: Mapping[str, float]


@cache
def shipped(file: Path = PROFILES_FILE) -> tuple[Profile, ...]:
    """Profiles of the library: PROFILES_FILE, or SCORES, those of finished runs."""
    with open(file, encoding="utf-8", newline="") as lines:
        return tuple(
            Profile(row.pop("agent"), row.pop("fault"), {name: float(text) for name, text in row.items() if text})
            for row in csv.DictReader(lines)
        )


def run_readings(
    curves: Mapping[str, np.ndarray],
    policies: Mapping[str, Mapping[str, float]],
    play: Mapping[str, float] = MappingProxyType({}),
) -> dict[str, float]:
    """Numbers of a finished run that are held against those of known faults.

    Args:
        curves: (runs, evaluations) normalised regret of each task.
        policies: facts on the policies of each task, see `training.policy_facts`, means over its runs.
        play: regret of play of each task in the last third of the run, see `play.play_of`.
    Returns:
        Of each of SCORED_TASKS and IMAGE_TASK that was run `score_` and its name, `late_`, the same of the last third
        of the evaluations, and `played_`, 1 less the regret of play. Means over SCORED_TASKS: `worse`, regret beyond
        that of uniform play in the last third, at most 1. If there are facts on the policies of all of them,
        `one_action` and `deterministic`.
    """
    names = [name for name in SCORED_TASKS if name in curves]
    tasks = [*names, IMAGE_TASK] if IMAGE_TASK in curves else names
    late = {name: curves[name][:, -num_late(curves[name].shape[1]) :].mean(axis=1) for name in tasks}
    numbers = {f"score_{name}": _score(curves[name].mean(axis=1)) for name in tasks}
    numbers |= {f"late_{name}": _score(late[name]) for name in tasks}
    numbers |= {f"played_{name}": _score(np.array([play[name]])) for name in tasks if name in play}
    if names:
        numbers["worse"] = float(np.mean([np.clip(late[name] - 1, 0, 1).mean() for name in names]))
    if names and all(name in policies for name in names):
        for fact in ("one_action", "deterministic"):
            numbers[fact] = float(np.mean([policies[name][fact] for name in names]))
    return numbers


def has_scores_alone(names: Collection[str]) -> bool:
    """Whether the readings of a finished run lack the image, or what was played."""
    return not {f"late_{IMAGE_TASK}", f"played_{IMAGE_TASK}"} <= {*names}


def _score(regrets: np.ndarray) -> float:
    return float(np.mean(1 - np.clip(regrets, 0, 1)))


def kind_of(numbers: Mapping[str, float]) -> str:
    """Kind of agent: "dqn" if the readings are of values of actions, "ppo" if of values of states, empty if of none."""
    if "consistency" not in numbers:
        return ""
    return "dqn" if "own" in numbers else "ppo"


def is_on_policy(numbers: Mapping[str, float], library: Sequence[Profile]) -> bool:
    """Whether values are farther from their backup with the largest next value than those of any healthy agent, but
    not from their backup with the next actions as they were played: those of a learner on-policy, such as SARSA.
    """
    return numbers.get("on_policy", np.inf) <= _farthest_healthy(library) < numbers.get("consistency", -np.inf)


def has_no_memory(numbers: Mapping[str, float], library: Sequence[Profile]) -> bool:
    """Whether values are those of a learner on-policy without a memory, such as SARSA with a network: far from both
    backups, but nearer to that of what was played, by ON_POLICY_GAP, in states that it visited of late.
    """
    residual = min(numbers.get(name, -np.inf) for name in ("on_policy", "consistency"))
    return residual > _farthest_healthy(library) and numbers.get("on_policy_gap", np.inf) <= ON_POLICY_GAP


def _farthest_healthy(library: Sequence[Profile]) -> float:
    """Largest `consistency` of healthy agents, with the margin of its symptom."""
    return next(each for each in SYMPTOMS if each.reading == "consistency").limit(_healthy(library))


def _healthy(library: Sequence[Profile]) -> list[Mapping[str, float]]:
    return [each.readings for each in library if each.fault == HEALTHY]


@dataclass(frozen=True, eq=False)
class Deviations:
    """Distances of an agent from each fault of a library, F, in each of n readings.

    Attributes:
        names: of readings that all have. A reading that is missing on one side says nothing.
        faults: F names, "none" among them. counts: (F,) agents with each.
        rows: (F, n) from the mean of each fault, in deviations within faults. covariance: (n, n) within faults.
    """

    names: list[str]
    faults: list[str]
    counts: np.ndarray
    rows: np.ndarray
    covariance: np.ndarray


def deviations(numbers: Mapping[str, float], library: Sequence[Profile]) -> Deviations:
    """The deviations of an agent's readings from those of a library."""
    names = [name for name in numbers if name not in ASIDE and all(name in each.readings for each in library)]
    rows = np.array([[each.readings[name] for name in names] for each in library])
    faults = sorted({each.fault for each in library})
    members = np.array([[each.fault == fault for each in library] for fault in faults])
    means = np.array([rows[own].mean(axis=0) for own in members])
    within = rows - means[np.argmax(members, axis=0)]
    freedom = max(len(rows) - len(faults), 1)
    units = np.sqrt((within**2).sum(axis=0) / freedom) + 0.05 * rows.std(axis=0) + 1e-3
    standard = within / units
    covariance = (1 - DIAGONAL_WEIGHT) * standard.T @ standard / freedom + DIAGONAL_WEIGHT * np.eye(len(names))
    x = np.array([numbers[name] for name in names])
    return Deviations(names, faults, members.sum(axis=1), (x - means) / units, covariance)


def likeness(numbers: Mapping[str, float], library: Sequence[Profile]) -> dict[str, float]:
    """Probability of each fault of a library, "none" among them, the largest first. They sum to 1.

    Differences of more than LARGEST deviations count as so many.
    """
    away = deviations(numbers, library)
    rows = np.clip(away.rows, -LARGEST, LARGEST)
    squares = np.einsum("fn,nf->f", rows, np.linalg.solve(away.covariance, rows.T))
    scores = -0.5 * squares * away.counts / (away.counts + 1)
    powers = np.exp((scores - scores.max()) * min(1.0, INDEPENDENT / rows.shape[1]))
    powers *= [HEALTHY_ONES if fault == HEALTHY else 1.0 for fault in away.faults]
    ranked = sorted(zip(away.faults, powers / powers.sum(), strict=True), key=lambda each: -each[1])
    return {fault: float(share) for fault, share in ranked}


def strangeness(numbers: Mapping[str, float], library: Sequence[Profile]) -> float:
    """Mean squared deviation of an agent's readings from those of the fault, or health, that it is nearest to."""
    away = deviations(numbers, library)
    squares = (np.clip(away.rows, -LARGEST, LARGEST) ** 2).mean(axis=1)
    return float((squares * away.counts / (away.counts + 1)).min())


def families(shares: Mapping[str, float]) -> dict[str, float]:
    """Likeness of each family of faults, the sum of its faults', the largest first."""
    sums = {name: sum(shares.get(fault, 0.0) for fault in faults) for name, (_, faults) in FAMILIES.items()}
    return dict(sorted(sums.items(), key=lambda each: -each[1]))


@dataclass(frozen=True)
class Accuracy:
    """Shares of agents for which the likeness was right, of those that were left out of the library.

    Of scores alone, `healthy` is the share for which health was likeliest, and `unknown` the share for which the
    likeliest other fault was of the same family.

    Attributes:
        agents: how many. first: share of those with a fault whose fault was the likeliest; three: among three.
        healthy: share of healthy ones without a symptom and without a fault that is likely.
        unknown: share of agents whose whole fault was left out for which the answer was none of the known ones, or
            another fault of the same family.
        group: share of agents with a fault for which it was in the likeliest group of `faults.ALIKE`.
    """

    agents: int
    first: float
    three: float
    healthy: float
    unknown: float
    group: float


def with_signs(shares: Mapping[str, float], findings: Sequence["Finding"]) -> dict[str, float]:
    """Likeness of faults, of which those that a finding is a sign of count SIGN times, the largest first."""
    signs = {fault for each in findings for fault in each.faults}
    weights = {fault: share * (SIGN if fault in signs else 1.0) for fault, share in shares.items()}
    total = sum(weights.values())
    return {fault: weights[fault] / total for fault in sorted(weights, key=lambda fault: -weights[fault])}


def suspect(shares: Mapping[str, float]) -> str | None:
    """The fault that is likely enough to be said, if there is one."""
    fault, share = next(iter(shares.items()), (HEALTHY, 0.0))
    return fault if fault != HEALTHY and share > CREDIBLE else None


@cache
def accuracy(kind: str, file: Path = PROFILES_FILE, names: frozenset[str] | None = None) -> Accuracy:
    """Accuracy of a shipped library for a kind of agent: each of its agents is left out in turn, then its fault.

    By the readings `names` alone, if they are given.
    """
    library = [
        replace(each, readings={name: x for name, x in each.readings.items() if names is None or name in names})
        for each in shipped(file)
        if each.kind == kind
    ]
    by_scores = has_scores_alone(frozenset(library[0].readings) if library else frozenset())
    ranks, healthy, unknown, in_group = [], [], [], []
    for index, each in enumerate(library):
        rest = library[:index] + library[index + 1 :]
        if each.fault not in {other.fault for other in rest}:
            continue
        answer = judged(each.readings, rest)
        if each.fault == HEALTHY:
            is_healthy = not answer.findings and answer.fault is None
            healthy.append(is_healthy if file == PROFILES_FILE else next(iter(answer.shares)) == HEALTHY)
            continue
        ranks.append([*answer.shares].index(each.fault))
        group_of = {fault: alike(kind, fault, by_scores=by_scores) for fault in answer.shares}
        groups = dict.fromkeys(group_of.values(), 0.0)
        for fault, share in answer.shares.items():
            groups[group_of[fault]] += share
        in_group.append(each.fault in max(groups, key=groups.__getitem__))
        answer = judged(each.readings, [other for other in rest if other.fault != each.fault])
        own = {fault for _, faults in FAMILIES.values() if each.fault in faults for fault in faults}
        is_right = answer.fault in own if answer.fault else bool(answer.findings) or answer.is_strange
        unknown.append(is_right if file == PROFILES_FILE else next(iter(answer.shares)) in own)
    rank = np.array(ranks)
    if not ranks or not healthy:
        return Accuracy(0, *[float("nan")] * 5)
    shares = (rank == 0).mean(), (rank < 3).mean(), np.mean(healthy), np.mean(unknown), np.mean(in_group)
    return Accuracy(len(ranks) + len(healthy), *map(float, shares))


# Diagnosis ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Finding:
    """A symptom that is there: the reading and the limit that no healthy agent passes, in words, and what to try.

    `strength` is how far beyond the limit it is, in deviations of healthy agents. `faults` are what it is a sign of.
    """

    reading: str
    value: float
    limit: float
    wrong: str
    advice: str
    strength: float = 0.0
    faults: tuple[str, ...] = ()


def failed(numbers: Mapping[str, float], library: Sequence[Profile]) -> list[Finding]:
    """Findings of symptoms that are there, the strongest first. Of equations only the one that fits best.

    Args:
        numbers: readings of an agent. library: profiles, of which the healthy ones set limits.
    """
    healthy, findings = _healthy(library), []
    for symptom in SYMPTOMS:
        if symptom.kind in ("", kind_of(numbers)) and symptom.is_there(numbers, healthy):
            value, limit = numbers[symptom.reading], symptom.limit(healthy)
            values = [each[symptom.reading] for each in healthy if symptom.reading in each]
            wrong = symptom.wrong.format(value=symptom.show(value))
            strength = abs(value - limit) / (float(np.std(values)) + LEAST_MARGIN * symptom.margin)
            findings.append(Finding(symptom.reading, value, limit, wrong, symptom.advice, strength, symptom.faults))
    equations = [each for each in findings if each.reading in EQUATIONS]
    best = min(equations, key=lambda each: each.value - each.limit, default=None)
    findings = [each for each in findings if each not in equations or each is best]
    return sorted(findings, key=lambda each: -each.strength)


@dataclass(frozen=True)
class Judgement:
    """Answer to an agent's readings: findings, the likeness of each fault, the fault that is said, if there is one.

    `is_strange`: it is farther from every known fault, and from health, than known ones are.
    """

    findings: tuple[Finding, ...]
    shares: Mapping[str, float]
    fault: str | None
    is_strange: bool


def judged(numbers: Mapping[str, float], library: Sequence[Profile]) -> Judgement:
    """The answer that a library gives. Signs of the fault that is said come first among the findings.

    The likeliest fault is said if a sign of it is there. Without a sign it is said if it has none, or nothing else is
    wrong either, and the agent is as near to it as known ones are.
    """
    shares, findings = likeness(numbers, library), failed(numbers, library)
    is_strange = strangeness(numbers, library) > FARTHEST
    fault = suspect(shares)
    if not any(fault in each.faults for each in findings):
        has_signs = any(fault in each.faults for each in SYMPTOMS)
        fault = None if is_strange or (findings and has_signs) else fault
    findings = sorted(findings, key=lambda each: fault not in each.faults)
    return Judgement(tuple(findings), shares, fault, is_strange)
