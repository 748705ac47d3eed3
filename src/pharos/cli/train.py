"""pharos train: an agent learns, and its policy's exact regret is measured as it does."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pharos.cli.common import (
    Json,
    Parameters,
    Random,
    Sticky,
    TargetArgument,
    describe_chance,
    parse_environment,
    parse_parameters,
    print_facts,
    print_json,
    progress_bar,
)
from pharos.wording import many

if TYPE_CHECKING:
    from pharos.experiments import TrainingResult


def train(
    target: TargetArgument,
    parameters: Parameters = None,
    agent: Annotated[
        str, typer.Option("--agent", help="q_learning, dqn, ppo, a2c, or module:Class for Stable-Baselines3.")
    ] = "q_learning",
    observation: Annotated[
        str,
        typer.Option(
            "--observation", help="vector, simple_image, complex_image, one_hot, index, recorded, or your own."
        ),
    ] = "vector",
    option: Annotated[
        list[str] | None,
        typer.Option("--option", metavar="NAME=VALUE", help="Option of the observation, such as size=natural."),
    ] = None,
    steps: Annotated[int, typer.Option("--steps", min=1, help="Steps to learn from.")] = 50_000,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Decides everything random.")] = 0,
    out: Annotated[
        Path | None, typer.Option("--out", help="Folder for results; an unfinished run there is resumed.")
    ] = None,
    hyperparameter: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="Hyperparameter of the agent, such as learning_rate=0.001."),
    ] = None,
    table: Annotated[
        Path | None,
        typer.Option(
            "--hyperparameters", metavar="FILE", help="YAML of hyperparameters, such as `pharos tune` writes."
        ),
    ] = None,
    interval: Annotated[
        int | None, typer.Option("--interval", min=1, help="Steps between evaluations; a hundredth when not given.")
    ] = None,
    sticky: Sticky = 0.0,
    random: Random = 0.0,
    gamma: Annotated[
        float | None,
        typer.Option("--gamma", min=0, max=1, help="Discount of values and returns; 1 when not given, with a horizon."),
    ] = None,
    horizon: Annotated[
        int | None,
        typer.Option("--horizon", min=1, help="Steps of an episode; the environment's time limit when not given."),
    ] = None,
    endless: Annotated[
        bool, typer.Option("--no-horizon", help="Discounted values without a horizon, at --gamma (0.99).")
    ] = False,
    tensorboard: Annotated[bool, typer.Option("--tensorboard", help="Write TensorBoard logs into --out.")] = False,
    json: Json = False,
) -> None:
    """Train an agent and measure the exact regret of its policy on the way."""
    env = parse_environment(target, parameters)
    from pharos.agents import agent_kind
    from pharos.agents import hyperparameters as hyperparameters_of
    from pharos.experiments import train as learn

    given = parse_parameters(hyperparameter)
    if table is not None:
        seen = agent_kind(agent).observation(observation)
        given = hyperparameters_of(agent, env.name, seen, given, table=table)

    with progress_bar("training", steps, "loading, building, compiling, first evaluation") as show:
        result = learn(
            agent,
            env,
            steps=steps,
            observation=observation,
            observation_options=parse_parameters(option),
            sticky=sticky,
            random=random,
            gamma=gamma if gamma is not None else 0.99 if endless else 1.0,
            horizon=None if endless else horizon or "default",
            seed=seed,
            evaluation_interval=interval,
            hyperparameters=given,
            out=out,
            tensorboard=tensorboard,
            progress=_telling(show),
        )
    picture = _plot(out)
    if json:
        print_json(
            {**result.result, "config": result.config, "seconds": result.seconds, "folder": out, "plot": picture}
        )
        return
    facts = _facts(result, steps, describe_chance(sticky, random, env.has_chance))
    if out is not None:
        facts += [("results", out), *([("plot", picture)] if picture else [])]
    print_facts(f"{agent} on {' '.join((target, *(parameters or ())))}, {result.config['observation']}", facts)


def _facts(run: "TrainingResult", steps: int, chance: str) -> list[tuple[str, object]]:
    result, regret = run.result, run.result["normalized_regret"]
    best, uniform = result["value_optimal"], result["value_uniform"]
    learnt, played = result["cumulative_regret"], result["cumulative_realised_regret"]
    shown = "-" if regret is None or math.isnan(regret) else f"{regret:.4g}  (0: optimal, 1: uniform)"
    return [
        ("final value", f"{result['final_value']:.6g}  (optimal {best:.6g}, uniform {uniform:.6g})"),
        ("final regret", f"{result['final_regret']:.6g}"),
        ("cumulative regret", f"{learnt:.6g} of the learnt policies, {played:.6g} as played"),
        ("normalized regret", shown),
        ("mean return", f"{result['mean_return']:.6g} over {many(result['episodes'], 'episode')}"),
        ("values", "exact" if result["exact"] else "some are estimates, see exact in curve.parquet"),
        ("chance", chance),
        ("seconds", f"{run.seconds:.1f} ({steps / run.seconds:,.0f} steps/s, evaluation included)"),
    ]


def _plot(out: Path | None) -> Path | None:
    """The regret curve beside the results, where matplotlib is installed."""
    if out is None:
        return None
    try:
        from pharos import plots

        return plots.save(plots.regret([out]), out / "regret.png")
    except ImportError:
        return None


def _telling(show: Callable[[int, str], None] | None) -> Callable[[int, int, Any], None] | None:
    """What `train` calls after each evaluation: the value of the policy, beside the bar."""
    if show is None:
        return None

    def tell(done: int, _steps: int, row: Any) -> None:
        show(done, f"value {row['value']:.4g}, regret {row['expected_regret']:.4g}, {many(row['episodes'], 'episode')}")

    return tell
