"""pharos benchmark: agents on frozen tasks whose every state is known, and scores with units."""

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pharos.cli.answers import Answer, complain, console, counted_bar, print_table, progress_bar, termination
from pharos.cli.command import Commands
from pharos.cli.options import Count, Trust, file_ending, parse_seeds
from pharos.errors import AllRunsFailed, ParameterError
from pharos.system.wording import pluralize

if TYPE_CHECKING:
    from pharos.benchmark import BenchmarkTask, Comparison, Difference, Power, Suite

app = Commands(no_args_is_help=True, help="Run agents on a frozen suite of solved tasks, and compare them.")

SuiteName = Annotated[str, typer.Argument(metavar="[SUITE]", help="Name of a suite, or FILE.yaml.")]
SuiteFile = Annotated[str, typer.Option("--suite", metavar="NAME|FILE")]
CLAIMED = [
    "curves while learning",
    "core scores and intervals",
    "steps",
    "seeds",
    "settings",
    "that policies were learnt",
]
"""What a submission says and nobody can compute from it."""


@app.command("show")
def show(suite: SuiteName = "v1") -> Answer:
    """Show the tasks of a suite, what is predicted of them, and how long baselines take."""
    from pharos.benchmark import load_suite

    loaded = load_suite(suite, trust=True)  # nothing of it is made
    ladders: list[dict[str, Any]] = [
        {
            "axis": each.axis,
            "unit": each.unit,
            "quantity": each.quantity,
            "tasks": [_entry(task) for task in each.tasks],
        }
        for each in loaded.ladders
    ]
    answer: dict[str, Any] = {"name": loaded.name, "digest": loaded.digest, "protocol": vars(loaded.protocol)}
    answer |= {"core": [_entry(task) for task in loaded.core], "ladders": ladders, "minutes": _minutes(loaded)}
    return Answer(answer, lambda: _print(loaded))


@app.command("run")
def run(
    *,
    agent: str,
    out: Path,
    suite: Annotated[str, "NAME|FILE"] = "v1",
    hyperparameters: Mapping[str, Any] | None = None,
    seeds: Annotated[str, "N|A:B|S,..."] = "10",
    quick: bool = False,
    tasks: Annotated[list[str] | None, "core|AXIS|NAME"] = None,
    name: str | None = None,
    workers: Count | None = None,
    trust: Trust = False,
) -> Answer:
    """Run an agent on the tasks of a suite. The same command resumes; what is finished stays.

    Args:
        agent: A name (dqn, ppo, q_learning, a2c, oracle, random), module:Class or file.py:Class, or file.py:learn.
        out: Folder for the runs and their results, of one agent with one setting.
        suite: Which tasks.
        hyperparameters: A hyperparameter, of all tasks.
        seeds: How many, from 0 on; or which, such as 1000:1003.
        quick: The first three seeds of the core alone; results are preliminary.
        tasks: The core, an axis or a task, and no other; several times for more.
        name: Label in tables; the agent's own when not given.
        workers: Processes; as many as processors when not given.
    """
    from pharos import benchmark

    numbers = list(range(int(seeds))) if seeds.isdigit() else parse_seeds(seeds)
    loaded = benchmark.load_suite(suite, trust=trust)
    with progress_bar("runs", 1000, "checking tasks, loading, compiling") as show, termination():
        try:
            outcome = benchmark.run(
                agent,
                loaded,
                out=out,
                seeds=numbers,
                quick=quick,
                tasks=tasks,
                name=name,
                hyperparameters=hyperparameters,
                workers=workers,
                progress=lambda done, text: show(int(1000 * done), text),
            )
        except AllRunsFailed as all_failed:  # the answer says of each why
            outcome = all_failed.outcome
    results, missing = outcome.results, outcome.missing
    for reason, count in Counter(missing.values()).most_common():
        complain(f"{count} x {reason}")
    facts: list[tuple[str, object]] = [
        ("runs", f"{pluralize(len(results.seeds), 'seed')} of {pluralize(len(results.curves), 'task')}"),
        ("missing", "; ".join(missing) or "none"),
        ("regret", f"{results.mean():.4g} of uniform play, mean of all runs" if results.curves else "none"),
    ]
    if outcome.scores.has_core:
        facts += [("score of the core", f"{outcome.score}{', preliminary' if outcome.scores.preliminary else ''}")]
    facts += [(f"frontier of {axis}", f"{each.frontier} {each.unit}") for axis, each in outcome.axes.items()]
    facts.append(("results", out))
    answer = {
        "agent": results.agent,
        "suite": results.suite,
        "digest": results.digest,
        "seeds": results.seeds,
        "normalized_regret": {task: curve.mean() for task, curve in results.curves.items()},
        "failed": missing,
        "folder": out,
    }
    return Answer(answer, (f"{results.agent} on {results.suite}", facts), bool(missing))


