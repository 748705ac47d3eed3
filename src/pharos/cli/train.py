"""pharos train: an agent learns, and its policy's exact regret is measured as it does.

pharos tune: a search for hyperparameters.
"""

import math
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from pharos.cli.answers import Answer, compiling_fact, complain, note_facts, progress_bar
from pharos.cli.options import Count, Discount, Seed, Target, parse_seeds, parse_value
from pharos.errors import AllRunsFailed, ParameterError
from pharos.system import compiling
from pharos.system.wording import in_words, pluralize
from pharos.training import TrainingOptions

if TYPE_CHECKING:
    from pharos.training import TrainingProgress, TrainingResult


OPTIONS = "agent observation observation_options steps engine hyperparameters evaluation_interval"
CHANCE = "sticky random lazy reward_noise reward_delay scale_rewards"
UNIFORM_IS_OPTIMAL = "-  (uniform play is optimal as well: give a shorter --horizon, or a --gamma below 1)"
BEFORE = "loading, building, compiling, first evaluation"


def train(
    target: Target,
    *,
    training: Annotated[TrainingOptions, f"{OPTIONS} {CHANCE}"],
    seed: Seed = 0,
    seeds: Annotated[str | None, "A:B|S,..."] = None,
    device: str = "cpu",
    out: Path | None = None,
    table: Annotated[Path | None, typer.Option("--hyperparameters", metavar="FILE")] = None,
    workers: Count | None = None,
    gamma: Discount | None = None,
    horizon: Count | None = None,
    endless: Annotated[bool, typer.Option("--no-horizon")] = False,
    objective: Literal["total", "average"] | None = None,
    tensorboard: bool = False,
) -> Answer:
    """Train an agent and measure the exact regret of its policy on the way.

    Args:
        seed: Seed of everything random.
        seeds: Train a run for each of these seeds, such as 0:64. --out has a folder for each.
        device: Device of the batched engine: cpu or cuda.
        out: Write results to this folder. An unfinished run in it resumes.
        table: YAML file of hyperparameters, such as `pharos tune` writes.
        workers: Number of processes for many seeds. Default: as many as processors.
        gamma: Discount of values and returns. Default: 1, with a horizon.
        horizon: Steps of an episode. Default: the environment's time limit.
        endless: Use discounted values without a horizon, at --gamma (0.99).
        objective: total: gamma 1 and no horizon. average: also measure the reward of a step in the long run.
        tensorboard: Write TensorBoard logs into --out.
    """
    env = target.found_environment()
    from pharos.agents import agent_called
    from pharos.agents import hyperparameters as hyperparameters_of
    from pharos.training import train as learn

    if endless and horizon is not None:
        raise ParameterError(f"--no-horizon and --horizon {horizon} contradict each other; expected one of them")
    if seeds is None and device != "cpu":
        raise ParameterError(f"--device {device} goes with --seeds, as in --seeds {seed}: one run is of the processor")
    agent, hyperparameters = training.agent, training.hyperparameters
    if table is not None:
        sight = agent_called(agent).observation(training.observation)
        hyperparameters = hyperparameters_of(agent, env.name, sight, hyperparameters, table=table)
    training = replace(
        training,
        hyperparameters=hyperparameters,
        gamma=gamma if gamma is not None else 0.99 if endless and objective != "total" else 1.0,
        horizon=None if endless else horizon or "limit",
        objective=objective,
    )
    title = f"{agent} on {target.title}"
    if seeds is not None:
        if seed or tensorboard:
            raise ParameterError("--seeds goes with neither --seed nor --tensorboard; expected one of them")
        from pharos.system.workers import usable_workers

        options: dict[str, Any] = {"device": device, "workers": usable_workers(workers), **vars(training)}
        return _train_many(title, seeds=parse_seeds(seeds), environment=env, out=out, **options)
    with progress_bar("training", training.steps, BEFORE) as show:
        options = {**vars(training), "seed": seed, "out": out, "tensorboard": tensorboard}
        result = learn(environment=env, progress=_telling(show), **options)
    picture = _plot(out)
    answer = {
        **result.result,
        "config": result.config,
        "seconds": result.seconds,
        "compiling_seconds": compiling.seconds(),
        "folder": out,
        "plot": picture,
        "notes": result.notes,
    }
    facts = _facts(result, training.steps, training.chance.in_words(env.has_chance))
    facts += [("note", text) for text in result.notes.values()]
    if out is not None:
        facts += [("results", out), *([("plot", picture)] if picture else [])]
    return Answer(answer, (f"{title}, {result.config['observation']}", facts))


