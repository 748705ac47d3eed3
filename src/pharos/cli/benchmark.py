"""pharos benchmark: agents on frozen tasks whose every state is known, and scores with units."""

import time
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pharos.benchmark import Limits
from pharos.cli.answers import (
    Answer,
    complain,
    console,
    counted_bar,
    note_facts,
    print_facts,
    print_table,
    progress_bar,
    size_text,
    termination,
)
from pharos.cli.command import Commands
from pharos.cli.options import Count, Trust, file_ending, parse_seeds
from pharos.errors import AllRunsFailed, ParameterError
from pharos.system.wording import in_words, pluralize

if TYPE_CHECKING:
    from pharos.benchmark import (
        BenchmarkTask,
        Comparison,
        Difference,
        Entry,
        EntryVerdict,
        Power,
        SubmissionVerdict,
        Suite,
    )

app = Commands(no_args_is_help=True, help="Run agents on a frozen suite of solved tasks, and compare them.")

SuiteName = Annotated[str, typer.Argument(metavar="[SUITE]", help="Name of a suite, or FILE.yaml.")]
SuiteFile = Annotated[str | None, typer.Option("--suite", metavar="NAME|FILE", help="Suite of the runs. Default: v1.")]
CLAIMED = [
    "curves while learning",
    "core scores and intervals",
    "steps",
    "seeds",
    "settings",
    "that policies were learnt",
]
"""What a submission says and nobody can compute from it."""
COMPUTED = (
    *("value", "regret", "normalized_regret", "value_optimal", "value_uniform", "exact", "error_bound"),
    *("states", "episodes"),
)
"""Numbers of one task."""
LONG_MINUTES = 600  # minutes


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
    seeds: Annotated[str | None, "N|A:B|S,..."] = None,
    quick: bool = False,
    tasks: Annotated[list[str] | None, "core|AXIS|NAME"] = None,
    name: str | None = None,
    workers: Count | None = None,
    timeout: float | None = None,
    trust: Trust = False,
) -> Answer:
    """Run an agent on the tasks of a suite. The same command resumes, and what is finished stays.

    Args:
        agent: A name (dqn, ppo, q_learning, a2c, oracle, random), module:Class or file.py:Class, or file.py:learn.
        out: Write the runs and results of one agent with one setting into this folder.
        suite: Run the tasks of this suite.
        hyperparameters: Set a hyperparameter, for all tasks.
        seeds: Number of seeds, from 0 on, or a range, such as 1000:1003. Default: as many as the suite asks for.
        quick: Run a first look, of v1 the first three seeds of the core alone. Results are preliminary.
        tasks: Run only the core, an axis or a task. Repeatable.
        name: Label in tables. Default: the agent's name.
        workers: Number of processes. Default: as many as processors.
        timeout: End a run of your own code, or of Stable-Baselines3, after this many seconds, as failed.
    """
    from pharos import benchmark

    numbers = None if seeds is None else range(int(seeds)) if seeds.isdigit() else parse_seeds(seeds)
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
                timeout=timeout,
                progress=lambda done, text: show(int(1000 * done), text),
            )
        except AllRunsFailed as all_failed:  # the answer says of each why
            outcome = all_failed.outcome
    results, missing = outcome.results, outcome.missing
    for reason, count in Counter(missing.values()).most_common():
        complain(f"{count} x {reason}")
    facts: list[tuple[str, object]] = [
        ("runs", f"{pluralize(len(results.seeds), 'seed')} of {pluralize(len(results.curves), 'task')}"),
        ("steps used", f"{outcome.steps_used:,}"),
        ("missing", "; ".join(missing) or "none"),
        ("regret", f"{results.mean():.4g} of uniform play, mean of all runs" if results.curves else "none"),
    ]
    if outcome.scores.has_core:
        facts += [("score of the core", f"{outcome.score}{', preliminary' if outcome.scores.preliminary else ''}")]
    facts += [
        (f"frontier of {axis}", f"{each.frontier} {each.unit}")
        for axis, each in outcome.axes.items()
        if each.frontier.value == each.frontier.value  # one rung has none
    ]
    facts += [*note_facts(outcome.notes), ("results", out)]
    answer = {
        "agent": results.agent,
        "suite": results.suite,
        "digest": results.digest,
        "seeds": results.seeds,
        "normalized_regret": {task: curve.mean() for task, curve in results.curves.items()},
        "score": outcome.score.to_dict() if outcome.scores.has_core else None,
        "axes": {axis: each.to_dict() for axis, each in outcome.axes.items()},
        "tasks": [{"name": task, "score": each.to_dict()} for task, each in outcome.scores.tasks.items()],
        "steps_used": outcome.steps_used,
        "failed": missing,
        "notes": outcome.notes,
        "folder": out,
    }
    return Answer(answer, (f"{results.agent} on {results.suite}", facts), bool(missing))


