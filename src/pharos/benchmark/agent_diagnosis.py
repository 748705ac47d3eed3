"""Diagnosis of an agent by name, or of a finished run of a benchmark: one answer, in words, numbers and a page.

An agent by name is trained on twelve small worlds, where its values are held against exact ones (`examination.py`). A
finished run is held against the baseline that it is nearest to, on groups of tasks that one mistake hits, if the others
are spared, and its scores against those of known faults. Nothing is trained for it.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from pharos.agents import agents
from pharos.benchmark.comparison import LEAST_DIFFERENCE, WORSE, compare_groups
from pharos.benchmark.contents import (
    MOST_RECORD_LETTERS,
    Contents,
    Source,
    contents_of,
    fails_on_the_lowest_rung,
    listed,
    run_warnings,
)
from pharos.benchmark.diagnosis import (
    LOSS,
    ONE_ACTION,
    groups_of,
    is_of,
    nearest,
    outside,
    policies_of,
    seeds_sentence,
    suspicion,
)
from pharos.benchmark.doctor import on_policy, readings
from pharos.benchmark.examination import EXAMINATION_PROTOCOL, NAMES, Examination, examine
from pharos.benchmark.faults import FAMILIES, FAULTS, HEALTHY, alike
from pharos.benchmark.play import play_of, play_symptoms
from pharos.benchmark.profiles import (
    BROKEN,
    CREDIBLE,
    PROFILES_FILE,
    SCORED_TASKS,
    SCORES,
    Accuracy,
    Finding,
    Judgement,
    Profile,
    accuracy,
    families,
    has_no_memory,
    has_scores_alone,
    is_on_policy,
    judged,
    kind_of,
    likeness,
    run_readings,
    shipped,
    suspect,
    with_signs,
)
from pharos.benchmark.scores import run_scores
from pharos.benchmark.suite import Suite, load_suite
from pharos.errors import ParameterError
from pharos.system.sources import is_reference
from pharos.system.wording import pluralize

EXPLORER = (
    "Its values are those of the policy that explores, as of SARSA. If it ought to take the largest next value, this "
    "is a fault."
)
TASK_LOSS, MOST_LOST = -0.3, 3  # of score, on a task that is named; tasks that are named
IN_PLAY = 0.05  # of score, that is lost by chance in play
LOSS_SIGNS: Mapping[str, tuple[str, tuple[str, ...]]] = {
    "vector": (
        "look for a number that never reaches the network (slices, the number of inputs), and at sizes of numbers",
        ("last_feature_lost",),
    ),
    "simple_image": ("divide bytes by 255, once; look at reshapes and the order of axes", ("bytes_not_divided",)),
    "rewards of several sizes": (
        "look for rewards that are clipped, scaled or normalised on their way",
        ("rewards_clipped",),
    ),
    "ended by time alone": ("bootstrap where truncated: only terminated ends a return", ("truncation_as_end",)),
    "exploration": (
        "look at epsilon or the entropy bonus at the beginning, and at small costs that are clipped",
        ("never_explores", "entropy_penalised", "rewards_clipped"),
    ),
    "estimation": (
        "look at step sizes, the size of batches, and the size of the replay buffer",
        ("replay_too_small", "learning_rate_high"),
    ),
    "credit": ("look at gamma, lambda and returns of several steps", ("gamma_half",)),
    "core": (
        "read in the report what failing these tasks means; where an end is what is lost, look at the done mask",
        ("terminal_bootstrapped", "value_without_mask"),
    ),
}
"""Groups of tasks and axes that one mistake hits: what to try, and the faults that they are a sign of."""
PLAY_SIGNS = {"random_play": ("epsilon_stuck",), "played_better": ("action_off_by_one", "plays_at_random")}
"""Symptoms of what an agent plays while it learns, and the faults that they are a sign of."""
ABILITIES = ("exploration", "estimation", "credit")
"""Axes of LOSS_SIGNS: a healthy agent with a smaller network or other hyperparameters may lose on them alone."""
WHERE = {"rewards of several sizes": "with rewards of several sizes", "ended by time alone": "ended by time alone"}
"""Groups by property, in words."""
LEAST_REGRET, MOST_REGRET = -0.5, 1e6  # that a curve may have; what is evaluated by episodes may be below 0


@dataclass(frozen=True)
class Diagnosis:
    """Result of `diagnose`.

    Attributes:
        agent: its label. kind: "dqn", "ppo", or empty if it offers no values.
        verdict: one sentence.
        findings: symptoms that are there, signs of the likeliest fault first, then the strongest.
        likeness: probability of each known fault, "none" among them, the largest first. Empty if a finished run lacks
            tasks that it needs, see `lacks`.
        fault: the known fault that is said, or None for none of the known ones.
        strange: whether it is farther from all known faults, and from health, than known ones are.
        accuracy: how often the likeness was right for agents that the library did not have.
        scores: by world, or by task of a finished run: 1 optimal and 0 as uniform play, mean of the seeds.
        readings: all numbers, see `doctor.readings`. Of a finished run see `run_readings`.
        on_policy: whether its values are those of the policy that explores, as of SARSA. If so, `readings` are by what
            was played, not by the largest next value. It is no fault of a learner on-policy.
        from_results: whether it is the diagnosis of a finished run.
        lacks: a sentence on what a finished run lacks for a likeness, and the command that gives it. Else empty.
    """

    agent: str
    kind: str
    verdict: str
    findings: tuple[Finding, ...]
    likeness: Mapping[str, float]
    fault: str | None
    strange: bool
    accuracy: Accuracy
    scores: Mapping[str, float]
    readings: Mapping[str, float] = field(default_factory=dict)
    on_policy: bool = False
    from_results: bool = False
    lacks: str = ""

    @property
    def is_healthy(self) -> bool:
        """Whether no check has found anything, and no fault is said."""
        return not self.findings and self.fault is None and not (not self.from_results and self.score < BROKEN)

    @property
    def score(self) -> float:
        """The mean of the scores."""
        return sum(self.scores.values()) / len(self.scores)

    @property
    def how_often(self) -> str:
        """A sentence on how far the likeness can be trusted."""
        right = self.accuracy
        if right.agents and self.from_results:
            tasks = sum(name.startswith("late_") for name in self.readings)
            played = " and played" * any(name.startswith("played_") for name in self.readings)
            return (
                f"By what was learnt{played} on {pluralize(tasks, 'task')} alone. Of {right.agents} agents of one "
                f"author, each left out of the table in turn, the fault was the likeliest for {right.first:.0%}, "
                f"among three for {right.three:.0%}; health was the likeliest for {right.healthy:.0%} of the healthy "
                f"ones. {self._alike}It is right less often for other code. Values say more: `pharos diagnose AGENT`."
            )
        if not right.agents:
            return "The table has one agent with each fault, so nothing is known of how often the likeness is right."
        return (
            f"Of {right.agents} agents, each left out of the table in turn, the fault was the likeliest for "
            f"{right.first:.0%}, among three for {right.three:.0%}; {right.healthy:.0%} of the healthy ones were "
            f"called healthy. If all agents with a fault were left out, the answer was none of the known ones, or the "
            f"right family, for {right.unknown:.0%}."
        )

    def group_of(self, fault: str) -> tuple[str, ...]:
        """The faults that a finished run hardly tells from a fault, which is among them."""
        return alike(self.kind, fault, by_scores=has_scores_alone(self.readings))

    @property
    def _alike(self) -> str:
        """A sentence on the faults that a finished run hardly tells from the likeliest, or empty."""
        group = self.group_of(next(iter(self.likeness), ""))
        if len(group) == 1:
            return ""
        names = listed(["healthy" if name == HEALTHY else name for name in group])
        share = sum(self.likeness[name] for name in group)
        return (
            f"A run hardly tells {names} apart, so read them as one ({share:.2f}): the likeliest group was right for "
            f"{self.accuracy.group:.0%}. "
        )

    @property
    def library(self) -> list[Profile]:
        """Known agents that it was held against."""
        return library_of(self.kind, SCORES if self.from_results else PROFILES_FILE)

    def nearest(self) -> list[tuple[str, float, str]]:
        """The three likeliest faults: (name, or "healthy" for none, likeness, in words)."""
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

    def to_html(self) -> str:
        """The page as HTML, with a plot beside the nearest known agents. It loads and runs nothing."""
        from pharos.benchmark.diagnosis_page import diagnosis_page

        return diagnosis_page(self)

    def __str__(self) -> str:
        """The page, as Markdown."""
        lines = [f"# Diagnosis of {self.agent}", "", self.verdict, ""]
        if self.findings:
            lines += ["## What no healthy agent shows", ""]
            lines += [f"{k}. {each.wrong}. *Try:* {each.advice}." for k, each in enumerate(self.findings, start=1)]
            lines.append("")
        if self.likeness:
            lines += ["## Nearest known agents", "", "| likeness | fault | |", "|---:|---|---|"]
            lines += [f"| {share:.2f} | {name} | {text} |" for name, share, text in self.nearest()]
            lines += ["", self.how_often, ""]
        lines += [self.lacks, ""] if self.lacks else []
        lines += ["## Scores", "", f"| {'task' if self.from_results else 'world'} | score |", "|---|---:|"]
        lines += [f"| {name} | {score:.2f} |" for name, score in self.scores.items()]
        return "\n".join(lines) + "\n"


def meanings(kind: str) -> dict[str, str]:
    """Faults in words, of all kinds if it is empty."""
    return {name: text for agent, table in FAULTS.items() if kind in ("", agent) for name, text in table.items()}


def library_of(kind: str, file: Path = PROFILES_FILE) -> list[Profile]:
    """Known agents of a kind, of all kinds if it is empty; of PROFILES_FILE, or SCORES."""
    return [each for each in shipped(file) if kind in ("", each.kind)]


def diagnose(
    agent: str | Callable[..., Any] | None = None,
    *,
    results: Source | None = None,
    hyperparameters: Mapping[str, Any] | None = None,
    worlds: Sequence[str] = NAMES,
    seeds: Sequence[int] = (0, 1),
    steps: int = EXAMINATION_PROTOCOL.steps,
    timeout: float | None = None,
    suite: Suite | str | None = None,
    progress: Callable[[float, str], object] = lambda share, text: None,
) -> Diagnosis:
    """Train an agent on twelve small worlds, or take a finished run, and say what is wrong, and what to try.

    Its policies are asked for `q_values(observations)`, (N, A), or `values(observations)`, (N,), if they offer them, as
    policies of Stable-Baselines3 do: these are held against exact ones. Without, only its behaviour is judged.

    Args:
        agent, hyperparameters, worlds, seeds, steps, timeout, progress: as `examine` takes them. Limits and likeness
            come from agents with all worlds, two seeds and 4,000 steps.
        results: in place of an agent: the folder or file of a finished run of a benchmark, or results read.
        suite: the suite of `results`, if it is not shipped.
    Raises:
        ParameterError: it is no agent, or it yields no policy, there are no such results, or both are given.
        PharosError: its code raises something, SystemExit included. TimeLimit: a run took longer than was allowed.
    Cost: 24 runs of 4,000 steps, in this process. Of results: less than a second.
    """
    if (agent is None) == (results is None):
        raise ParameterError(f"agent {agent!r}, results {results!r}; expected one of both")
    if results is not None:
        return diagnosis_of_results(contents_of(results, suite=suite))
    label = agent if isinstance(agent, str) else getattr(agent, "__qualname__", repr(agent))
    options: dict[str, Any] = {"hyperparameters": hyperparameters, "worlds": worlds, "seeds": seeds, "steps": steps}
    return diagnosis_of(examine(agent, timeout=timeout, progress=progress, **options), label)  # type: ignore[arg-type]


def diagnosis_of(examinations: Sequence[Examination], label: str) -> Diagnosis:
    """The diagnosis that follows from what was seen."""
    numbers = readings(examinations)
    kind = kind_of(numbers)
    answer, is_explorer = judged(numbers, library_of(kind)), False
    is_late = has_no_memory(numbers, library_of(kind))
    if is_late or is_on_policy(numbers, library_of(kind)):
        played = readings(examinations if is_late else [on_policy(each) for each in examinations], is_late)
        other = judged(played, library_of(kind))
        is_explorer = {each.reading for each in other.findings} < {each.reading for each in answer.findings}
        numbers, answer = (played, other) if is_explorer else (numbers, answer)
    scores = {
        name: 1 - float(np.mean([each.regret for each in examinations if each.name == name]))
        for name in dict.fromkeys(each.name for each in examinations)
    }
    notes: dict[str, list[tuple[str, str]]] = {}
    for each in examinations:
        for name, text in each.notes.items():
            notes.setdefault(name, []).append((f"{each.name}, seed {each.seed}", text))
    mistakes = [_mistake(name, runs, len(examinations)) for name, runs in notes.items()]
    return _diagnosis(label, kind, mistakes, answer, accuracy(kind or "dqn"), scores, numbers, is_explorer)


def _mistake(kind: str, runs: Sequence[tuple[str, str]], count: int) -> Finding:
    """A note on the loop of an agent, of some of its runs, as a finding."""
    (which, text), more = runs[0], f" and {pluralize(len(runs) - 1, 'other run')}" * (len(runs) > 1)
    wrong, _, advice = text.partition("; expected ")
    faults = ("seeds_ignored",) if kind == "same seed" else ()
    return Finding(kind, len(runs) / count, 0.0, f"{which}{more}: {wrong}", advice or "use all steps", 0.0, faults)


def _diagnosis(
    label: str,
    kind: str,
    mistakes: Sequence[Finding],
    answer: Judgement,
    trusted: Accuracy,
    scores: Mapping[str, float],
    numbers: Mapping[str, float],
    is_explorer: bool = False,
    **more: Any,
) -> Diagnosis:
    findings = (*mistakes, *answer.findings)
    entries = findings, answer.shares, answer.fault, answer.is_strange, trusted, scores, numbers, is_explorer
    diagnosis = Diagnosis(label, kind, "", *entries, **more)
    return replace(diagnosis, verdict=_verdict(diagnosis) + f" {EXPLORER}" * is_explorer)


def _verdict(diagnosis: Diagnosis) -> str:
    fault, shares = diagnosis.fault, diagnosis.likeness
    like = f"it is most like an agent in which {meanings(diagnosis.kind)[fault]} ({shares[fault]:.2f})" if fault else ""
    if fault and diagnosis.from_results and len(group := diagnosis.group_of(fault)) > 1:
        names = listed(["a healthy one" if name == HEALTHY else name for name in group])
        like += f"; a run hardly tells {names} apart"
    if diagnosis.findings:
        family, share = next(iter(families(shares).items()))
        near = f", and nearest to faults of {FAMILIES[family][0]}" if share > CREDIBLE else ""
        like = like or f"it is like none of the known faults{near}" * bool(shares and not diagnosis.from_results)
        is_weak = not fault and all(each.reading in ABILITIES and each.faults for each in diagnosis.findings)
        start = "It may be healthy, but weaker" if is_weak else "Something is wrong"
        return f"{start}: {diagnosis.findings[0].wrong}{'; ' * bool(like)}{like}."
    if fault:
        return f"No single number is unlike those of healthy agents, but {like}."
    if not diagnosis.from_results and diagnosis.score < BROKEN:
        return f"It learns little (mean score {diagnosis.score:.2f}), and is like none of the known faults."
    return f"Nothing is wrong that these {'results' if diagnosis.from_results else 'worlds'} and checks can see."


# Finished runs --------------------------------------------------------------------------------------------------------


def diagnosis_of_results(contents: Contents) -> Diagnosis:
    """The diagnosis that follows from a finished run, beside the baseline that it is nearest to."""
    results, kind = contents.agent.results, contents.predictor if contents.predictor in FAULTS else ""
    _check_curves(contents)
    scores = {name: float(runs.mean()) for name, runs in run_scores(results).items()}
    findings = sorted(findings_of(contents), key=lambda each: -each.strength)
    numbers, lacks = run_readings(results.curves, policies_of(results), play_of(results)), missing_tasks(contents)
    answer = Judgement(tuple(findings), {}, None, False)
    if not lacks:
        shares = with_signs(likeness(numbers, library_of(kind, SCORES)), findings)
        signs = {fault for each in findings for fault in each.faults}
        fault = next((each for each in [suspect(shares)] if each in signs), None)
        findings.sort(key=lambda each: fault not in each.faults)
        answer = Judgement(tuple(findings), shares, fault, False)
    mistakes = [
        Finding(
            "warning",
            1.0,
            0.0,
            text.rstrip(".")[:MOST_RECORD_LETTERS],
            "mend this first; see the page of `benchmark report`",
        )
        for text in (*seeds_sentence([contents.agent]), *run_warnings(results))
        if "first policy came after" not in text
    ]
    trusted = accuracy(kind or "dqn", SCORES, frozenset(numbers) or None)
    diagnosis = _diagnosis(
        contents.agent.name, kind, mistakes, answer, trusted, scores, numbers, from_results=True, lacks=lacks
    )
    hint = "" if diagnosis.findings else _suspicion_of(contents)
    return replace(diagnosis, verdict=f"{diagnosis.verdict} {hint}".strip())


def _suspicion_of(contents: Contents) -> str:
    """A sentence on a loss that too few seeds show, or empty, see `suspicion`."""
    if (near := nearest(contents)) is None:
        return ""
    by_seen, by_property = groups_of(contents)
    return suspicion(contents.agent.results, contents.beside[near[0]].results, {**by_seen, **by_property})


def _check_curves(contents: Contents) -> None:
    """Raise ParameterError for a curve of another protocol, or of regret that no policy has."""
    expected = contents.suite.protocol.evaluations
    for name, curve in contents.agent.results.curves.items():
        if curve.shape[1] != expected:
            raise ParameterError(
                f"results of {contents.agent.name}: {name} has {pluralize(curve.shape[1], 'evaluation')}; expected the "
                f"{expected} of suite {contents.suite.name}"
            )
        if not (curve.min() > LEAST_REGRET and curve.max() < MOST_REGRET):
            raise ParameterError(
                f"results of {contents.agent.name}: {name} has normalised regret of {curve.min():.3g} to "
                f"{curve.max():.3g}; expected 0, optimal, to {MOST_REGRET:g}; take the file as it was written"
            )


def missing_tasks(contents: Contents) -> str:
    """A sentence on the tasks that a finished run lacks for a likeness, and the command that gives it. Else empty."""
    suite, results, v1 = contents.suite, contents.agent.results, load_suite("v1")
    own = {task.name: task.digest for task in suite.tasks if task.name in results.curves}
    is_same = (suite.protocol.steps, suite.protocol.evaluations) == (v1.protocol.steps, v1.protocol.evaluations)
    missing = [name for name in SCORED_TASKS if not is_same or own.get(name) != v1.task(name).digest]
    if not missing:
        return ""
    more = f" and {len(missing) - 1} more" if len(missing) > 1 else ""
    source = results.record.get("source")
    agent = source["name"] if isinstance(source, Mapping) and isinstance(source.get("name"), str) else results.agent
    remedy = f"`pharos diagnose {agent}` compares them, in some minutes"
    if agent not in agents() and not is_reference(agent):  # a loop of the user's own
        remedy = "run your loop on these tasks, too: " + ", ".join(missing)
    return f"Known faults are not compared: the run lacks {missing[0]}{more} of the suite v1; {remedy}."


def findings_of(contents: Contents) -> list[Finding]:
    """Symptoms that a finished run shows beside the baseline that it is nearest to. Without one, symptoms of its
    own."""
    findings = _own_findings(contents)
    if (near := nearest(contents)) is None:
        return findings
    ours, other, comparison = contents.agent.results, contents.beside[near[0]], contents.comparisons[near[0]]
    below = [name for name in contents.agent.score.below_random if name not in other.score.below_random]
    if len(below) * 4 >= len(contents.agent.score.tasks):
        wrong = (
            f"worse than random play on {len(below)} of {len(contents.agent.score.tasks)} tasks, as {other.name} is not"
        )
        advice = (
            "look at the action that is executed (an index from 1, an offset), and at the sign of rewards and losses"
        )
        share = len(below) / len(contents.agent.score.tasks)
        findings.append(Finding("below_random", share, 0.25, wrong, advice, 10 * share, ("action_off_by_one",)))
    for symptom in play_symptoms(ours, other.results, other.name):
        words, strength = (symptom.wrong, symptom.advice), 10 * symptom.value / symptom.largest
        findings.append(Finding(symptom.name, symptom.value, symptom.limit, *words, strength, PLAY_SIGNS[symptom.name]))
    axes = {axis: own.score for axis, own in comparison.axes.items() if axis in LOSS_SIGNS}
    is_worse = [own.verdict == WORSE and own.interval.value <= -LOSS for own in axes.values()]
    if comparison.core is not None and comparison.core.verdict == WORSE and len(axes) > 1 and all(is_worse):
        wrong = f"it falls everywhere: the core and the axes of {listed([*axes])} are below {other.name}'s"
        advice = "look at the target network, the learning rate, and what is stored"
        return [*findings, Finding("everywhere", 1.0, 0.0, wrong, advice, 10.0, FAMILIES["updates"][1])]
    by_seen, by_property = groups_of(contents)
    groups = {**by_seen, **by_property}
    core = sorted(name for names in by_seen.values() for name in names)
    losses: dict[str, float] = {}  # the largest first
    for name, each in sorted(compare_groups(ours, other.results, groups).items(), key=lambda i: i[1].interval.value):
        loss, spared = each.interval.value, outside(ours, other.results, core, groups[name])
        if name not in LOSS_SIGNS or each.verdict != WORSE or spared <= loss / 2:
            continue
        if not any(is_of(loss, outside(ours, other.results, groups[name], groups[more])) for more in losses):
            losses[name] = loss
            where = f"core tasks {WHERE.get(name, f'seen as {name}')}"
            beside = "" if np.isnan(spared) else f", beside {spared:+.2f} on the others"
            findings += _loss(name, loss, f"{where}{beside}", other.name)
    if not losses and comparison.core is not None and comparison.core.verdict == WORSE:
        findings += _tasks_lost(contents, near[0], core)
    for axis, own in axes.items():
        if own.verdict != WORSE:
            continue
        rung, others = contents.agent.score.axes[axis], other.score.axes[axis]
        lines = _loss(axis, own.interval.value, f"the axis of {axis}", other.name)
        if lines and fails_on_the_lowest_rung(rung) and not fails_on_the_lowest_rung(others):
            scores = f"{rung.lowest.value:.2f}, {other.name} {others.lowest.value:.2f}"
            wrong = f"{lines[0].wrong}, whose lowest rung it fails already ({scores}): not a matter of {axis}"
            advice = "look for a bug in rewards and updates first"
            lines = [replace(lines[0], wrong=wrong, advice=advice, strength=0.0, faults=())]
        findings += lines
    return findings


def _tasks_lost(contents: Contents, index: int, core: Sequence[str]) -> list[Finding]:
    """A finding if the core is worse by LOSS, or by half of it and tasks are lost: these, and what the others lose."""
    other, comparison = contents.beside[index], contents.comparisons[index]
    assert comparison.core is not None
    loss = comparison.core.interval.value
    differences = {name: comparison.tasks[name].interval.value for name in core if name in comparison.tasks}
    lost = sorted((x, name) for name, x in differences.items() if x <= TASK_LOSS)[:MOST_LOST]
    if not lost:
        return _loss("core", loss, "the core", other.name)
    rest = outside(contents.agent.results, other.results, core, [name for _, name in lost])
    shown = listed([f"{name} ({x:+.2f})" for x, name in lost])
    beside = "" if np.isnan(rest) else f", beside {rest:+.2f} on the others"
    return _loss("core", loss, f"the core, most on {shown}{beside}", other.name, LOSS / 2)


def _loss(name: str, difference: float, where: str, other: str, least: float = LOSS) -> list[Finding]:
    if difference > -least:
        return []
    advice, faults = LOSS_SIGNS[name]
    wrong = f"it scores {-difference:.2f} less than {other} on {where}"
    return [Finding(name, difference, -least, wrong, advice, -difference / least, faults)]


def _own_findings(contents: Contents) -> list[Finding]:
    """Symptoms in what the final policies are like: one action nearly everywhere, noise in play."""
    facts, runs = policies_of(contents.agent.results), run_scores(contents.agent.results)
    fixed = [name for name, each in facts.items() if each["one_action"] >= ONE_ACTION]
    findings = []
    if facts and 2 * len(fixed) >= len(facts):
        wrong = f"on {len(fixed)} of {len(facts)} tasks the final policy prefers one action in 90 % of states and more"
        advice = "look at whether the observation reaches the network, and at the step size"
        faults = ("learning_rate_high", "bytes_not_divided")
        findings.append(Finding("one_action", len(fixed) / len(facts), 0.5, wrong, advice, 5.0, faults))
    noise = [each["greedy_score"] - float(runs[name].mean()) for name, each in facts.items() if "greedy_score" in each]
    if noise and (loss := sum(noise) / len(facts)) > IN_PLAY:
        wrong = f"played greedily, the same policies score {loss:.2f} more on {listed([pluralize(len(facts), 'task')])}"
        advice = "judge the greedy policy of a learner of values; look at the temperature and the entropy bonus"
        findings.append(Finding("noise", loss, IN_PLAY, wrong, advice, loss / LEAST_DIFFERENCE, ("plays_at_random",)))
    return findings
