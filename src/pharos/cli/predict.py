"""pharos predict: how hard a world is for an agent behind an observation, before anything is trained."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pharos.cli.answers import Answer, compiling_fact, complain, console, progress_line
from pharos.cli.options import Count, file_ending, parse_parameters
from pharos.cli.target import Target
from pharos.errors import ParameterError
from pharos.system import compiling
from pharos.training import TrainingOptions

if TYPE_CHECKING:
    from pharos.validation import Prediction

DEFAULT = TrainingOptions(agent="dqn", steps=30_000)
OPTIONS = "agent steps hyperparameters sticky random lazy reward_noise"


def predict(
    target: Target,
    *,
    observation: Annotated[list[str] | None, typer.Option(metavar="NAME[,OPTION=VALUE...]")] = None,
    network: list[str] | None = None,
    training: Annotated[TrainingOptions, OPTIONS] = DEFAULT,
    horizon: Count | None = None,
    landmarks: Annotated[int | None, typer.Option(min=0)] = None,
    plot: Annotated[Path | None, file_ending(".png", ".pdf", ".svg")] = None,
) -> Answer:
    """Predict the regret of an agent behind each observation, before anything is trained.

    Args:
        observation: What the agent sees, as of train, such as hash,bits=64; again for another; vector when not given.
        network: mlp64, mlp256x3, cnn16, ..., or file.py:function, your own; again for another one. That of the agent
            when not given.
        agent: dqn or ppo.
        steps: Steps that it would learn from.
        horizon: Steps of an episode; the environment's time limit when not given.
        landmarks: Approximate the kernel by so many; 0: never; beyond 2,048 if not given.
        plot: Draw the bars into a PNG, PDF or SVG.
    """
    env = target.found_environment()
    from pharos.validation import predict as foretell

    with progress_line("predicting") as tell:
        prediction = foretell(
            env,
            [_observation(text) for text in observation or ["vector"]],
            networks=network or None,
            landmarks=landmarks,
            progress=tell,
            **{name: getattr(training, name) for name in ("agent", "steps", "hyperparameters", "chance")},
            horizon=horizon or "limit",
        )
    if plot is not None:
        from pharos import plots

        plots.save(plots.predictions(prediction), plot)
    answer = {**prediction.to_dict(), "plot": plot, "compiling_seconds": compiling.seconds()}
    return Answer(answer, lambda: _print(prediction, plot))


def _observation(text: str) -> tuple[str, dict[str, Any]]:
    """NAME,OPTION=VALUE,...: the name and the options."""
    name, *options = text.split(",")
    if not name or not all("=" in option for option in options):
        raise ParameterError(f"--observation is {text!r}; expected NAME or NAME,OPTION=VALUE, such as hash,bits=64")
    return name, parse_parameters(options)


def _print(prediction: "Prediction", plot: Path | None) -> None:
    from rich.markup import escape
    from rich.table import Table

    cells, screen = prediction.cells, console()
    screen.print(
        f"[bold]{escape(prediction.environment)}[/bold], {prediction.chance}: {prediction.states:,} states, "
        f"{prediction.agent.upper()} after {prediction.steps:,} steps"
    )
    table = Table(box=None, pad_edge=False, header_style="bold")
    for name in ("observation", "network"):
        table.add_column(name)
    for name in ("predicted regret", "80 % interval", "with a table"):
        table.add_column(name, justify="right")
    for cell in cells:
        ends = f"{cell.low:.2f} to {cell.high:.2f}"
        table.add_row(escape(cell.observation), escape(cell.network), f"{cell.value:.2f}", ends, f"{cell.tabular:.2f}")
    screen.print(table)
    for order in prediction.orders:
        screen.print(escape(str(order)))
    screen.print(
        f"[dim]0 is optimal, 1 is uniform play. By {prediction.predictor}; of {prediction.published_cells} published "
        f"cells of {prediction.published_classes} classes, such an interval held "
        f"{100 * prediction.coverage:.0f} % where the class was left out.[/dim]",
        soft_wrap=True,
    )
    for name, value in [*compiling_fact(), *([("plot", plot)] if plot else [])]:
        screen.print(f"[dim]{name}: {value}[/dim]")
    for warning in prediction.warnings:
        complain(f"warning: {warning}")
