"""pharos train: an agent learns, and its policy's exact regret is measured as it does."""

import math
import time
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pharos.cli.answers import compiling_fact, complain, describe_chance, print_facts, print_json, progress_bar
from pharos.cli.options import Json, Lazy, Parameters, Random, Sticky, TargetArgument, parse_parameters, parse_seeds
from pharos.cli.target import parse_environment
from pharos.errors import AllRunsFailed, ParameterError
from pharos.system import compiling
from pharos.system.wording import in_words, many

if TYPE_CHECKING:
    from pharos.environments import Environment
    from pharos.training import TrainingResult


def train(
    target: TargetArgument,
    parameters: Parameters = None,
    agent: Annotated[
        str, typer.Option("--agent", help="q_learning, dqn, ppo, a2c, or module:Class for Stable-Baselines3.")
    ] = "q_learning",
    observation: Annotated[
        str,
        typer.Option(
            "--observation", help="vector, simple_image, complex_image, one_hot, index, hash, recorded, or your own."
        ),
    ] = "vector",
    option: Annotated[
        list[str] | None,
        typer.Option("--option", metavar="NAME=VALUE", help="Option of the observation, such as size=natural."),
    ] = None,
    steps: Annotated[int, typer.Option("--steps", min=1, help="Steps to learn from.")] = 50_000,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Decides everything random.")] = 0,
    seeds: Annotated[
        str | None,
        typer.Option("--seeds", metavar="A:B|S,...", help="A run for each, such as 0:64; --out has a folder for each."),
    ] = None,
    engine: Annotated[
        str, typer.Option("--engine", help="sb3 (Stable-Baselines3), or batched: many seeds as one program.")
    ] = "sb3",
    device: Annotated[str, typer.Option("--device", help="Of the batched engine: cpu or cuda.")] = "cpu",
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
    workers: Annotated[
        int | None,
        typer.Option("--workers", min=1, help="Processes for many seeds; as many as processors when not given."),
    ] = None,
    sticky: Sticky = 0.0,
    random: Random = 0.0,
    lazy: Lazy = 0.0,
    reward_noise: Annotated[
        float, typer.Option("--reward-noise", min=0, help="Standard deviation of noise in what is paid; 0 on average.")
    ] = 0.0,
    reward_delay: Annotated[
        int, typer.Option("--reward-delay", min=0, help="Steps by which rewards are paid late, the last at the end.")
    ] = 0,
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
    from pharos.training import train as learn

    hyperparameters = parse_parameters(hyperparameter)
    if table is not None:
        sight = agent_kind(agent).observation(observation)
        hyperparameters = hyperparameters_of(agent, env.name, sight, hyperparameters, table=table)

    setting: dict[str, Any] = {
        "steps": steps,
        "observation": observation,
        "observation_options": parse_parameters(option),
        "sticky": sticky,
        "random": random,
        "lazy": lazy,
        "reward_noise": reward_noise,
        "reward_delay": reward_delay,
        "gamma": gamma if gamma is not None else 0.99 if endless else 1.0,
        "horizon": None if endless else horizon or "default",
        "evaluation_interval": interval,
        "hyperparameters": hyperparameters,
        "engine": engine,
        "out": out,
    }
    if seeds is not None:
        if seed or tensorboard:
            raise ParameterError("--seeds goes with neither --seed nor --tensorboard; expected one of them")
        title = f"{agent} on {' '.join((target, *(parameters or ())))}"
        from pharos.system.workers import usable_workers

        together = {"seeds": parse_seeds(seeds), "device": device, "workers": usable_workers(workers)}
        _train_many(title, agent, env, {**setting, **together}, json)
        return
    with progress_bar("training", steps, "loading, building, compiling, first evaluation") as show:
        result = learn(agent, env, seed=seed, tensorboard=tensorboard, progress=_telling(show), **setting)
    picture = _plot(out)
    if json:
        print_json(
            {
                **result.result,
                "config": result.config,
                "seconds": result.seconds,
                "compiling_seconds": compiling.seconds(),
                "folder": out,
                "plot": picture,
            }
        )
        return
    facts = _facts(result, steps, describe_chance(sticky, random, env.has_chance, lazy, reward_noise, reward_delay))
    if out is not None:
        facts += [("results", out), *([("plot", picture)] if picture else [])]
    print_facts(f"{agent} on {' '.join((target, *(parameters or ())))}, {result.config['observation']}", facts)


def _train_many(title: str, agent: str, env: "Environment", setting: dict[str, Any], json: bool) -> None:
    """A run for each seed; what they have in common is told, and what went wrong."""
    from pharos.training import FailedRun, train_many

    seeds, steps, began = setting["seeds"], setting["steps"], time.perf_counter()
    with progress_bar("training", len(seeds) * steps, "loading, building, compiling, first evaluation") as show:
        try:
            ends = train_many(agent, env, progress=_telling_of_many(show), **setting)
        except AllRunsFailed as all_failed:  # the answer says of each why
            ends = all_failed.outcome
    seconds = time.perf_counter() - began
    failed = {seed: end.error for seed, end in zip(seeds, ends, strict=True) if isinstance(end, FailedRun)}
    results = {seed: end for seed, end in zip(seeds, ends, strict=True) if not isinstance(end, FailedRun)}
    spread = {
        name: _quartiles([run.result[name] for run in results.values()])
        for name in ("final_value", "final_regret", "normalized_regret", "mean_return")
    }
    if json:
        runs = [{"seed": seed, **run.result, "folder": run.folder} for seed, run in results.items()]
        answer = {"runs": runs, "failed": failed, "quartiles": spread, "seconds": seconds, "folder": setting["out"]}
        print_json(answer)
    else:
        print_facts(f"{title}, {many(len(seeds), 'seed')}", _facts_of_many(results, spread, steps, seconds, setting))
    for error, count in Counter(failed.values()).most_common():
        complain(f"{count} x {error}")
    if failed:
        raise typer.Exit(1)


def _quartiles(values: list[float | None]) -> list[float] | None:
    """Lower quartile, median, upper quartile; None where there is no number."""
    import numpy as np

    numbers = [value for value in values if value is not None and math.isfinite(value)]
    return [float(value) for value in np.quantile(numbers, (0.25, 0.5, 0.75))] if numbers else None


def _facts_of_many(
    results: Mapping[int, "TrainingResult"],
    spread: Mapping[str, list[float] | None],
    steps: int,
    seconds: float,
    setting: Mapping[str, Any],
) -> list[tuple[str, object]]:
    facts: list[tuple[str, object]] = []
    for name, quartiles in spread.items():
        low, middle, high = quartiles or (math.nan,) * 3
        facts.append((in_words(name), f"median {middle:.4g}, quartiles {low:.4g} to {high:.4g}"))
    if results:
        some = next(iter(results.values())).result
        best = sum(run.result["final_regret"] < 1e-6 for run in results.values())
        facts += [
            ("optimal at the end", f"{best} of {many(len(results), 'run')}"),
            ("values", f"optimal {some['value_optimal']:.6g}, uniform {some['value_uniform']:.6g}"),
        ]
    pace = len(results) * steps / seconds
    facts.append(("seconds", f"{seconds:.1f} ({pace:,.0f} agent-steps/s, evaluation and finished runs included)"))
    if setting["out"] is not None:
        facts.append(("results", f"{setting['out']}/seed-{setting['seeds'][0]} and so on"))
    return facts


def _telling_of_many(show: Callable[[int, str], None] | None) -> Callable[[Any], None] | None:
    """What `train_many` calls after each evaluation: the mean regret of the policies, and the pace."""
    if show is None:
        return None
    began: list[tuple[float, int]] = []

    def tell(now: Any) -> None:
        if not began:
            began.append((time.perf_counter(), now.done))
        passed, before = time.perf_counter() - began[0][0], began[0][1]
        pace = f", {(now.done - before) / passed:,.0f} agent-steps/s" if passed else ""
        regrets = [row["expected_regret"] for row in now.rows.values()]
        said = f"mean regret {sum(regrets) / len(regrets):.4g}" if regrets else "finished before"
        show(now.done, f"{said}{pace}{f', {now.failed} failed' if now.failed else ''}")

    return tell


def _facts(run: "TrainingResult", steps: int, chance: str) -> list[tuple[str, object]]:
    result, regret = run.result, run.result["normalized_regret"]
    best, uniform = result["value_optimal"], result["value_uniform"]
    learnt, played = result["cumulative_regret"], result["cumulative_realised_regret"]
    shown = "-" if regret is None or math.isnan(regret) else f"{regret:.4g}  (0: optimal, 1: uniform)"
    return [
        ("final value", f"{result['final_value']:.6g}  (optimal {best:.6g}, uniform {uniform:.6g})"),
        ("final regret", f"{result['final_regret']:.6g}"),
        ("cumulative regret", f"{learnt:.6g} of the learnt policies, {played:.6g} as played"),
        ("normalised regret", shown),
        ("mean return", f"{result['mean_return']:.6g} over {many(result['episodes'], 'episode')}"),
        ("values", "exact" if result["exact"] else "some are estimates, see exact in curve.parquet"),
        ("chance", chance),
        ("seconds", f"{run.seconds:.1f} ({steps / run.seconds:,.0f} steps/s, evaluation included)"),
        *compiling_fact(),
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