@app.command("report")
def report(
    results: Annotated[str, "RESULTS"],
    *,
    out: Annotated[Path, file_ending(".html", ".htm")] = Path("report.html"),
    beside: str | None = None,
    latex: bool = False,
    predictor: str | None = None,
) -> Answer:
    """Write a page on an agent's results: frontiers in units, ladders, weaknesses, and residuals against theory.

    Args:
        results: Folder of a run, file, or name of a shipped baseline.
        out: FILE.html, which loads nothing.
        beside: Names of baselines or other results, with commas; dqn,ppo,q_learning when not given, as far as shipped.
        latex: A table and a paragraph on methods, too, in FILE.tex.
        predictor: Idealised learner to compare with: dqn, ppo, table, both or none; by the agent's name when not given.
    """
    from pharos import benchmark

    others = None if beside is None else [each for each in beside.split(",") if each]
    files = benchmark.report(results, out, beside=others, latex=latex, predictor=predictor)
    return Answer({"files": files}, lambda: console().print(*map(str, files), sep="\n", markup=False))


@app.command("submit")
def submit(
    results: Annotated[Path, "DIR"],
    *,
    out: Path | None = None,
    suite: SuiteFile = "v1",
    author: str = "",
    note: str = "",
    trust: Trust = False,
) -> Answer:
    """Pack curves and final policies of a run into one file; anybody can compute the policies' values again.

    Args:
        results: Folder of `benchmark run`.
        out: FILE.safetensors; AGENT.safetensors when not given.
        suite: That it is of.
        author: Who submits it.
        note: Shown beside it.
    """
    from pharos import benchmark

    file = out or Path(f"{results.name}.safetensors")
    loaded = benchmark.load_suite(suite, trust=trust)
    texts = {"author": author, "note": note}
    with counted_bar("policies") as tell:
        submission = benchmark.submit(results, file, loaded, **texts, trust=trust, progress=tell)
    runs, policies = sum(map(len, submission.results.curves.values())), len(submission.policies)
    facts = [("runs", f"{runs:,}"), ("policies", f"{policies:,}")]
    return Answer({"file": file, "runs": runs, "policies": policies}, (str(file), facts))


@app.command("verify")
def verify(file: Annotated[Path, "FILE"], *, suite: SuiteFile = "v1", trust: Trust = False) -> Answer:
    """Solve the tasks of a submission and evaluate its final policies again; exit code 1 where one is not as claimed.

    Args:
        file: That `benchmark submit` wrote.
        suite: That it is of.
    """
    from pharos import benchmark

    loaded = benchmark.load_suite(suite, trust=trust)
    with counted_bar("verifying") as tell:
        verdict = benchmark.verify(file, loaded, progress=tell)
    wrong = {each.name: {"claimed": each.claimed, "computed": each.found} for each in verdict.wrong}
    answer = {"holds": verdict.holds, "sha256": verdict.sha256, "verified": len(verdict.checks) - len(wrong)}
    answer |= {"wrong": wrong, "refused": verdict.refused, "missing": verdict.missing}
    answer |= {"final_score": verdict.final, "claimed": CLAIMED}
    facts = [
        (
            "policies",
            f"{len(verdict.checks) - len(wrong):,} as claimed, {len(wrong):,} not, {len(verdict.missing):,} missing",
        ),
        *((name, f"regret {each['computed']:.6g}, claimed {each['claimed']:.6g}") for name, each in wrong.items()),
        *verdict.refused.items(),
        ("final score", f"{verdict.final:.3f}, computed; a run without a policy counts as 0"),
        ("claimed", ", ".join(CLAIMED)),
    ]
    title = f"{file}: {'final policies are as claimed' if verdict.holds else 'does not hold'}"
    return Answer(answer, (title, facts), not verdict.holds)


