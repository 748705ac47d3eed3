"""pharos hardness: all measures of one instance in a table, with exactness and sources.

pharos predict: how hard a world is for an agent behind an observation, before anything is trained.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pharos.cli.answers import (
    Answer,
    GrowingTable,
    compiling_fact,
    complain,
    console,
    print_table,
    progress_line,
    told_if_slow,
)
from pharos.cli.options import Building, Chance, Count, Discount, Seconds, Target, file_ending, parse_parameters
from pharos.errors import ParameterError, UnknownName
from pharos.system import compiling
from pharos.system.wording import pluralize
from pharos.training import TrainingOptions

if TYPE_CHECKING:
    from pharos.hardness import Report, Representation, Result
    from pharos.mdp import TabularMDP
    from pharos.prediction import Prediction


# What the column "exact" says of each kind of certificate.
PROVEN = {"exact": "yes", "interval": "interval", "float64": "float64"}
IDEALISED = (
    *("kernel_regret", "kernel_policy_regret", "sampled_regret", "huber_regret"),
    *("network_regret", "network_policy_regret"),
)


def hardness(
    target: Target,
    *,
    measures: Annotated[str | None, "A,B"] = None,
    gamma: Discount | None = None,
    horizon: Annotated[int | None, typer.Option(min=1)] = None,
    chance: Chance,
    tolerance: float = 1e-9,
    restart: bool = True,
    budget: Seconds = 30.0,
    observation: str | None = None,
    option: Mapping[str, Any],
    network: str | None = None,
    initialisation: str | None = None,
    optimizer: str | None = None,
    landmarks: Annotated[int | None, typer.Option(min=0)] = None,
    definitions: bool = False,
    latex: bool = False,
    values: Path | None = None,
    fresh: bool = False,
    building: Building,
    json: bool,
) -> Answer:
    """Measure how hard an instance is: visitation, estimation and planning complexity.

    Args:
        measures: Names of measures, or all. Default: the quick ones.
        gamma: Discount of values and gaps. Default: 0.99, or the discount of an imported file.
        horizon: Steps of an episode, for measures of episodes.
        tolerance: Largest error of the optimal values, in units of return.
        restart: Let terminal states lead back to the start.
        budget: Seconds a measure may take before it gives a proven interval, or says that it is not available.
        observation: Observation, as in `pharos train`. Adds measures of how its network represents states.
        option: Option of the observation, such as hide=row.
        network: mlp128, mlp128x2, cnn16, nature, or your own file.py:function. Default: the agents' network.
        initialisation: Initialisation of the network: pytorch (the default, as in DQN) or sb3 (as in PPO and A2C).
        optimizer: Optimizer of the idealised learner: gradient (the default), or adam, which rescales gradients.
        landmarks: Landmarks of the kernel approximation. 0 turns it off. Default: only above 4,096 observations.
        definitions: Show definitions and sources.
        latex: Print a LaTeX table.
        values: Keep values and bounds in this folder while they are computed, in place of memory. An interrupted
            computation resumes.
        fresh: Compute measures anew, even if they are stored beside the state space.
    """
    from pharos.hardness import selected_measures

    # an unknown name is told before anything is built
    wanted = selected_measures(measures, is_seen=observation is not None)
    needs_rewards = any(each.depends != "structure" for each in wanted)
    of_network = {"network": network, "initialisation": initialisation, "optimizer": optimizer, "landmarks": landmarks}
    useless = [name for name, value in {"option": option or None, **of_network}.items() if value is not None]
    if observation is None and useless:
        raise ParameterError(f"--{useless[0]} goes with --observation NAME, what the agent sees")
    own = target.is_imported  # an imported MDP has a discount and a horizon of its own
    with told_if_slow("building the state space, or loading it"):
        mdp = target.mdp(
            building,
            gamma=0.99 if gamma is None and not own else gamma,
            horizon=horizon if gamma == 1 or own else None,
            chance=chance,
            by_range=not needs_rewards,
        )
    representation = None
    if observation is not None:
        named = {"network": network, "initialisation": initialisation or "pytorch", "landmarks": landmarks}
        mdp, representation = _represented(target, mdp, observation, building, {**option, **named})
    names = [each.name for each in wanted]
    steps = mdp.horizon if horizon is None else horizon
    if measures is None and steps is None and mdp.gamma < 1:
        names.insert(names.index("effective_horizon") + 1, "stationary_effective_horizon")  # which needs no horizon
    from pharos.hardness import Schedule
    from pharos.hardness import report as measure

    table = None
    if not (json or latex):
        shown = [name for name in names if measures is not None or steps is not None or name != "covering"]
        is_named = measures is not None
        table = _Table(target.title, _setting(mdp, steps, chance), shown, definitions, is_named)
    with progress_line("measuring") as progress:

        def show(result: "Result") -> None:
            if table is not None:
                with progress.away():
                    table.add(result)

        report = measure(
            mdp,
            names,
            horizon=horizon,
            tolerance=tolerance,
            restart=restart,
            budget=budget,
            keep=not fresh,
            progress=lambda what, line: progress(f"{what}  {line}".rstrip()),
            on_result=show,
            representation=representation,
            schedule=None if representation is None else Schedule(optimizer=optimizer or "gradient"),
            folder=values,
        )
    answer = {**report.to_dict(), "compiling_seconds": compiling.seconds()}
    return Answer(answer, report.to_latex() if table is None else lambda: _print_notes(report))


def _represented(
    goal: Target, mdp: "TabularMDP", observation: str, building: Building, options: dict[str, Any]
) -> "tuple[TabularMDP, Representation]":
    """The MDP with states numbered as in the state space, and their representation by the observation."""
    from pharos.observations import representation

    space = goal.space(building)
    if goal.is_imported:  # its table has an order of its own
        from dataclasses import replace

        from pharos.mdp import lazy_actions

        own = lazy_actions(space.mdp(gamma=mdp.gamma).with_horizon(mdp.horizon), mdp.laziness)
        mdp = replace(own, chance=mdp.chance)
    with progress_line("observing"):
        return mdp, representation(space, observation, **options)


def _setting(mdp: "TabularMDP", horizon: int | None, chance: Chance) -> str:
    """Size, discount, horizon and chance, in a line."""
    states, actions = pluralize(mdp.num_states, "state"), pluralize(mdp.num_actions, "action")
    discount = f"discount {mdp.gamma:g}, horizon {'none' if horizon is None else horizon}"
    return f"{states} x {actions}, {discount}, chance: {chance.in_words(mdp.dynamics.has_chance)}"


# Widths of the column of values: of all, and of measures whose values are several numbers.
VALUE, LONG_VALUES = 28, {**dict.fromkeys(IDEALISED, 50), "stationary_effective_horizon": 30, "covering": 68}


class _Table:
    """Measures in rows, each printed as soon as it is there.

    Args:
        names: of the measures.
        is_named: whether the user named them, so that one that is not defined has a row as well.
    """

    def __init__(self, title: str, setting: str, names: list[str], definitions: bool, is_named: bool):
        from rich.markup import escape

        self.has_definitions, self.is_named = definitions, is_named
        screen = console()
        screen.print(escape(title), style="bold", soft_wrap=True)
        screen.print(escape(setting), style="dim", soft_wrap=True)
        width = max((LONG_VALUES.get(name, VALUE) for name in names), default=VALUE)
        columns = {"measure": max(map(len, names)), "value": width, "exact": 10, ">seconds": 7}
        self.rows = GrowingTable(columns | ({"definition": 0, "source": 0} if definitions else {}))

    def add(self, result: "Result") -> None:
        """Print the row of a measure, unless it is not defined and nobody asked for it."""
        from rich.text import Text

        if result.undefined and not (result.is_out_of_budget or self.is_named):
            return
        missing = "not available" if result.is_out_of_budget else "undefined"
        value = Text(missing, "dim") if result.undefined else result.text
        exact = "" if result.undefined else PROVEN[result.certificate.kind]
        if exact and result.name in IDEALISED:
            exact = "prediction"
        row: list[str | Text] = [result.name, value, exact, "kept" if result.kept else f"{result.seconds:.2f}"]
        self.rows.add(row + ([result.definition, Text(result.source, "dim")] if self.has_definitions else []))


def _print_notes(report: "Report") -> None:
    """Print what the rows do not say: errors, ties, reasons."""
    from rich.markup import escape

    reasons: dict[str, list[str]] = {}
    for result in report.results.values():
        if note := result.undefined or result.certificate.note:
            reasons.setdefault(note.removeprefix(result.name).lstrip(": ").removeprefix("is "), []).append(result.name)
    remarks = []
    error = report.conventions.get("error_bound")
    if error is not None and math.isfinite(error):
        remarks.append(f"values are within {error:.2g} of the optimal ones (proven)")
    remarks += [*_ties(report), *(f"compiling: {how_long}" for _, how_long in compiling_fact())]
    remarks += [f"{', '.join(names)}: {reason}" for reason, names in reasons.items()]
    if not {*IDEALISED}.isdisjoint(report.results):
        remarks.append(
            "prediction: regret of an idealised learner, 0 is optimal, 1 is uniform play; kernel_regret has "
            "expectations in the place of draws. `pharos predict` has the form that agrees best "
            "with runs, and an interval"
        )
    screen = console()
    for text in remarks:
        screen.print(escape(text), style="dim", soft_wrap=True)


def _ties(report: "Report") -> list[str]:
    """Number of gaps that count as ties, with the tolerance, as a note. None without a measure of gaps."""
    for result in report.results.values():
        details = {} if result.undefined else result.certificate.details
        if "ties" in details:
            ties, tolerance = details["ties"], details["tie_tolerance"]
            num_proven = ties - details["unresolved_ties"]
            return [f"{pluralize(ties, 'tie')} at a tolerance of {tolerance:.2g}, {num_proven:,} proven"]
    return []


# Predict --------------------------------------------------------------------------------------------------------------


PREDICTED = TrainingOptions(agent="dqn", steps=30_000)
PREDICTED_OPTIONS = "agent steps hyperparameters sticky random lazy reward_noise scale_rewards"


def predict(
    target: Target,
    *,
    observation: Annotated[list[str] | None, "NAME[,OPTION=VALUE...]"] = None,
    network: list[str] | None = None,
    training: Annotated[TrainingOptions, PREDICTED_OPTIONS] = PREDICTED,
    preset: Annotated[str | None, typer.Option("--hyperparameters", metavar="common")] = None,
    pilot: float | None = None,
    horizon: Count | None = None,
    landmarks: Annotated[int | None, typer.Option(min=0)] = None,
    plot: Annotated[Path | None, file_ending(".png", ".pdf", ".svg")] = None,
) -> Answer:
    """Predict the regret of an agent behind each observation, before anything is trained.

    Args:
        observation: Observation, as in `pharos train`: hash,bits=64. Repeatable. Default: vector.
        network: mlp64, mlp256x3, cnn16, ..., or your own file.py:function. Repeatable. Default: the agent's network.
        agent: dqn or ppo.
        steps: Training steps to predict for.
        pilot: Also train one seed for this share of the steps: 0.1, 0.25 or 0.5. Predictions then use both.
        preset: Use the hyperparameters of the published cells, for which the interval is calibrated. --set overrides
            them.
        horizon: Steps of an episode. Default: the environment's time limit.
        landmarks: Landmarks of the kernel approximation, for the predictors of before. Default: only above 4,096
            observations.
        plot: Draw the bars into a PNG, PDF or SVG file.
    """
    env = target.found_environment()
    from pharos.prediction import predict as predict_regret

    if preset not in (None, "common"):
        raise UnknownName("set of hyperparameters", str(preset), ("common",))
    with progress_line("predicting") as report:
        prediction = predict_regret(
            env,
            [_observation(text) for text in observation or ["vector"]],
            networks=network or None,
            landmarks=landmarks,
            common=preset is not None,
            pilot=pilot,
            progress=report,
            **{name: getattr(training, name) for name in ("agent", "steps", "hyperparameters", "chance")},
            horizon=horizon or "limit",
        )
    if plot is not None:
        from pharos import plots

        plots.save(plots.predictions(prediction), plot)
    answer = {**prediction.to_dict(), "plot": plot, "compiling_seconds": compiling.seconds()}
    return Answer(answer, lambda: _print_prediction(target.title, prediction, plot))


def _observation(text: str) -> tuple[str, dict[str, Any]]:
    """NAME,OPTION=VALUE,...: the name and the options."""
    name, *options = text.split(",")
    if not name or not all("=" in option for option in options):
        raise ParameterError(f"--observation is {text!r}; expected NAME or NAME,OPTION=VALUE, such as hash,bits=64")
    return name, parse_parameters(options)


def _print_prediction(title: str, prediction: "Prediction", plot: Path | None) -> None:
    facts = [*compiling_fact(), *([("plot", plot)] if plot else [])]
    print_table(
        f"{title}, {prediction.chance}: {prediction.states:,} states, "
        f"{prediction.agent.upper()} after {prediction.steps:,} steps",
        ("observation", "network", ">predicted regret", ">80 % interval", ">held", ">with a table"),
        (
            (
                cell.observation,
                cell.network,
                f"{cell.value:.2f}",
                f"{cell.low:.2f} to {cell.high:.2f}",
                f"{cell.local_coverage:.2f} of {cell.local_cells}" if cell.local_cells else "-",
                f"{cell.tabular:.2f}",
            )
            for cell in prediction.cells
        ),
        notes=[
            *map(str, prediction.orders),
            f"0 is optimal, 1 is uniform play. By {prediction.predictor}; of {prediction.published_cells} published "
            f"cells of {prediction.published_classes} classes, such an interval held "
            f"{100 * prediction.coverage:.0f} % where the class was left out. Held: the same of "
            "cells predicted about as much (up to 0.1, 0.2, 0.4, 0.8, or more).",
            *(f"{name}: {value}" for name, value in facts),
        ],
    )
    for warning in prediction.warnings:
        complain(f"warning: {warning}")