@app.command("check")
def check(
    agent: Annotated[str, "AGENT"],
    *,
    hyperparameters: Mapping[str, Any] | None = None,
    workers: Count | None = None,
    timeout: float = 120.0,
) -> Answer:
    """Try an agent on two tiny tasks, and report each fault in one line. Exit code 1 if there is one.

    Args:
        agent: As for `benchmark run`, such as file.py:learn.
        hyperparameters: Set a hyperparameter, for both tasks.
        workers: Number of processes. Default: as many as processors.
        timeout: End a run after this many seconds, as failed.
    """
    from pharos import benchmark

    done = benchmark.check_agent(agent, hyperparameters=hyperparameters, workers=workers, timeout=timeout)
    return Answer(vars(done), str(done), not done)


SuiteOption = Annotated[
    str | None, typer.Option(metavar="NAME|FILE.yaml", help="Suite of the results. Default: theirs.")
]


@app.command("report")
def report(
    results: Annotated[str, "RESULTS"],
    *,
    out: Annotated[Path, file_ending(".html", ".htm")] = Path("report.html"),
    beside: str | None = None,
    latex: bool = False,
    predictor: str | None = None,
    suite: SuiteOption = None,
) -> Answer:
    """Write a page on an agent's results: frontiers in units, ladders, weaknesses, and residuals against theory.

    Args:
        results: Folder of a run, file, or name of a shipped baseline.
        out: Write the page to FILE.html, which loads nothing.
        beside: Baselines or other results to compare with, with commas. Default: dqn,ppo,q_learning, if shipped.
        latex: Also write a table and a paragraph on methods to FILE.tex.
        predictor: Idealised learner to compare with: dqn, ppo, table, both or none. Default: by the agent's name.
    """
    from pharos import benchmark

    others = None if beside is None else [each for each in beside.split(",") if each]
    files = benchmark.report(results, out, beside=others, latex=latex, predictor=predictor, suite=suite)
    return Answer({"files": files}, lambda: console().print(*map(str, files), sep="\n", markup=False))


@app.command("submit")
def submit(
    folder: Annotated[Path, "DIR"],
    *,
    out: Path | None = None,
    suite: SuiteFile = None,
    name: str = "",
    author: str = "",
    note: str = "",
    trust: Trust = False,
) -> Answer:
    """Pack what a run, or the runs of a suite, have learnt and claim into one file. Anybody can compute it again.

    Args:
        folder: Folder of one finished run, or of `benchmark run`.
        out: Write FILE.safetensors. Default: ID.safetensors for a run, DIR.safetensors for a suite.
        name: Label in tables. Default: the agent's name.
        author: Name of whoever submits it.
        note: Text to show beside it.
    """
    from pharos import benchmark

    texts = {"name": name, "author": author, "note": note}
    with counted_bar("policies") as report:
        file = benchmark.submit(folder, out, _loaded(suite, trust), **texts, trust=trust, progress=report)
    content, size = benchmark.read(file), file.stat().st_size
    if isinstance(content, benchmark.Entry):
        claim, more = content.claim, {"id": content.id, "claim": content.claim}
        runs = policies = 1
        kind = "exact" if claim.exact else f"estimated, ± {claim.error_bound:.2g}"
        facts = [
            ("entry", _title(content)),
            ("value", f"{claim.value:.8g} ({kind})"),
            ("regret", f"{claim.regret:.8g}"),
        ]
        if content.config.sources:
            facts.append(("code", "others verify it with --trust alone: it names code of your own"))
    else:
        runs, policies, more = sum(map(len, content.results.curves.values())), len(content.policies), {}
        facts = [("runs", f"{runs:,}"), ("policies", f"{policies:,}")]
    answer = {"file": file, "bytes": size, "runs": runs, "policies": policies, **more}
    return Answer(answer, (str(file), [*facts, ("size", size_text(size))]))