@app.command("board")
def board(
    files: Annotated[list[Path], "FILE..."],
    *,
    out: Path = Path("board.html"),
    suite: Annotated[list[str] | None, "NAME|FILE"] = None,
    title: str = "Benchmark",
    trust: Trust = False,
) -> Answer:
    """Verify submissions, and write a page that ranks them by their final policies; all else on it is claimed.

    Args:
        files: Submissions.
        out: FILE.html.
        suite: That they may be of; several times for more; v1 when not given.
        title: Of the page.
    """
    from pharos import benchmark

    suites = [benchmark.load_suite(each, trust=trust) for each in suite or ["v1"]]
    with counted_bar("verifying") as tell:
        page = benchmark.benchmark_board(files, out, suites, title=title, progress=tell)
    facts = [("verified", f"{len(page.verified):,}"), ("refused", f"{len(page.refused):,}"), *page.refused.items()]
    scores = {each.file.name: each.final for each in page.verified}
    answer = {"file": out, "verified": len(page.verified), "refused": page.refused}
    return Answer({**answer, "final_scores": scores, "claimed": CLAIMED}, (str(out), facts))


def _entry(task: "BenchmarkTask") -> dict[str, Any]:
    return {name: value for name, value in vars(task).items() if name != "axis"}


def _minutes(suite: "Suite") -> dict[str, float]:
    """Minutes of one processor for all seeds of all tasks, by baseline; a task without a time counts as the mean."""
    times: dict[str, list[float]] = {}
    for task in suite.tasks:
        for agent, seconds in task.seconds.items():
            times.setdefault(agent, []).append(seconds)
    runs = len(suite.tasks) * suite.protocol.seeds
    return {agent: runs * sum(each) / len(each) / 60 for agent, each in times.items()}


def _print(suite: "Suite") -> None:
    rows, axis = [], ""
    for ladder in [None, *suite.ladders]:
        for task in suite.core if ladder is None else ladder.tasks:
            level = "" if task.level is None or ladder is None else f"{task.level:.3g} {ladder.unit}"
            numbers = (task.predicted.get(name) for name in ("dqn", "ppo", "table"))
            cells = ("" if value is None else f"{value:.2f}" for value in numbers)
            rows.append(("" if task.axis == axis else task.axis, task.name, level, *cells))
            axis = task.axis
    text = "Regret as predicted before any run: 0 is optimal, 1 is uniform play."
    if minutes := _minutes(suite):
        times = ", ".join(f"{agent.upper()} {value:.0f}" for agent, value in minutes.items())
        text += f" Minutes of one processor, all seeds, as shipped: {times}"
    protocol = suite.protocol
    setting = (
        f"{protocol.steps:,} steps a task, {pluralize(protocol.evaluations, 'evaluation')}, "
        f"{pluralize(protocol.seeds, 'seed')}, gamma {protocol.gamma:g}, horizon {protocol.horizon}"
    )
    title = f"{suite.name}, {pluralize(len(suite.tasks), 'task')}: {suite.digest}"
    columns = ("axis", "task", "level", ">DQN", ">PPO", ">table")
    print_table(title, columns, rows, before=[setting, ""], notes=[text])


SuiteOption = Annotated[str | None, typer.Option(metavar="NAME|FILE.yaml", help="The results' own when not given.")]


