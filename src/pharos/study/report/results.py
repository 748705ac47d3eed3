"""Results of a study, read and computed once, from which its report is made."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from pharos.agents import TABULAR_OBSERVATION
from pharos.errors import PharosError
from pharos.study.aliasing import aliasing_table, with_aliasing
from pharos.study.analysis import PAPER_AGENTS, REGRETS, Models, PaperComparison, compare, intervals, models
from pharos.study.findings import findings
from pharos.study.profiles import improvements, other_winners, profiles, regret_differences
from pharos.study.specification import Specification
from pharos.study.status import Status, duration, status
from pharos.study.tables import cells, finished_runs, hardness_cost, hardness_table, paper_instance

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class Results:
    """Results of a study: tables of its runs, and the statistics of its report.

    Attributes:
        study, status: its specification, and its progress.
        runs, points: a row for each finished run, and for each of its evaluations.
        damaged: what is wrong with results that cannot be read, by id.
        hardness: a row for each instance and kind of chance that has finished runs.
        aliasing: a row for each instance and observation that was counted.
        cells: means over seeds, with hardness.
        models: of each agent that sees observations, for both kinds of regret, the first agent's first.
        intervals: of the normalised regret of each class, agent and observation.
        profiles, improvements: performance profiles of agents and observations, and how probable one improves on
            another.
        differences: in normalised regret, of each two agents or observations over all classes.
        other_winners: tasks on which the highest return and the least regret belong to different agents.
        comparison, findings: beside the paper. None if the study is not the paper's.
    """

    study: Specification
    status: Status
    runs: "pd.DataFrame"
    points: "pd.DataFrame"
    damaged: Mapping[str, str]
    hardness: "pd.DataFrame"
    aliasing: "pd.DataFrame"
    cells: "pd.DataFrame"
    models: Sequence[Models]
    intervals: "pd.DataFrame"
    profiles: "pd.DataFrame"
    improvements: "pd.DataFrame"
    differences: "pd.DataFrame"
    other_winners: "pd.DataFrame"
    comparison: PaperComparison | None
    findings: "pd.DataFrame | None"

    @property
    def agents(self) -> list[str]:
        """Agents that see observations, DQN first. Agents that see the index of the state have no models."""
        return observing_agents(self.runs)

    @cached_property
    def chances(self) -> dict[tuple[str, str], str]:
        """Kinds of chance in words by instance and kind: "(and of the world)" if the rules have chance."""
        words: dict[tuple[str, str], str] = {}
        for run in self.study.runs:
            if (key := (run.instance, run.chance)) not in words:
                try:
                    words[key] = run.chance_in_words
                except PharosError:  # of a class that is not there
                    words[key] = run.chance
        return words

    @property
    def notes(self) -> list[str]:
        """Notes on what is left out of the report, and why."""
        notes = list(self.damaged.values())
        if not self.agents:
            notes.append(f"{_listed(self.runs)} the index of the state: models are of agents that see observations")
        elif not self.has_models:
            notes.append(f"no models of hardness: {self.models[0].notes[0]}")
        else:
            notes += [note for each in self.models for note in each.notes]
        return list(dict.fromkeys(notes))

    @property
    def has_models(self) -> bool:
        """Whether there are enough cells, and enough differs between them, for any model of regret by hardness."""
        return any(each.fits for each in self.models)


def study_results(study: Specification, directory: Path, progress: Callable[[str], None] = lambda _: None) -> Results:
    """Read the results of a study, and compute the statistics of its report.

    Only instances and kinds of chance that have finished runs are measured.

    Raises:
        ParameterError: no run is finished.
    """
    progress("reading results")
    done = finished_runs(study, directory)
    # Tasks with finished runs, their hardness and aliasing
    tasks = set(zip(done.runs["instance"], done.runs["chance"], strict=True))
    number, seconds = hardness_cost(study, directory, tasks)
    if number:
        progress(f"hardness of {number} instances and kinds of chance: at most {duration(seconds)}, and building")
    hardness = hardness_table(study, directory, progress=progress, tasks=tasks)
    sizes = dict(zip(hardness["instance"], hardness["num_states"].astype(float), strict=True))
    aliasing = aliasing_table(study, directory, sizes, progress)
    table = with_aliasing(cells(done.runs, hardness), aliasing)
    # Models of regret, for each agent and kind of regret
    progress("fitting models")
    agents = observing_agents(done.runs) or [PAPER_AGENTS[0]]
    fitted = [
        models(table, agent=agent, regret=regret, measures=study.hardness.predictors)
        for agent in agents
        for regret in REGRETS
    ]
    of_the_paper = is_of_the_paper(study)
    return Results(
        study=study,
        status=status(study, directory),
        runs=done.runs,
        points=done.points,
        damaged=done.damaged,
        hardness=hardness,
        aliasing=aliasing,
        cells=table,
        models=fitted,
        intervals=intervals(done.runs),
        profiles=profiles(done.runs),
        improvements=improvements(done.runs),
        differences=regret_differences(done.runs),
        other_winners=other_winners(done.runs),
        comparison=compare(table, study.runs, fitted[: len(REGRETS)]) if of_the_paper else None,
        findings=findings(table, fitted[0]) if of_the_paper else None,
    )


def _listed(runs: "pd.DataFrame") -> str:
    """Agents of a study without observations, and their verb: "q_learning sees", "q_learning and sarsa see"."""
    names = sorted(runs["agent"].unique())
    return f"{' and '.join(names)} {'sees' if len(names) == 1 else 'see'}"


def observing_agents(runs: "pd.DataFrame") -> list[str]:
    """The agents of a study that see observations, the paper's first."""
    agents = list(dict.fromkeys(runs.loc[runs["observation"] != TABULAR_OBSERVATION, "agent"]))
    return sorted(agents, key=lambda agent: PAPER_AGENTS.index(agent) if agent in PAPER_AGENTS else len(PAPER_AGENTS))


def is_of_the_paper(study: Specification) -> bool:
    """Whether every instance is one of the paper's appendix C, and its agents are there."""
    agents = {run.config["agent"] for run in study.runs}
    return set(PAPER_AGENTS) <= agents and all(
        paper_instance(run.config["environment"], run.config["parameters"]) is not None for run in study.runs
    )


def coefficients(models: Models) -> "pd.DataFrame":
    """All coefficients of all fits: one row each."""
    import pandas as pd

    parts = [
        fit.coefficients.reset_index(names="predictor").assign(model=fit.model, subset=fit.subset)
        for fit in models.fits
    ]
    columns = ["model", "subset", "predictor", "estimate", "standard_error", "p_value", "lower", "upper"]
    return pd.concat(parts)[columns] if parts else pd.DataFrame(columns=columns)