def _train_many(title: str, *, seeds: list[int], steps: int, out: Path | None, **setting: Any) -> Answer:
    """Train one run per seed. Answers with quartiles over the runs, and with errors of failed runs."""
    from pharos.training import FailedRun, train_many

    began = time.perf_counter()
    with progress_bar("training", len(seeds) * steps, BEFORE) as show:
        try:
            ends = train_many(seeds=seeds, steps=steps, out=out, progress=_telling_of_many(show), **setting)
        except AllRunsFailed as all_failed:  # the answer says of each why
            ends = all_failed.outcome
    seconds = time.perf_counter() - began
    failed = {seed: end.error for seed, end in zip(seeds, ends, strict=True) if isinstance(end, FailedRun)}
    results = {seed: end for seed, end in zip(seeds, ends, strict=True) if not isinstance(end, FailedRun)}
    spread = {
        name: _quartiles([run.result[name] for run in results.values()])
        for name in ("final_value", "final_regret", "normalized_regret", "mean_return")
    }
    runs = [{"seed": seed, **run.result, "folder": run.folder} for seed, run in results.items()]
    answer = {"runs": runs, "failed": failed, "quartiles": spread, "seconds": seconds, "folder": out}
    facts = _facts_of_many(results, spread, steps, seconds) if results else []
    notes: dict[str, dict[str, str]] = {}
    for number, run in results.items():
        for kind, text in run.notes.items():
            notes.setdefault(kind, {})[f"seed {number}"] = text
    answer["notes"] = notes
    facts += note_facts(notes)
    if out is not None:
        facts.append(("results", f"{out}/seed-{seeds[0]} and so on"))

    for error, count in Counter(failed.values()).most_common():
        complain(f"{count} x {error}")
    return Answer(answer, (f"{title}, {pluralize(len(seeds), 'seed')}", facts), bool(failed))


def _is_uniform_optimal(result: Mapping[str, Any]) -> bool:
    """Whether uniform play is as good as optimal to six digits, so that no regret says anything in its unit."""
    best, uniform = result["value_optimal"], result["value_uniform"]
    return best is not None and uniform is not None and math.isclose(best, uniform, rel_tol=1e-6)


def _quartiles(values: list[float | None]) -> list[float] | None:
    """Lower quartile, median, upper quartile. None if there is no number."""
    import numpy as np

    numbers = [value for value in values if value is not None and math.isfinite(value)]
    return [float(value) for value in np.quantile(numbers, (0.25, 0.5, 0.75))] if numbers else None


def _facts_of_many(
    results: Mapping[int, "TrainingResult"],
    spread: Mapping[str, list[float] | None],
    steps: int,
    seconds: float,
) -> list[tuple[str, object]]:
    facts: list[tuple[str, object]] = []
    for name, quartiles in spread.items():
        low, middle, high = quartiles or (math.nan,) * 3
        facts.append((in_words(name), f"median {middle:.4g}, quartiles {low:.4g} to {high:.4g}"))
    if any(_is_uniform_optimal(run.result) for run in results.values()):
        facts = [(name, UNIFORM_IS_OPTIMAL if name == "normalised regret" else value) for name, value in facts]
    if results:
        some = next(iter(results.values())).result
        best = sum(run.result["final_regret"] < 1e-6 for run in results.values())
        facts += [
            ("optimal at the end", f"{best} of {pluralize(len(results), 'run')}"),
            ("values", f"optimal {some['value_optimal']:.6g}, uniform {some['value_uniform']:.6g}"),
        ]
    pace = len(results) * steps / seconds
    facts.append(("seconds", f"{seconds:.1f} ({pace:,.0f} agent-steps/s, evaluation and finished runs included)"))
    return facts


def _telling_of_many(show: Callable[[int, str], None]) -> "Callable[[TrainingProgress], None]":
    """Return the callback of `train_many`, which shows the mean regret of the policies, and the pace."""
    began: list[tuple[float, int]] = []

    def report(now: "TrainingProgress") -> None:
        if not began:
            began.append((time.perf_counter(), now.done))
        elapsed, before = time.perf_counter() - began[0][0], began[0][1]
        pace = f", {(now.done - before) / elapsed:,.0f} agent-steps/s" if elapsed else ""
        regrets = [row["expected_regret"] for row in now.rows.values()]
        text = f"mean regret {sum(regrets) / len(regrets):.4g}" if regrets else "finished before"
        show(now.done, f"{text}{pace}{f', {now.failed} failed' if now.failed else ''}")

    return report


