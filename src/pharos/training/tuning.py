"""Tuning: hyperparameters for an agent on a class of environments, searched by Optuna's TPE sampler.

    FOLDER/hyperparameters.yaml   the best ones, in the form that docs/agents.md describes
    FOLDER/tuning.json            what was searched, and every trial: hyperparameters, score, status, seconds, reports
                                  (means on the way, by evaluations), from which an interrupted search goes on

A trial trains on every instance with every seed. Its score is the mean over these runs of the mean normalised regret of
their evaluations after the first: 0 is optimal from the first evaluation on, 1 as bad as acting at random. A trial
whose mean so far is worse than the median of earlier trials at the same point is given up. With the batched engine all
runs of a trial that fit together are one program. The first trial is what the
table says now, so that the best is never worse than that on the instances and seeds of the search.

Source: Bergstra et al. (2011), Algorithms for hyper-parameter optimization, and Akiba et al. (2019), Optuna.
"""

import contextlib
import json
import math
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import product
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np

from pharos.agents import agent_called, agent_name, agents
from pharos.agents import hyperparameters as hyperparameters_of
from pharos.environments import Environment, make
from pharos.errors import FileFormatError, FolderLocked, MissingExtra, ParameterError
from pharos.mdp import ChanceSetting
from pharos.observations import OwnObservation, own_observation
from pharos.system import storage
from pharos.system.wording import pluralize
from pharos.training import results as _results
from pharos.training.execution import TrainingProgress, train_configs
from pharos.training.schedule import FailedRun, TaskCache
from pharos.training.task import RunConfig, Task, run_id

if TYPE_CHECKING:
    import optuna

RUN_EVALUATIONS = 20  # of a run
JOURNAL = "journal.log"
_STATUS = {"COMPLETE": "finished", "PRUNED": "given up"}
_SEARCH_AGAIN = "delete the folder and search again"


@dataclass(frozen=True)
class TuningResult:
    """Best hyperparameters of a search, and its trials.

    Attributes:
        agent, environment, observation: what the hyperparameters are for. `environment` is the name of the class.
        hyperparameters: the best that were found, all of them, those that were not searched included.
        score: mean normalised regret of the best trial.
        first_score: the score of the first trial, what the table said before. None if it was not finished.
        trials: a dictionary for each: number, hyperparameters, score, status ("finished", "given up"), seconds,
            reports (number of evaluations -> mean so far).
        folder: to which it was written, or None.
    """

    agent: str
    environment: str
    observation: str
    hyperparameters: dict[str, Any]
    score: float
    first_score: float | None
    trials: list[dict[str, Any]]
    folder: Path | None


