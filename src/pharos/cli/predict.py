"""pharos predict: how hard a world is for an agent behind an observation, before anything is trained."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pharos.cli.answers import compiling_fact, complain, console, print_json, progress_line
from pharos.cli.options import Json, Lazy, Parameters, Random, Sticky, TargetArgument, check_format, parse_parameters
from pharos.cli.target import parse_target
from pharos.errors import ParameterError
from pharos.system import compiling

if TYPE_CHECKING:
    from pharos.validation import Prediction


def predict(
    target: TargetArgument,
    parameters: Parameters = None,
    observation: Annotated[
        list[str] | None,
        typer.Option(
            "--observation",
            metavar="NAME[,OPTION=VALUE...]",
            help="What the agent sees, as of train, such as hash,bits=64; again for another; vector when not given.",
        ),
    ] = None,
    network: Annotated[
        list[str] | None,
        typer.Option(
            "--network",
            help="mlp64, mlp256x3, cnn16, ..., or file.py:function, your own; again for another one. "
            "That of the agent when not given.",
        ),
    ] = None,
    agent: Annotated[str, typer.Option("--agent", help="dqn or ppo.")] = "dqn",
    steps: Annotated[int, typer.Option("--steps", min=1, help="Steps that it would learn from.")] = 30_000,
    hyperparameter: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="Hyperparameter of the agent, such as gamma=0.95."),
    ] = None,
    sticky: Sticky = 0.0,
    random: Random = 0.0,
    lazy: Lazy = 0.0,
    reward_noise: Annotated[
        float, typer.Option("--reward-noise", min=0, help="Standard deviation of noise in what is paid; 0 on average.")
    ] = 0.0,
    horizon: Annotated[
        int | None,
        typer.Option("--horizon", min=1, help="Steps of an episode; the environment's time limit when not given."),
    ] = None,
    landmarks: Annotated[
        int | None,
        typer.Option(
            "--landmarks", min=0, help="Approximate the kernel by so many; 0: never; beyond 2,048 if not given."
        ),
    ] = None,
    plot: Annotated[Path | None, typer.Option("--plot", help="Draw the bars into a PNG, PDF or SVG.")] = None,
    json: Json = False,
) -> None:
    """Predict the regret of an agent behind each observation, before anything is trained."""
    if plot is not None:
        check_format(plot, (".png", ".pdf", ".svg"), "--plot")
    env = parse_target(target, parameters).found_environment()
    from pharos.validation import predict as foretell

    with progress_line("predicting") as tell:
        prediction = foretell(
            env,
            [_observation(text) for text in observation or ["vector"]],
            agent=agent,
            networks=network or None,
            steps=steps,
            sticky=sticky,
            random=random,
            lazy=lazy,
            reward_noise=reward_noise,
            horizon=horizon or "default",
            hyperparameters=parse_parameters(hyperparameter),
            landmarks=landmarks,
            progress=tell,
        )
    if plot is not None:
        from pharos import plots

        plots.save(plots.predictions(prediction), plot)
    if json:
        print_json({**prediction.to_dict(), "plot": plot, "compiling_seconds": compiling.seconds()})
        return
    _print(prediction, plot)


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
