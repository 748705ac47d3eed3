"""Tuning: hyperparameters for an agent on a class of environments, searched by Optuna's TPE sampler.

    FOLDER/hyperparameters.yaml   the best ones, in the form of agents/hyperparameters.yaml
    FOLDER/tuning.json            what was searched, and every trial: hyperparameters, score, status, seconds
    FOLDER/journal.log            Optuna's own record, from which an interrupted search goes on

A trial trains on every instance with every seed. Its score is the mean over these runs of the mean normalised regret of
their evaluations after the first: 0 is optimal from the first evaluation on, 1 as bad as acting at random. A trial
whose mean so far is worse than the median of earlier trials at the same point is given up. The first trial is what the
table says now, so that the best is never worse than that on the instances and seeds of the search.

Source: Bergstra et al. (2011), Algorithms for hyper-parameter optimization; Akiba et al. (2019), Optuna.
"""

import inspect
import json
import math
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pharos import storage
from pharos.agents import Q_LEARNING_DEFAULTS as Q_LEARNING
from pharos.agents import agent_kind, algorithm
from pharos.agents import hyperparameters as hyperparameters_of
from pharos.environments import Environment, make
from pharos.errors import MissingExtra, ParameterError
from pharos.experiments import results as _results
from pharos.experiments.config import ChanceSetting
from pharos.experiments.journal import JournalLock, mend_journal
from pharos.experiments.task import Task
from pharos.experiments.train import train_on
from pharos.observations import own_observation

EVALUATIONS = 20  # of a run

SPACES: dict[str, dict[str, tuple[Any, ...]]] = {
    "q_learning": {
        "learning_rate": ("log", 0.01, 1.0),
        "visits_exponent": ("one of", 0.0, 0.6, 0.8),
        "gamma": ("one of", 0.95, 0.99, 0.999),
        "initial_q": ("one of", 0.0, 0.5, 1.0, 2.0),
        "exploration_final_eps": ("linear", 0.0, 0.1),
        "exploration_fraction": ("linear", 0.01, 0.5),
    },
    "dqn": {
        "learning_rate": ("log", 5e-5, 2e-3),
        "batch_size": ("one of", 32, 64, 128),
        "gamma": ("one of", 0.95, 0.98, 0.99, 0.995),
        "n_steps": ("one of", 1, 3, 5),
        "train_freq": ("one of", 1, 4, 8),
        "learning_starts": ("one of", 200, 1000, 5000),
        "target_update_interval": ("one of", 100, 500, 1000, 2500),
        "exploration_fraction": ("linear", 0.05, 0.5),
        "exploration_final_eps": ("linear", 0.01, 0.1),
    },
    "ppo": {
        "learning_rate": ("log", 5e-5, 2e-3),
        "n_steps": ("one of", 16, 32, 64, 128, 256),
        "n_epochs": ("one of", 4, 8),
        "gamma": ("one of", 0.95, 0.98, 0.99, 0.995),
        "gae_lambda": ("linear", 0.8, 1.0),
        "ent_coef": ("log", 1e-4, 0.1),
        "clip_range": ("one of", 0.1, 0.2, 0.3),
    },
    "a2c": {
        "learning_rate": ("log", 5e-5, 5e-3),
        "n_steps": ("one of", 5, 16, 32),
        "gamma": ("one of", 0.95, 0.98, 0.99, 0.995),
        "gae_lambda": ("linear", 0.8, 1.0),
        "ent_coef": ("log", 1e-4, 0.1),
    },
}
"""What is searched for each agent: between two bounds on a logarithmic or a linear scale, or one of some values."""


@dataclass(frozen=True)
class TuningResult:
    """What a search found.

    Attributes:
        agent, environment, observation: whose hyperparameters these are; `environment` is the name of the class.
        hyperparameters: the best that were found, all of them, those that were not searched included.
        score: mean normalised regret of the best trial.
        first_score: that of the first trial, what the table said before; None where it was not finished.
        trials: a dictionary for each: number, hyperparameters, score, status ("finished", "given up", "failed"),
            seconds.
        folder: where it was written, or None.
    """

    agent: str
    environment: str
    observation: str
    hyperparameters: dict[str, Any]
    score: float
    first_score: float | None
    trials: list[dict[str, Any]]
    folder: Path | None


