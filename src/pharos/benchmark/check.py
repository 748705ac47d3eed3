"""Check of an agent on two tiny tasks, before hours of runs: `check_agent`."""

import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pharos.benchmark.execution import Outcome, run
from pharos.benchmark.suite import BenchmarkTask, Protocol, Suite, digest_of_suite, frozen
from pharos.errors import AllRunsFailed, ParameterError
from pharos.system.workers import check_timeout

CHECK_PROTOCOL = Protocol(steps=6000, evaluations=3, seeds=2)
TASKS = (
    BenchmarkTask("vectors", "frozen_lake", {"size": 4}, "vector", chance={"random": 0.1}),
    BenchmarkTask("images", "deep_sea", {"size": 4, "mapping_seed": 1}, "simple_image"),
)
SECONDS = 120.0


@dataclass(frozen=True)
class AgentCheck:
    """Result of `check_agent`.

    Attributes:
        agent: that was checked.
        errors: one sentence for each failure: task and seed, what was raised and in which line, what was expected.
        notes: one sentence each, on what looks like a mistake and is no error.
        scores: task -> score of the runs, 0 for random play and 1 for the optimal policy.
    """

    agent: str
    errors: tuple[str, ...]
    notes: tuple[str, ...]
    scores: Mapping[str, float]

    def __bool__(self) -> bool:
        """Whether there was no error."""
        return not self.errors

    def __str__(self) -> str:
        scores = ", ".join(f"{task} {score:.2f}" for task, score in self.scores.items())
        first = f"{self.agent}: {'keeps the contract' if self else 'breaks the contract'}"
        lines = [f"{first}; scores {scores}" if scores else first]
        lines += [*(f"  error: {text}" for text in self.errors), *(f"  note: {text}" for text in self.notes)]
        return "\n".join(lines)


def check_agent(
    agent: str | Callable[..., Any],
    *,
    hyperparameters: Mapping[str, Any] | None = None,
    timeout: float = SECONDS,
    workers: int | None = None,
) -> AgentCheck:
    """Try an agent on two tiny tasks, one of vectors and one of images, and say what is wrong in one line each.

    It is run as `benchmark.run` does, with two seeds of 6,000 steps each, and one run twice: the same seed is to give
    the same curve, another seed another one.

    Args:
        agent, hyperparameters, workers: as `benchmark.run` takes them.
        timeout: seconds after which a run is ended.
    Returns:
        An AgentCheck, which is true if there was no error. Print it.
    """
    check_timeout(timeout)
    label = agent if isinstance(agent, str) else getattr(agent, "__qualname__", repr(agent))
    suite = Suite("check", CHECK_PROTOCOL, tuple(frozen(task, CHECK_PROTOCOL) for task in TASKS), ())
    suite = replace(suite, digest=digest_of_suite(suite))
    options: dict[str, Any] = {"hyperparameters": hyperparameters, "timeout": timeout, "workers": workers}
    with tempfile.TemporaryDirectory() as folder:

        def outcome_of(name: str, **more: Any) -> Outcome:
            try:
                return run(agent, suite, out=Path(folder) / name, **more, **options)
            except AllRunsFailed as error:
                return error.outcome

        try:
            first = outcome_of("first", seeds=range(2))
            again = outcome_of("again", seeds=[0], tasks=TASKS[0].name)
        except ParameterError as error:
            return AgentCheck(label, (str(error),), (), {})
    curves = first.results.curves
    notes = [f"{which}: {text}" for runs in first.notes.values() for which, text in list(runs.items())[:1]]
    name = TASKS[0].name
    if name in curves and name in again.results.curves and (curves[name][0] != again.results.curves[name][0]).any():
        notes.append(
            f"{name}, seed 0: another run with the same seed has another curve; expected the same: seed all random "
            f"numbers, and use one thread"
        )
    scores = {task: each.value for task, each in first.scores.tasks.items()}
    return AgentCheck(label, tuple(dict.fromkeys(first.missing.values())), tuple(notes), scores)
