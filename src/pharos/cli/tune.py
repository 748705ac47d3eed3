"""pharos tune: a search for hyperparameters."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from pharos.cli.answers import print_facts, print_json, progress_bar
from pharos.cli.options import Json, Random, Sticky, parse_seeds, parse_value
from pharos.cli.target import parse_environment
from pharos.errors import ParameterError


def tune(
    targets: Annotated[
        list[str],
        typer.Argument(metavar="TARGET...", help="Instances of one class, such as frozen_lake/4x4 frozen_lake/8x8."),
    ],
    agent: Annotated[str, typer.Option("--agent", help="As for `pharos train`.")] = "dqn",
    observation: Annotated[str, typer.Option("--observation", help="As for `pharos train`.")] = "vector",
    steps: Annotated[int, typer.Option("--steps", min=1, help="Steps of every run.")] = 50_000,
    trials: Annotated[int, typer.Option("--trials", min=1, help="Trials in all, earlier ones in --out included.")] = 50,
    seeds: Annotated[
        str, typer.Option("--seeds", metavar="A:B|S,...", help="Of the runs of a trial; not those of your experiment.")
    ] = "1000,1001",
    search: Annotated[
        list[str] | None,
        typer.Option(
            "--search",
            metavar="NAME=CHOICES",
            help="Search this instead of the agent's own space: learning_rate=log,0.0001,0.01, gamma=linear,0.9,1, "
            "batch_size=32,64. Can be given several times.",
        ),
    ] = None,
    search_seed: Annotated[int, typer.Option("--search-seed", min=0, help="Of the search.")] = 0,
    engine: Annotated[
        str, typer.Option("--engine", help="sb3; or batched: all runs of a trial that fit together as one program.")
    ] = "sb3",
    out: Annotated[
        Path | None, typer.Option("--out", help="Folder for the YAML and the record; a search there goes on.")
    ] = None,
    sticky: Sticky = 0.0,
    random: Random = 0.0,
    chance: Annotated[
        list[str] | None,
        typer.Option(
            "--chance",
            metavar="plain|NAME=P,...",
            help="A kind of chance, for every instance: --chance plain --chance random=0.1 --chance sticky=0.25.",
        ),
    ] = None,
    json: Json = False,
) -> None:
    """Search hyperparameters of an agent for one class of environments."""
    instances = [parse_environment(target) for target in targets]
    from pharos.training import tune as find

    with progress_bar("tuning", trials) as show:
        result = find(
            agent,
            instances,
            steps=steps,
            trials=trials,
            observation=observation,
            seeds=parse_seeds(seeds),
            sticky=sticky,
            random=random,
            chances=_chances(chance),
            space=_space(search),
            search_seed=search_seed,
            engine=engine,
            out=out,
            progress=_telling(show),
        )
    if json:
        print_json(
            {
                "agent": result.agent,
                "environment": result.environment,
                "observation": result.observation,
                "score": result.score,
                "first_score": result.first_score,
                "hyperparameters": result.hyperparameters,
                "trials": result.trials,
                "folder": out,
            }
        )
        return
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
    print_facts(f"{agent} on {result.environment}, {result.observation}", facts)


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
    """What `tune` calls after each trial: the best score so far, beside the bar."""
    return None if show is None else lambda done, _trials, best: show(done, f"best {best:.4g}")