@app.command("verify")
def verify(
    files: Annotated[list[Path], "FILE..."],
    *,
    suite: SuiteFile = None,
    limits: Limits,
    trust: Trust = False,
) -> Answer:
    """Solve the tasks of submissions and evaluate their policies again. Exit code 1 if one is not as claimed.

    Args:
        files: Files from `benchmark submit`.
    """
    from pharos import benchmark

    loaded, verdicts, answers = _loaded(suite, trust), [], []
    for file in files:
        began = time.perf_counter()
        try:
            with counted_bar(f"verifying {file}") as report:
                verdict = benchmark.verify(file, loaded, trust=trust, progress=report, **vars(limits))
        except Exception as error:
            if len(files) == 1:
                raise
            reason = benchmark.reason(error)
            complain(reason if str(file) in reason else f"{file}: {reason}")
            answers.append({"file": file, "holds": False, "error": reason})
            continue
        verdicts.append(verdict)
        answers.append({**_answer(verdict), "seconds": time.perf_counter() - began, "limits": limits.to_dict()})

    def text() -> None:
        for verdict in verdicts:
            if isinstance(verdict, benchmark.EntryVerdict):
                _print_entry(verdict)
            else:
                _print_submission(verdict)

    holds = all(each["holds"] for each in answers)
    return Answer(answers[0] if len(files) == 1 else {"entries": answers, "holds": holds}, text, not holds)


def _answer(verdict: "EntryVerdict | SubmissionVerdict") -> dict[str, Any]:
    wrong = {each.name: {"claimed": each.claimed, "computed": each.found} for each in verdict.wrong}
    answer = {"file": verdict.file, "holds": verdict.holds, "sha256": verdict.sha256}
    answer |= {"verified": len(verdict.checks) - len(wrong), "wrong": wrong, "refused": verdict.refused}
    answer |= {"missing": verdict.missing, "final_score": verdict.final, "claimed": CLAIMED}
    if (entry := getattr(verdict, "entry", None)) is not None:
        checks = {
            each.name: {"claimed": each.claimed, "found": each.found, "within": each.within, "holds": each.holds}
            for each in verdict.checks
        }
        answer |= {"id": entry.id, "checks": checks} | {name: getattr(verdict, name) for name in COMPUTED}
    return answer


def _title(entry: "Entry") -> str:
    return f"{entry.name}: {entry.config.agent} on {entry.config.environment}, {entry.config.steps:,} steps"


def _print_entry(verdict: "EntryVerdict") -> None:
    if verdict.exact:
        how = f"exact: evaluated in {pluralize(verdict.states, 'state')}, error at most {verdict.error_bound:.1e}"
    else:
        how = (
            f"estimated from {verdict.episodes:,} episodes: {verdict.value:.6g} ± {verdict.error_bound:.2g} (99 %); "
            f"the policy reaches more than {verdict.states:,} states (--max-reached)"
        )
    print_table(
        f"{verdict.file}  {_title(verdict.entry)}",
        ("", ">claimed", ">computed", ">may differ by", ""),
        (
            (
                in_words(each.name),
                *(f"{number:.8g}" for number in (each.claimed, each.found)),
                f"{each.within:.1e}",
                "holds" if each.holds else "FAILS",
            )
            for each in verdict.checks
        ),
        notes=[how, *verdict.refused.values()],
    )
    print("the claim holds" if verdict.holds else "the claim does not hold")


def _print_submission(verdict: "SubmissionVerdict") -> None:
    wrong = verdict.wrong
    verified = f"{len(verdict.checks) - len(wrong):,} as claimed, {len(wrong):,} not, {len(verdict.missing):,} missing"
    facts = [
        ("policies", verified),
        *((each.name, f"regret {each.found:.6g}, claimed {each.claimed:.6g}") for each in wrong),
        *verdict.refused.items(),
        ("final score", f"{verdict.final:.3f}, computed; a run without a policy counts as 0"),
        ("claimed", ", ".join(CLAIMED)),
    ]
    print_facts(f"{verdict.file}: {'final policies are as claimed' if verdict.holds else 'does not hold'}", facts)


