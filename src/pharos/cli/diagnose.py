"""pharos diagnose: what is wrong with an agent, shown by numbers that only an exactly known world has."""

import contextlib
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pharos.cli.answers import Answer, print_table, progress_bar
from pharos.cli.options import Count
from pharos.errors import ParameterError
from pharos.system import storage
from pharos.system.wording import pluralize

if TYPE_CHECKING:
    from pharos.benchmark import Diagnosis

HTML = (".html", ".htm")


def diagnose(
    agent: Annotated[str | None, typer.Argument(metavar="AGENT", help="file.py:learn, module:Class, dqn, ...")] = None,
    *,
    results: Annotated[str | None, "DIR"] = None,
    hyperparameters: Mapping[str, Any] | None = None,
    seeds: Count = 2,
    steps: Count = 4000,
    timeout: float | None = None,
    out: Annotated[Path | None, "FILE.md|FILE.html"] = None,
) -> Answer:
    """Train an agent on twelve small worlds, and say what is wrong with it, by which number, what to try.

    Args:
        results: Read the folder of a finished `benchmark run` in place of an agent. Nothing is trained.
        hyperparameters: Set a hyperparameter of the agent.
        seeds: Number of seeds of each world, from 0 on.
        steps: Training steps of each run. The table of known faults has 4,000.
        timeout: End the command if a run takes more than this many seconds.
        out: Write the page to FILE.md or FILE.html, which loads nothing.
    """
    from pharos import benchmark

    if (agent is None) == (results is None):
        raise ParameterError("diagnose: expected an AGENT such as mine.py:learn, or --results DIR, one of both")
    began = time.perf_counter()
    # the page is opened first: one that cannot be written is refused before anything is trained
    with contextlib.nullcontext() if out is None else storage.replacing(out, follow=True) as page:
        with progress_bar("worlds", 1000, "building worlds") as show:
            diagnosis = benchmark.diagnose(
                agent,
                results=results,
                hyperparameters=hyperparameters,
                seeds=range(seeds),
                steps=steps,
                timeout=timeout,
                progress=lambda done, text: show(int(1000 * done), text),
            )
        if out is not None and page is not None:
            page.write((diagnosis.to_html() if out.suffix in HTML else str(diagnosis)).encode(errors="replace"))
    answer = {**diagnosis.to_dict(), "seconds": time.perf_counter() - began, "file": out}
    return Answer(answer, lambda: _print(diagnosis))


def _print(diagnosis: "Diagnosis") -> None:
    title, rows = f"{diagnosis.agent}: {diagnosis.verdict}", enumerate(diagnosis.findings, start=1)
    if diagnosis.findings:
        columns = "", "what no healthy agent shows", "what to try"
        print_table(title, columns, ((str(number), each.wrong, each.advice) for number, each in rows))
    else:
        print(title)
    if not diagnosis.likeness:
        tasks = pluralize(len(diagnosis.scores), "task")
        print(f"Mean score on {tasks}, 1 optimal and 0 as uniform play: {diagnosis.score:.2f}")
        return
    scores = ", ".join(f"{name} {score:.2f}" for name, score in diagnosis.scores.items())
    print_table(
        "Nearest known agents",
        ("", ">likeness", ""),
        ((name, f"{share:.2f}", words) for name, share, words in diagnosis.nearest()),
        notes=[diagnosis.how_often, f"Scores, 1 optimal and 0 as uniform play: {scores}"],
    )