@app.command("compare")
def compare(results: Annotated[list[str], "A B..."], *, suite: SuiteOption = None, tasks: bool = False) -> Answer:
    """Compare an agent with others: per axis, per task and on the core, with 95 % intervals over seeds.

    Args:
        results: Folders of runs, files of results, or baselines by name; the first against each of the others.
        tasks: Print each task as well.
    """
    from pharos import benchmark

    if len(results) < 2:
        raise ParameterError(f"compare {' '.join(results)}; expected two results or more, such as results/mine dqn")
    comparisons = [benchmark.compare(results[0], other, suite=suite) for other in results[1:]]

    def text() -> None:
        for each in comparisons:
            _print_comparison(each, tasks)

    return Answer({"comparisons": comparisons}, text)


def _print_comparison(comparison: "Comparison", tasks: bool) -> None:
    rows: list[tuple[str, ...]] = []

    def add(name: str, each: "Difference") -> None:
        numbers = (f"{each.ours:.3f}", f"{each.theirs:.3f}", str(each.interval), f"{each.improvement.value:.2f}")
        p_value = (
            "< 0.0001" if each.adjusted < 1e-4 else "" if each.adjusted != each.adjusted else f"{each.adjusted:.2g}"
        )
        rows.append((name, *numbers, p_value, each.verdict))

    if comparison.core is not None:
        add("core", comparison.core)
    for axis, each in comparison.axes.items():
        add(axis, each.score)
        frontiers = [frontier.text(ends=False) for frontier in each.frontiers]
        rows.append((f"  frontier, {each.unit}", *frontiers, str(each.frontier)))
    for name, difference in comparison.tasks.items() if tasks else ():
        add(name, difference)
    notes = []
    if comparison.left_out:
        number = pluralize(len(comparison.left_out), "task")
        left_out = ", ".join(comparison.left_out[:3]) + (", ..." if len(comparison.left_out) > 3 else "")
        notes.append(f"without {number} that one of them has not run: {left_out}")
    if any(each.p_value != each.p_value for each in comparison.tasks.values()):
        notes.append("one seed has no interval; run two or more of both")
    names = (comparison.ours, comparison.theirs, "difference", "P(improvement)", "p (Holm)")
    columns = ("", *(f">{name}" for name in names), "verdict")
    print_table(f"{comparison.ours} against {comparison.theirs}", columns, rows, notes=notes)


@app.command("power")
def power(
    results: Annotated[str, "RESULTS"],
    *,
    suite: SuiteOption = None,
    difference: float | None = None,
) -> Answer:
    """Show how precise scores are, and which difference from an agent that varies as much would be found.

    Args:
        results: Folder of a run, file of results, or a baseline by name.
        difference: Of scores: how many seeds find it with power 0.8.
    """
    from pharos import benchmark

    agent = benchmark.read_results(results)
    scores = benchmark.power(agent, suite=suite, difference=difference)
    answer = {"agent": agent.agent, "seeds": len(agent.seeds), "scores": scores}
    return Answer(answer, lambda: _print_power(agent.agent, len(agent.seeds), scores, difference))


def _print_power(agent: str, seeds: int, scores: "dict[str, Power]", difference: float | None) -> None:
    rows = []
    for name, each in scores.items():
        numbers = [f"{each.standard_error:.4f}", *(f"{value:.3f}" for value in each.least_differences.values())]
        if difference is not None:
            numbers.append("more than 100,000" if each.seeds_needed is None else f"{each.seeds_needed:,}")
        rows.append((name, *numbers))
    least = [f">{number} seeds" for number in next(iter(scores.values())).least_differences]
    columns = ["score", ">standard error", *least, *([f">seeds for {difference:g}"] if difference is not None else [])]
    note = (
        "Under a number of seeds: the least difference between two agents of so many seeds each that is found "
        "with power 0.8 (Welch's t, 5 %)."
    )
    print_table(f"{agent}, {pluralize(seeds, 'seed')}", columns, rows, notes=[note])
