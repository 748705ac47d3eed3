"""pharos diagnose: what is wrong with an agent, shown by numbers that only an exactly known world has."""

import contextlib
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pharos.cli.answers import Answer, print_table, progress_bar
from pharos.cli.options import Count
from pharos.system import storage

if TYPE_CHECKING:
    from pharos.benchmark import Diagnosis


def diagnose(
    agent: Annotated[str, typer.Argument(metavar="AGENT", help="file.py:learn, module:Class, dqn, ppo, ...")],
    *,
    hyperparameters: Mapping[str, Any] | None = None,
    seeds: Count = 2,
    steps: Count = 4000,
    out: Annotated[Path | None, "FILE.md"] = None,
) -> Answer:
    """Train an agent on twelve small worlds, and say what is wrong with it, by which number, and what to try.

    Args:
        hyperparameters: Set a hyperparameter of the agent.
        seeds: Number of seeds of each world, from 0 on.
        steps: Training steps of each run; the table of known faults has 4,000.
        out: Write the page to this file, as Markdown.
    """
    from pharos import benchmark

    began = time.perf_counter()
    # the page is opened first: one that cannot be written is refused before anything is trained
    with contextlib.nullcontext() if out is None else storage.replacing(out, follow=True) as page:
        with progress_bar("worlds", 1000, "building worlds") as show:
            diagnosis = benchmark.diagnose(
                agent,
                hyperparameters=hyperparameters,
                seeds=range(seeds),
                steps=steps,
                tell=lambda done, text: show(int(1000 * done), text),
            )
        if page is not None:
            page.write(str(diagnosis).encode())
    answer = {**diagnosis.to_dict(), "seconds": time.perf_counter() - began, "file": out}
    return Answer(answer, lambda: _print(diagnosis))


def _print(diagnosis: "Diagnosis") -> None:
    scores = ", ".join(f"{name} {score:.2f}" for name, score in diagnosis.scores.items())
    print_table(
        f"{diagnosis.agent}: {diagnosis.verdict}",
        ("", "what no healthy agent shows", "what to try"),
        ((str(number), each.wrong, each.advice) for number, each in enumerate(diagnosis.findings, start=1)),
    )
    print_table(
        "Nearest known agents",
        ("", ">likeness", ""),
        ((name, f"{share:.2f}", text) for name, share, text in diagnosis.nearest()),
        notes=[diagnosis.how_often, f"Scores, 1 optimal and 0 as uniform play: {scores}"],
    )