def tune(  # noqa: PLR0913
    agent: str | Callable[..., Any],
    environments: Environment | str | Sequence[Environment | str],
    *,
    steps: int,
    trials: int = 50,
    observation: str = "vector",
    seeds: Iterable[int] = (0, 1),
    sticky: float = 0.0,
    random: float = 0.0,
    chances: Sequence[Mapping[str, float]] | None = None,
    space: Mapping[str, Sequence[Any]] | None = None,
    search_seed: int = 0,
    engine: str = "sb3",
    shortlist: int = 1,
    predicted: Callable[[Mapping[str, Any]], float] | None = None,
    out: str | os.PathLike | None = None,
    progress: Callable[[int, int, float], None] | None = None,
) -> TuningResult:
    """Search hyperparameters of an agent for environments of one class.

    Args:
        agent: as for `train`.
        environments: instances, named or made, all of one class.
        steps, observation, sticky, random: of every run, as for `train`.
        trials: number of trials, those that `out` holds already included.
        chances: several kinds of chance, such as [{}, {"random": 0.1}, {"reward_delay": 3}], each for every instance,
            in place of `sticky` and `random`.
        seeds: of the runs of a trial. Keep them apart from the seeds of the experiment that follows.
        space: what is searched: of each hyperparameter (of a function: a keyword) ("log", low, high), ("linear", low,
            high) or ("one of", value, ...). Default: the agent's own (`pharos.agents.Agent.space`).
        search_seed: of the search.
        engine: "sb3" trains the runs of a trial one after the other, "batched" at once.
        shortlist, predicted: of so many proposals the one is tried whose hyperparameters this function gives the least
            number, such as `pharos.prediction.regret_predictor`. The first trial is what the table says.
        out: folder. A search there goes on. None: nothing is written.
        progress: called after each trial with trials done, trials in all, and the best score so far.
    Raises:
        ParameterError: the environments are of several classes, the agent has no space, `out` holds another search, or
            no trial was finished. MissingExtra: Optuna is not installed.
    Cost: at most trials x instances x kinds of chance x seeds runs, about half of it with what is given up.
    """
    try:
        import optuna
    except ImportError as error:
        raise MissingExtra("tuning", "optuna", "agents") from error

    agent = agent_name(agent)
    listed = [environments] if isinstance(environments, Environment | str) else list(environments)
    instances = [make(each) if isinstance(each, str) else each for each in listed]
    seeds = [int(seed) for seed in seeds]
    if not seeds or trials < 1:
        raise ParameterError(f"{len(seeds)} seeds and {trials} trials; expected at least one of each")
    if shortlist < 1 or (shortlist > 1 and predicted is None):
        raise ParameterError(f"shortlist is {shortlist}; expected at least 1, and `predicted` where it is more")
    # What is searched
    search = _Search(
        agent=agent,
        instances=instances,
        environment=_class_of(instances),
        observation=observation,
        kinds=_checked_chances(chances, sticky, random),
        space=_checked_space(agent, space),
        seeds=seeds,
        steps=steps,
        search_seed=search_seed,
        engine=engine,
        shortlist=shortlist,
    )
    folder = None if out is None else Path(out)
    with contextlib.ExitStack() as held:
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)
            held.enter_context(storage.lock(folder, FolderLocked, "tuning"))
        # Trials one by one, after those that the folder holds
        records = [] if folder is None else _earlier_trials(optuna, search, folder)
        search.check_tasks()
        study = _study(optuna, search, records)
        while len(records) < trials:
            study.sampler = _sampler(optuna, search, len(records), trials)
            if records and shortlist > 1 and predicted is not None:
                study.enqueue_trial(_most_promising(optuna, search, records, trials, predicted))
            study.optimize(lambda trial: search.score(trial, optuna.TrialPruned), n_trials=1)
            records.append(_record(study.trials[-1]))
            if folder is not None:
                _write(folder, search, records)
            if progress is not None:
                progress(len(records), trials, _best(records)["score"])
        if folder is not None and (folder / JOURNAL).exists():
            _write(folder, search, records)
    best = _best(records)
    if not best["hyperparameters"]:
        number = pluralize(trials, "trial")
        raise ParameterError(f"none of {number} was finished; give more trials, or look at tuning.json")
    return TuningResult(
        agent=agent,
        environment=search.environment,
        observation=search.observation_name,
        hyperparameters={**search.table, **best["hyperparameters"]},
        score=float(best["score"]),
        first_score=records[0]["score"],
        trials=records,
        folder=folder,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Search:
    """Specification of a search: hyperparameters of an agent in `space`, on `instances` of the class `environment`."""

    agent: str
    instances: Sequence[Environment]
    environment: str
    observation: str
    kinds: Sequence[ChanceSetting]
    space: Mapping[str, tuple[Any, ...]]
    seeds: Sequence[int]
    steps: int
    search_seed: int
    engine: str
    shortlist: int
    task_cache: TaskCache = field(default_factory=TaskCache)

    @cached_property
    def observation_name(self) -> str:
        """The name of the observation."""
        return str(self._observed)

    @cached_property
    def _observed(self) -> OwnObservation | str:
        requested = agent_called(self.agent).observation(self.observation)
        return own_observation(requested) or requested

    @cached_property
    def tasks(self) -> list[Task]:
        """Every instance under every kind of chance."""
        return [Task(each, chance=kind, observation=self._observed) for each in self.instances for kind in self.kinds]

    @cached_property
    def table(self) -> dict[str, Any]:
        """Hyperparameters without the search: as in the first trial, and in every trial if none is searched."""
        return hyperparameters_of(self.agent, self.environment, self.observation_name)

    @cached_property
    def config(self) -> dict[str, Any]:
        """Configuration that determines the search, as tuning.json keeps it."""
        chance = [kind.to_dict() for kind in self.kinds]
        config = {
            "agent": self.agent,
            "instances": [{"environment": each.name, "parameters": each.parameters} for each in self.instances],
            "observation": self.observation_name,
            "steps": self.steps,
            "seeds": self.seeds,
            "chance": chance[0] if len(chance) == 1 else chance,
            "space": {name: list(choices) for name, choices in self.space.items()},
            "search_seed": self.search_seed,
        }
        if self.engine != "sb3":
            config["engine"] = self.engine
        if self.shortlist > 1:
            config["shortlist"] = self.shortlist
        return json.loads(json.dumps(config))

    def check_tasks(self) -> None:
        """Raise ParameterError for a task on which regret cannot be normalised."""
        for task in self.tasks:
            if not math.isfinite(task.reference.spread()):
                raise ParameterError(
                    f"{task.env}: acting at random is optimal, so regret cannot be normalised; leave it out"
                )

    def proposal(self, trial: "optuna.Trial") -> dict[str, object]:
        """The hyperparameters that Optuna's trial proposes."""
        return {key: suggested_value(trial, key, choices) for key, choices in self.space.items()}

    def score(self, trial: "optuna.Trial", pruned: type[Exception]) -> float:
        """The mean normalised regret of evaluations after the first, over all runs. `pruned` is raised on the way."""
        hyperparameters = {**self.table, **self.proposal(trial)}
        interval = max(1, self.steps // RUN_EVALUATIONS)
        configs: list[RunConfig] = []
        regrets: list[float] = []
        # A run for each task and seed
        for seed, task in product(self.seeds, self.tasks):
            config = RunConfig.of_task(
                task,
                self.agent,
                steps=self.steps,
                seed=seed,
                evaluation_interval=interval,
                hyperparameters=hyperparameters,
                engine=self.engine,
            )
            self.task_cache.adopt(config, task)
            configs.append(config)

        def progress(now: TrainingProgress) -> None:
            regrets.extend(row["normalized_regret"] for row in now.rows.values())
            trial.report(sum(regrets) / len(regrets), len(regrets))
            if trial.should_prune():
                raise pruned

        # Train them, reporting means on the way
        for group in [configs] if self.engine == "batched" else [[config] for config in configs]:
            for end in train_configs(group, progress=progress, tasks=self.task_cache):
                if isinstance(end, FailedRun):
                    raise end.exception
        return sum(regrets) / len(regrets)


def _checked_space(agent: str, space: Mapping[str, Sequence[Any]] | None) -> dict[str, tuple[Any, ...]]:
    """`space`, or the space of the agent. ParameterError if there is none, or an entry is wrong."""
    searched = space if space is not None else agent_called(agent).space
    if not searched:
        raise ParameterError(
            f"agent {agent!r} has no space to search; expected one of {', '.join(agents())}, or give `space`, such as "
            f"{{'learning_rate': ('log', 0.0001, 0.01)}}"
        )
    for name, choices in searched.items():
        kind, *values = choices
        ranged = kind in ("log", "linear") and len(values) == 2 and 0 <= values[0] < values[1]
        if not (ranged and (kind == "linear" or values[0] > 0)) and not (kind == "one of" and values):
            raise ParameterError(
                f"space: {name} is {tuple(choices)!r}; expected ('log', low, high), ('linear', low, high) "
                f"or ('one of', value, ...)"
            )
    return {name: tuple(choices) for name, choices in searched.items()}


def suggested_value(trial: "optuna.Trial", name: str, choices: tuple[Any, ...]) -> object:
    """The value of a hyperparameter that Optuna's trial suggests."""
    kind, *values = choices
    if kind == "one of":
        return trial.suggest_categorical(name, values)
    return trial.suggest_float(name, *values, log=kind == "log")


def _allows(choices: tuple[Any, ...], value: object) -> bool:
    """Whether a value lies in the part of the space that `choices` describe."""
    kind, *values = choices
    if kind == "one of":
        return value in values
    return isinstance(value, int | float) and values[0] <= value <= values[1]


def _study(optuna: ModuleType, search: _Search, records: Sequence[Mapping[str, Any]]) -> "optuna.Study":
    """Optuna's study with the trials that are over. Its first trial has the hyperparameters of the table."""
    optuna.logging.set_verbosity(optuna.logging.ERROR)  # what fails is raised
    pruner = optuna.pruners.MedianPruner(n_startup_trials=5, n_warmup_steps=10)
    study = optuna.create_study(pruner=pruner, direction="minimize")
    distributions = {
        name: optuna.distributions.CategoricalDistribution(values)
        if kind == "one of"
        else optuna.distributions.FloatDistribution(*values, log=kind == "log")
        for name, (kind, *values) in search.space.items()
    }
    for record in records:
        study.add_trial(
            optuna.trial.create_trial(
                state=getattr(optuna.trial.TrialState, "PRUNED" if record["score"] is None else "COMPLETE"),
                value=record["score"],
                params=record["hyperparameters"],
                distributions={name: distributions[name] for name in record["hyperparameters"]},
                intermediate_values={int(step): mean for step, mean in record.get("reports", {}).items()},
            )
        )
    if not records:
        before = {key: search.table.get(key, agent_called(search.agent).library_default(key)) for key in search.space}
        study.enqueue_trial({key: value for key, value in before.items() if _allows(search.space[key], value)})
    return study


def _most_promising(
    optuna: ModuleType,
    search: _Search,
    records: Sequence[Mapping[str, Any]],
    trials: int,
    predicted: Callable[[Mapping[str, Any]], float],
) -> dict[str, Any]:
    """The proposal for the next trial with the least predicted number of `search.shortlist`, the first of equals."""
    scratch, proposals = _study(optuna, search, records), []
    for number in range(search.shortlist):
        scratch.sampler = _sampler(optuna, search, len(records), trials, number)
        proposals.append(search.proposal(scratch.ask()))
    return min(proposals, key=lambda proposal: predicted({**search.table, **proposal}))


def _sampler(
    optuna: ModuleType, search: _Search, done: int, trials: int, *number: int
) -> "optuna.samplers.BaseSampler":
    """Sampler of the next trial, seeded by the number of trials done: a killed search goes on as it would have."""
    seed = int(np.random.SeedSequence([search.search_seed, done, *number]).generate_state(1)[0])
    return optuna.samplers.TPESampler(
        seed=seed,
        n_startup_trials=min(10, max(2, trials // 4)),
        constant_liar=False,  # what was running when the search was killed counts for nothing
    )


def _checked_chances(
    chances: Sequence[Mapping[str, float]] | None, sticky: float, random: float
) -> list[ChanceSetting]:
    if chances is None:
        return [ChanceSetting(sticky, random)]
    if sticky or random or not chances:
        raise ParameterError(
            f"chances are {list(chances)}, sticky is {sticky} and random {random}; expected one or the other"
        )
    return [ChanceSetting.from_dict({name: float(value) for name, value in each.items()}) for each in chances]


def _class_of(instances: Sequence[Environment]) -> str:
    names = sorted({each.name for each in instances})
    if len(names) != 1:
        raise ParameterError(f"environments of the classes {', '.join(names) or '(none)'}; expected those of one class")
    return names[0]


# Files ----------------------------------------------------------------------------------------------------------------


def _earlier_trials(optuna: ModuleType, search: _Search, folder: Path) -> list[dict[str, Any]]:
    """The trials of a search that goes on, also of an earlier pharos, which kept them in a journal of Optuna's.

    Raises:
        ParameterError: another search lies there. FileFormatError: its files were changed, or cut short.
    """
    file, journal = folder / "tuning.json", folder / JOURNAL
    try:
        stored = storage.read_json(file, advice=_SEARCH_AGAIN)
        if not storage.is_intact(stored):
            raise FileFormatError(f"{file}: was changed after it was written; {_SEARCH_AGAIN}")
        before, now = stored["config"], search.config
        different = [key for key in {**now, **before} if before.get(key) != now.get(key)]
        trials = [trial for trial in stored["trials"] if trial["status"] in _STATUS.values()]
    except FileNotFoundError:
        trials, different = [], []
    except (KeyError, TypeError, AttributeError):
        raise ParameterError(f"{file}: is not the record of a search; choose another folder") from None
    if different:
        raise ParameterError(f"{folder}: holds a search with another {', '.join(different)}; choose another folder")
    if not journal.exists():
        return trials
    from optuna.storages.journal import JournalFileBackend

    try:
        storage.check_regular(journal)
        backend = optuna.storages.JournalStorage(JournalFileBackend(str(journal)))
        old = optuna.load_study(study_name=run_id(search.config), storage=backend)
        return [_record(trial) for trial in old.trials if trial.state.name in _STATUS]
    except Exception as error:  # Optuna trusts what it reads
        message = f"{type(error).__name__}: {' '.join(str(error).split())}"
        raise FileFormatError(f"{journal}: is not as Optuna wrote it ({message}); {_SEARCH_AGAIN}") from error


def _write(folder: Path, search: _Search, trials: Sequence[dict[str, Any]]) -> None:
    record = {"format": 1, "config": search.config, "versions": _results.versions(), "trials": trials}
    if hyperparameters := (best := _best(trials))["hyperparameters"]:
        import yaml

        mine = {**search.table, **hyperparameters}
        record["best"] = {"trial": best["number"], "score": best["score"], "hyperparameters": mine}
        number = pluralize(len(trials), "trial")
        head = f"# Mean normalised regret {best['score']:.4f} after {number}, see tuning.json\n"
        text = head + yaml.safe_dump(
            {search.agent: {search.environment: {search.observation_name: mine}}}, sort_keys=False
        )
        storage.replace_file(folder / "hyperparameters.yaml", text)
    storage.replace_json(folder / "tuning.json", storage.sealed(storage.plain(record)))
    (folder / JOURNAL).unlink(missing_ok=True)


def _record(trial: "optuna.trial.FrozenTrial") -> dict[str, Any]:
    """A trial that is over, as tuning.json keeps it."""
    return {
        "number": trial.number,
        "hyperparameters": trial.params,
        "score": trial.value if trial.state.name == "COMPLETE" else None,
        "status": _STATUS[trial.state.name],
        "seconds": trial.duration.total_seconds() if trial.duration else None,
        "reports": {str(step): mean for step, mean in trial.intermediate_values.items()},
    }


def _best(trials: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The first of the best trials, with a score of infinity if none is finished."""
    finished = [trial for trial in trials if trial["status"] == "finished"]
    return min(finished, key=lambda trial: trial["score"], default={"score": math.inf, "hyperparameters": {}})