def _facts(run: "TrainingResult", steps: int, chance: str) -> list[tuple[str, object]]:
    result, regret = run.result, run.result["normalized_regret"]
    best, uniform = result["value_optimal"], result["value_uniform"]
    learnt, played = result["cumulative_regret"], result["cumulative_realised_regret"]
    shown = "-" if regret is None or math.isnan(regret) else f"{regret:.4g}  (0: optimal, 1: uniform)"
    shown = UNIFORM_IS_OPTIMAL if _is_uniform_optimal(result) else shown
    return [
        *_facts_of_averages(result),
        ("final value", f"{result['final_value']:.6g}  (optimal {best:.6g}, uniform {uniform:.6g})"),
        ("final regret", f"{result['final_regret']:.6g}"),
        ("cumulative regret", f"{learnt:.6g} of the learnt policies, {played:.6g} as played"),
        ("normalised regret", shown),
        ("mean return", f"{result['mean_return']:.6g} over {pluralize(result['episodes'], 'episode')}"),
        ("values", "exact" if result["exact"] else "some are estimates, see exact in curve.csv"),
        ("chance", chance),
        ("seconds", f"{run.seconds:.1f} ({steps / run.seconds:,.0f} steps/s, evaluation included)"),
        *compiling_fact(),
    ]


def _facts_of_averages(result: Mapping[str, Any]) -> list[tuple[str, object]]:
    """Average reward and regret a step in the long run, if the run measures them."""
    if "gain_at_start" not in result:
        return []
    from pharos.solvers import GainInterval

    names = ("gain_at_start", "optimal_gain_at_start", "uniform_gain_at_start", "average_regret")
    own, best, uniform, lost = (GainInterval(**result[name]) for name in names)
    relative = result["normalized_average_regret"]
    shown = (
        "-" if relative is None or math.isnan(relative) else f"{relative:.4g} over the run  (0: optimal, 1: uniform)"
    )
    return [
        ("final average reward", f"{own}  (optimal {best}, uniform {uniform})"),
        ("final average regret", f"{lost} a step"),
        ("normalised average regret", shown),
    ]


def _plot(out: Path | None) -> Path | None:
    """The regret curve beside the results, if matplotlib is installed."""
    if out is None:
        return None
    try:
        from pharos import plots

        return plots.save(plots.regret([out]), out / "regret.png", follow=False)
    except ImportError:
        return None


def _telling(show: Callable[[int, str], None]) -> Callable[[int, int, Any], None]:
    """Return the callback of `train`, which shows the value of the policy, beside the bar."""

    def report(done: int, _steps: int, row: Mapping[str, Any]) -> None:
        episodes = pluralize(row["episodes"], "episode")
        show(done, f"value {row['value']:.4g}, regret {row['expected_regret']:.4g}, {episodes}")

    return report


# Tune -----------------------------------------------------------------------------------------------------------------


TUNED = TrainingOptions(agent="dqn")


def tune(
    targets: Annotated[list[str], "TARGET..."],
    *,
    training: Annotated[TrainingOptions, "agent observation steps engine sticky random"] = TUNED,
    trials: Count = 50,
    seeds: Annotated[str, "A:B|S,..."] = "1000,1001",
    search: Annotated[list[str] | None, "NAME=CHOICES"] = None,
    search_seed: Seed = 0,
    out: Path | None = None,
    chance: Annotated[list[str] | None, "plain|NAME=P,..."] = None,
    shortlist_by_prediction: Count = 1,
) -> Answer:
    """Search hyperparameters of an agent for one class of environments.

    Args:
        targets: Instances of one class, such as frozen_lake/4x4 frozen_lake/8x8.
        trials: Number of trials, with earlier ones in --out.
        steps: Training steps of every run.
        seeds: Seeds of the runs of a trial. Do not use the seeds of your experiment.
        search: Search this instead of the agent's space: learning_rate=log,0.0001,0.01, gamma=linear,0.9,1,
            batch_size=32,64. Repeatable.
        search_seed: Seed of the search.
        engine: sb3, or batched: all runs of a trial that fit together as one program.
        out: Write the YAML file and the record to this folder. A search in it resumes.
        chance: Train under this kind of chance, on every instance: --chance plain --chance random=0.1 --chance
            sticky=0.25.
        shortlist_by_prediction: Proposals for each trial. Only the one with the least predicted regret is run. For dqn
            and ppo.
    """
    instances = [Target(target).found_environment() for target in targets]
    from pharos.training import tune as find

    kinds, predicted = _chances(chance), None
    if shortlist_by_prediction > 1:
        from pharos.prediction import regret_predictor

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
            **{name: getattr(training, name) for name in ("steps", "observation", "engine", "sticky", "random")},
            trials=trials,
            seeds=parse_seeds(seeds),
            chances=kinds,
            space=_space(search),
            search_seed=search_seed,
            shortlist=shortlist_by_prediction,
            predicted=predicted,
            out=out,
            progress=lambda done, _trials, best: show(done, f"best {best:.4g}"),
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
    """`["plain", "random=0.1"]` -> `[{}, {"random": 0.1}]`, or None if nothing is said."""
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
    """`["batch_size=32,64"]` -> `{"batch_size": ("one of", 32, 64)}`, or None if nothing is said."""
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