@app.command("board")
def board(
    files: Annotated[list[Path], "FILE|DIR..."],
    *,
    out: Annotated[Path, file_ending(".html", ".htm")] = Path("board.html"),
    suite: Annotated[list[str] | None, "NAME|FILE"] = None,
    title: str = "Benchmark",
    limits: Limits,
    trust: Trust = False,
) -> Answer:
    """Verify submissions, and write a page that ranks them by what was computed. All else on it is claimed.

    Args:
        files: Submissions, and folders with submissions in them or below.
        out: Write the page to FILE.html.
        suite: Accept submissions of this suite. Repeatable. Default: v1.
        title: Title of the page.
    """
    from pharos import benchmark

    suites = [benchmark.load_suite(each, trust=trust) for each in suite or ()]
    with counted_bar("verifying") as report:
        page = benchmark.board(files, out, suites, title=title, trust=trust, progress=report, **vars(limits))
    verified = len(page.verified)
    facts = [("verified", f"{verified:,}"), ("refused", f"{len(page.refused):,}"), *page.refused.items()]
    answer = {"file": out, "verified": verified, "refused": page.refused, "final_scores": page.final_scores}
    return Answer({**answer, "claimed": CLAIMED}, (str(out), facts))


def _loaded(suite: str | None, trust: bool) -> "Suite | None":
    from pharos.benchmark import load_suite

    return None if suite is None else load_suite(suite, trust=trust)


def _entry(task: "BenchmarkTask") -> dict[str, Any]:
    return {name: value for name, value in vars(task).items() if name != "axis"}


def _minutes(suite: "Suite") -> dict[str, float]:
    """Minutes of one processor for all seeds of all tasks, by baseline. A task without a time counts as the mean."""
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
            level = f"{task.stored['states']:,} states" if task.stored else level
            numbers = (task.predicted.get(name) for name in ("dqn", "ppo", "table"))
            cells = ("" if value is None else f"{value:.2f}" for value in numbers)
            rows.append(("" if task.axis == axis else task.axis, task.name, level, *cells))
            axis = task.axis
    notes = []
    if any(task.predicted for task in suite.tasks):
        notes.append("Regret as predicted before any run: 0 is optimal, 1 is uniform play.")
    if minutes := _minutes(suite):
        unit, size = ("Hours", 60) if max(minutes.values()) > LONG_MINUTES else ("Minutes", 1)
        times = ", ".join(f"{agent.upper()} {value / size:.0f}" for agent, value in minutes.items())
        notes.append(f"{unit} of one processor, all seeds, as shipped: {times}")
    protocol = suite.protocol
    setting = (
        f"{protocol.steps:,} steps a task, {pluralize(protocol.evaluations, 'evaluation')}, "
        f"{pluralize(protocol.seeds, 'seed')}, gamma {protocol.gamma:g}, horizon {protocol.horizon}"
    )
    title = f"{suite.name}, {pluralize(len(suite.tasks), 'task')}: {suite.digest}"
    columns = ("axis", "task", "level", ">DQN", ">PPO", ">table")
    print_table(title, columns, rows, before=[setting, ""], notes=[" ".join(notes)])


@app.command("compare")
def compare(results: Annotated[list[str], "A B..."], *, suite: SuiteOption = None, tasks: bool = False) -> Answer:
    """Compare an agent with others: per axis, per task and on the core, with 95 % intervals over seeds.

    Args:
        results: Folders of runs, files of results, or baselines by name. The first is compared with each of the others.
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
    verdicts = {each.verdict for each in comparison.tasks.values()}
    if "equal seeds" in verdicts:
        notes.append("the seeds of one of them are one run: no interval, no verdict; does `learn` use its seed?")
    if "one seed" in verdicts:
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
    """Show the standard error of scores, and the smallest difference that is detected with 80 % power.

    Args:
        results: Folder of a run, file of results, or a baseline by name.
        difference: Also show how many seeds detect this difference of scores with 80 % power.
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
