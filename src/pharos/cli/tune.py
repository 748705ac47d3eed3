"""pharos tune: a search for hyperparameters."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from pharos.cli.answers import Answer, progress_bar
from pharos.cli.options import Count, Seed, parse_seeds, parse_value
from pharos.cli.target import Target
from pharos.errors import ParameterError
from pharos.training import TrainingOptions

DEFAULT = TrainingOptions(agent="dqn")


def tune(
    targets: Annotated[list[str], typer.Argument(metavar="TARGET...")],
    *,
    training: Annotated[TrainingOptions, "agent observation steps engine sticky random"] = DEFAULT,
    trials: Count = 50,
    seeds: Annotated[str, typer.Option(metavar="A:B|S,...")] = "1000,1001",
    search: Annotated[list[str] | None, typer.Option(metavar="NAME=CHOICES")] = None,
    search_seed: Seed = 0,
    out: Path | None = None,
    chance: Annotated[list[str] | None, typer.Option(metavar="plain|NAME=P,...")] = None,
    shortlist_by_prediction: Count = 1,
) -> Answer:
    """Search hyperparameters of an agent for one class of environments.

    Args:
        targets: Instances of one class, such as frozen_lake/4x4 frozen_lake/8x8.
        trials: Trials in all, earlier ones in --out included.
        steps: Steps of every run.
        seeds: Of the runs of a trial; not those of your experiment.
        search: Search this instead of the agent's own space: learning_rate=log,0.0001,0.01, gamma=linear,0.9,1,
            batch_size=32,64. Can be given several times.
        search_seed: Of the search.
        engine: sb3; or batched: all runs of a trial that fit together as one program.
        out: Folder for the YAML and the record; a search there goes on.
        chance: A kind of chance, for every instance: --chance plain --chance random=0.1 --chance sticky=0.25.
        shortlist_by_prediction: Proposals for each trial, of which the one with the least predicted regret is run; for
            dqn and ppo.
    """
    instances = [Target(target).found_environment() for target in targets]
    from pharos.training import tune as find

    kinds, predicted = _chances(chance), None
    if shortlist_by_prediction > 1:
        from pharos.validation import regret_predictor

        predicted = regret_predictor(
            training.agent,
            instances,
            steps=training.steps,
            observation=training.observation,
            chances=kinds or [{"sticky": training.chance.sticky, "random": training.chance.random}],
        )
    with progress_bar("tuning", trials) as show:
        result = find(
            training.agent,
            instances,
            steps=training.steps,
            trials=trials,
            observation=training.observation,
            seeds=parse_seeds(seeds),
            sticky=training.chance.sticky,
            random=training.chance.random,
            chances=kinds,
            space=_space(search),
            search_seed=search_seed,
            engine=training.engine,
            shortlist=shortlist_by_prediction,
            predicted=predicted,
            out=out,
            progress=_telling(show),
        )
    names = ("agent", "environment", "observation", "score", "first_score", "hyperparameters", "trials")
    answer = {**{name: getattr(result, name) for name in names}, "folder": out}
    count = {
        word: sum(trial["status"] == word for trial in result.trials) for word in ("finished", "given up", "failed")
    }
    first = "-" if result.first_score is None else f"{result.first_score:.4g}"
    facts: list[tuple[str, object]] = [
        ("score", f"{result.score:.4g}  (mean normalised regret; with the table's hyperparameters {first})"),
        ("trials", ", ".join(f"{number} {word}" for word, number in count.items() if number)),
        *result.hyperparameters.items(),
    ]
    if out is not None:
        facts += [("use it", f"pharos train ... --hyperparameters {out / 'hyperparameters.yaml'}")]
    return Answer(answer, (f"{result.agent} on {result.environment}, {result.observation}", facts))


def _chances(words: list[str] | None) -> list[dict[str, float]] | None:
    """`["plain", "random=0.1"]` -> `[{}, {"random": 0.1}]`; None where nothing is said."""
    if not words:
        return None
    try:
        return [
            {} if word == "plain" else {name: float(p) for name, p in (part.split("=") for part in word.split(","))}
            for word in words
        ]
    except ValueError:
        raise ParameterError(
            f"--chance {' '.join(words)!r}; expected plain, or such as random=0.1, or sticky=0.25,random=0.1"
        ) from None


def _space(words: list[str] | None) -> dict[str, tuple[Any, ...]] | None:
    """`["batch_size=32,64"]` -> `{"batch_size": ("one of", 32, 64)}`; None where nothing is said."""
    if not words:
        return None
    space = {}
    for word in words:
        name, sign, text = word.partition("=")
        if not sign or not text:
            raise ParameterError(f"--search {word!r}; expected name=choices, such as batch_size=32,64")
        choices = tuple(parse_value(part) for part in text.split(","))
        space[name] = choices if choices[0] in ("log", "linear") else ("one of", *choices)
    return space


def _telling(show: Callable[[int, str], None] | None) -> Callable[[int, int, float], None] | None:
    """Return the callback of `tune`, which shows the best score so far, beside the bar."""
    return None if show is None else lambda done, _trials, best: show(done, f"best {best:.4g}")