def tune(
    agent: str,
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
    out: str | os.PathLike | None = None,
    progress: Callable[[int, int, float], None] | None = None,
) -> TuningResult:
    """Search hyperparameters of an agent for environments of one class.

    Args:
        agent: as for `train`.
        environments: instances, named or made; all of one class.
        steps, observation, sticky, random: of every run, as for `train`.
        trials: number of trials, those that `out` holds already included.
        chances: several kinds of chance, such as [{}, {"random": 0.1}, {"sticky": 0.25}], each for every instance; in
            place of `sticky` and `random`.
        seeds: of the runs of a trial; keep them apart from the seeds of the experiment that follows.
        space: what is searched, in the form of `SPACES`; None: what that says of the agent.
        search_seed: of the search.
        out: folder; a search there goes on. None: nothing is written.
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

    given = [environments] if isinstance(environments, Environment | str) else list(environments)
    instances = [make(each) if isinstance(each, str) else each for each in given]
    name = _class_of(instances)
    searched = _checked_space(agent, space)
    seeds = [int(seed) for seed in seeds]
    if not seeds or trials < 1:
        raise ParameterError(f"{len(seeds)} seeds and {trials} trials; expected at least one of each")
    seen = agent_kind(agent).observation(observation)
    own = own_observation(seen)
    seen = str(own or seen)
    kinds = _checked_chances(chances, sticky, random)
    tasks = [
        Task(each, sticky=kind.sticky, random=kind.random, observation=own or seen)
        for each in instances
        for kind in kinds
    ]
    config = {
        "agent": agent,
        "instances": [{"environment": each.name, "parameters": each.parameters} for each in instances],
        "observation": seen,
        "steps": steps,
        "seeds": seeds,
        "chance": kinds[0].to_dict() if len(kinds) == 1 else [kind.to_dict() for kind in kinds],
        "space": {name: list(choices) for name, choices in searched.items()},
        "search_seed": search_seed,
    }
    config = json.loads(json.dumps(config))
    folder = None if out is None else Path(out)
    if folder is not None:
        _claim(folder, config)
    now = hyperparameters_of(agent, name, seen)
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    study = optuna.create_study(
        study_name=_results.identifier(config),
        storage=_storage(optuna, folder),
        sampler=optuna.samplers.TPESampler(seed=search_seed, n_startup_trials=min(10, max(2, trials // 4))),
        pruner=optuna.pruners.MedianPruner(n_startup_trials=5, n_warmup_steps=10),
        direction="minimize",
        load_if_exists=True,
    )
    if not _trials(study) and all(trial.state.name != "WAITING" for trial in study.trials):
        before = {key: now.get(key, _default(agent, key)) for key in searched}
        study.enqueue_trial({key: value for key, value in before.items() if _allows(searched[key], value)})

    for task in tasks:
        if not task.reference.optimal - task.reference.uniform > 1e-12:
            raise ParameterError(
                f"{task.env}: acting at random is optimal, so regret cannot be normalised; leave it out"
            )

    def objective(trial: Any) -> float:
        chosen = {key: _suggested(trial, key, choices) for key, choices in searched.items()}
        return _score(agent, tasks, seeds, steps, {**now, **chosen}, trial, optuna.TrialPruned)

    def after(*_: Any) -> None:
        if folder is not None:
            _write(folder, config, name, agent, seen, now, study)
        if progress is not None:
            progress(_done(study), trials, _best(study))

    missing = trials - _done(study)
    if missing > 0:
        study.optimize(objective, n_trials=missing, callbacks=[after])
    if not math.isfinite(_best(study)):
        raise ParameterError(f"none of {trials} trials was finished; give more trials, or look at tuning.json")
    records = _trials(study)
    return TuningResult(
        agent=agent,
        environment=name,
        observation=seen,
        hyperparameters={**now, **study.best_params},
        score=float(study.best_value),
        first_score=records[0]["score"],
        trials=records,
        folder=folder,
    )


def _score(
    agent: str,
    tasks: Sequence[Task],
    seeds: Sequence[int],
    steps: int,
    chosen: Mapping[str, Any],
    trial: Any,
    given_up: type[Exception],
) -> float:
    """The mean normalised regret of evaluations after the first, over all runs; `given_up` is raised on the way."""
    found: list[float] = []

    def progress(_done: int, _steps: int, row: Mapping[str, Any]) -> None:
        found.append(row["normalized_regret"])
        trial.report(sum(found) / len(found), len(found))
        if trial.should_prune():
            raise given_up

    for seed in seeds:
        for task in tasks:
            interval = max(1, steps // EVALUATIONS)
            train_on(
                task,
                agent,
                steps=steps,
                seed=seed,
                evaluation_interval=interval,
                hyperparameters=chosen,
                progress=progress,
            )
    return sum(found) / len(found)


# The space ------------------------------------------------------------------------------------------------------------


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


def _checked_space(agent: str, space: Mapping[str, Sequence[Any]] | None) -> dict[str, tuple[Any, ...]]:
    searched = space if space is not None else SPACES.get(agent)
    if not searched:
        raise ParameterError(
            f"agent {agent!r} has no space to search; expected one of {', '.join(SPACES)}, or give `space`, such as "
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


def _suggested(trial: Any, name: str, choices: tuple[Any, ...]) -> Any:
    kind, *values = choices
    if kind == "one of":
        return trial.suggest_categorical(name, values)
    return trial.suggest_float(name, *values, log=kind == "log")


def _default(agent: str, name: str) -> Any:
    """What the agent itself takes for a hyperparameter that the table leaves out; None: it says nothing."""
    if agent_kind(agent).is_tabular:
        return Q_LEARNING.get(name)
    parameter = inspect.signature(algorithm(agent)).parameters.get(name)
    return None if parameter is None or parameter.default is parameter.empty else parameter.default


def _allows(choices: tuple[Any, ...], value: Any) -> bool:
    kind, *values = choices
    if kind == "one of":
        return value in values
    return isinstance(value, int | float) and values[0] <= value <= values[1]


def _class_of(instances: Sequence[Environment]) -> str:
    names = sorted({each.name for each in instances})
    if len(names) != 1:
        raise ParameterError(f"environments of the classes {', '.join(names) or '(none)'}; expected those of one class")
    return names[0]


# Files ----------------------------------------------------------------------------------------------------------------


def _claim(folder: Path, config: Mapping[str, Any]) -> None:
    """Make the folder; ParameterError where another search lies there."""
    folder.mkdir(parents=True, exist_ok=True)
    try:
        kept = json.loads((folder / "tuning.json").read_text(encoding="utf-8"))["config"]
    except FileNotFoundError:
        return
    except (ValueError, KeyError, TypeError):
        raise ParameterError(f"{folder}/tuning.json: is not the record of a search; choose another folder") from None
    different = [key for key in config if kept.get(key) != config[key]]
    if different:
        raise ParameterError(f"{folder}: holds a search with another {', '.join(different)}; choose another folder")


def _storage(optuna: Any, folder: Path | None) -> Any:
    if folder is None:
        return None
    from optuna.storages.journal import JournalFileBackend

    journal_lock = JournalLock(folder)
    journal_lock.acquire()
    try:
        mend_journal(folder / "journal.log")
    finally:
        journal_lock.release()
    backend = JournalFileBackend(str(folder / "journal.log"), lock_obj=journal_lock)  # type: ignore[arg-type]
    return optuna.storages.JournalStorage(backend)


def _write(
    folder: Path, config: Mapping[str, Any], name: str, agent: str, seen: str, now: Mapping[str, Any], study: Any
) -> None:
    record = {"format": 1, "config": config, "versions": _results.versions(), "trials": _trials(study)}
    if math.isfinite(_best(study)):
        import yaml

        best = {**now, **study.best_params}
        record["best"] = {"trial": study.best_trial.number, "score": study.best_value, "hyperparameters": best}
        told = f"# Mean normalised regret {study.best_value:.4f} after {_done(study)} trials, see tuning.json\n"
        text = told + yaml.safe_dump({agent: {name: {seen: best}}}, sort_keys=False)
        storage.replace_file(folder / "hyperparameters.yaml", text)
    storage.replace_json(folder / "tuning.json", record)


def _trials(study: Any) -> list[dict[str, Any]]:
    words = {"COMPLETE": "finished", "PRUNED": "given up", "FAIL": "failed"}
    return [
        {
            "number": trial.number,
            "hyperparameters": trial.params,
            "score": trial.value if trial.state.name == "COMPLETE" else None,
            "status": words[trial.state.name],
            "seconds": trial.duration.total_seconds() if trial.duration else None,
        }
        for trial in study.trials
        if trial.state.name in words
    ]


def _done(study: Any) -> int:
    return sum(record["status"] != "failed" for record in _trials(study))


def _best(study: Any) -> float:
    scores = [record["score"] for record in _trials(study) if record["score"] is not None]
    return min(scores, default=math.inf)
