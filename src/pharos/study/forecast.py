"""How long the runs of a study will take: told before the first of them begins.

Runs of a kind (class of environments, agent, observation, engine) take about as long for each step. The pace of a kind
is that of its finished runs; else what earlier studies on this machine showed, kept in the user's cache; else it is
measured by a few hundred steps and one evaluation, where much depends on it; else it is a guess.
"""

import contextlib
import json
import math
import multiprocessing
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pharos.agents.batched import lane_width
from pharos.errors import FileFormatError
from pharos.study import worker as _worker
from pharos.study.batches import most_states
from pharos.study.blocks import Run
from pharos.study.processes import end_processes, one_thread
from pharos.study.status import duration
from pharos.system.storage import read_json, replace_json
from pharos.system.wording import many
from pharos.system.workers import without_interrupts, without_main

NIGHT_HOURS = 10
# Below so many seconds in all, guesses do
WORTH_MEASURING = 600.0
# What measuring may take, building state spaces included; kinds that are left are guessed
MEASURE_SECONDS = 120.0
MANY_STATES = 1e6
WARM, MEASURED, MEASURED_OF_TABLES, MEASURED_OF_BATCHES = 200, 800, 200_000, 300
FINISHED, EARLIER, NOW, GUESS = "finished runs", "earlier studies", "measured now", "a guess"
# Steps/s by what is seen: vectors, pictures, tables; and how much faster many runs at once are
GUESSES = {"vector": 1200.0, "simple_image": 500.0, "complex_image": 60.0, "index": 1e6}
FASTER = {"vector": 8.0, "simple_image": 3.0}

Kind = tuple[str, str, str, str]


@dataclass(frozen=True)
class Forecast:
    """What the missing runs of a study will take.

    Attributes:
        runs, steps: how many are missing.
        workers: processes.
        seconds: until the last is finished, with so many processes.
        in_a_night: how many of them, in the order of the study, are finished after NIGHT_HOURS.
        paces: kind -> (seconds for a step, evaluation included; where that is known from).
    """

    runs: int
    steps: int
    workers: int
    seconds: float
    in_a_night: int
    paces: Mapping[Kind, tuple[float, str]]

    def __str__(self) -> str:
        """One line; where the whole takes longer than a night, what fits into one."""
        sources = sorted({source for _, source in self.paces.values()})
        text = f"{many(self.runs, 'run')} to come, {self.steps:,} steps: about {duration(self.seconds)} with "
        text += f"{many(self.workers, 'worker')} (paces: {', '.join(sources)})"
        if self.seconds > NIGHT_HOURS * 3600:
            text += f"; a night of {NIGHT_HOURS} h does {self.in_a_night} of them"
        return text


def forecast(
    runs: Sequence[Run],
    workers: int,
    finished: Mapping[Kind, tuple[float, int]],
    *,
    measure: bool = True,
    tell: Callable[[str], Any] = lambda _: None,
) -> Forecast:
    """How long runs will take.

    Args:
        runs: in the order in which they are executed.
        finished: kind -> (seconds, steps) of runs that are over.
        measure: whether paces that are not known are measured, where the whole takes long.
        tell: told what is measured.
    """
    kinds = dict.fromkeys(run.kind for run in runs)
    stored = _stored_paces()
    paces: dict[Kind, tuple[float, str]] = {}
    for kind in kinds:
        seconds, steps = finished.get(kind, (0.0, 0))
        earlier = stored.get(json.dumps(kind))
        if steps and seconds:
            paces[kind] = seconds / steps, FINISHED
        else:
            paces[kind] = (earlier, EARLIER) if earlier else (_guess(kind), GUESS)
    guessed = [kind for kind, (_, source) in paces.items() if source == GUESS]
    if measure and guessed and _seconds(runs, paces) / workers > WORTH_MEASURING:
        share = {kind: _seconds([run for run in runs if run.kind == kind], paces) for kind in guessed}
        longest = sorted(guessed, key=lambda kind: -share[kind])
        for kind, pace in _measured([_smallest(kind, runs) for kind in longest], tell).items():
            paces[kind] = (pace, NOW)
        known_now = [pace / _guess(kind) for kind, (pace, source) in paces.items() if source == NOW]
        slower = math.prod(known_now) ** (1 / len(known_now)) if known_now else 1.0  # this machine than the guesses
        paces |= {kind: (pace * slower, GUESS) for kind, (pace, source) in paces.items() if source == GUESS}
    _keep({json.dumps(kind): pace for kind, (pace, source) in paces.items() if source in (FINISHED, NOW)}, stored)
    night, passed = 0, 0.0
    for run in runs:
        passed += run.config["steps"] * paces[run.kind][0]
        night += passed <= NIGHT_HOURS * 3600 * workers
    steps = sum(run.config["steps"] for run in runs)
    return Forecast(len(runs), steps, workers, _seconds(runs, paces) / workers, night, paces)


def _seconds(runs: Sequence[Run], paces: Mapping[Kind, tuple[float, str]]) -> float:
    return sum(run.config["steps"] * paces[run.kind][0] for run in runs)


def _smallest(kind: Kind, runs: Sequence[Run]) -> Run:
    """The run of a kind whose instance has the fewest states, as far as its variables tell."""
    first = {run.instance: run for run in reversed(runs) if run.kind == kind}
    return min(first.values(), key=lambda run: most_states(run.configuration.make_environment(trust=True)))


def _guess(kind: Kind) -> float:
    _, _, observation, engine = kind
    name = observation if observation in GUESSES else "vector"
    return 1 / (GUESSES[name] * (FASTER.get(name, 1.0) if engine == "batched" else 1.0))


def _file() -> Path:
    from pharos.system.paths import cache_directory

    return cache_directory() / "paces.json"


def _stored_paces() -> dict[str, float]:
    """Seconds for a step by kind, of earlier studies."""
    with contextlib.suppress(FileNotFoundError, FileFormatError):
        paces = read_json(_file())
        if isinstance(paces, dict):
            return {kind: pace for kind, pace in paces.items() if isinstance(pace, float) and 0 < pace < 1e3}
    return {}


def _keep(paces: Mapping[str, float], stored: Mapping[str, float]) -> None:
    if paces:
        with contextlib.suppress(OSError):  # a courtesy to the next study
            _file().parent.mkdir(parents=True, exist_ok=True)
            replace_json(_file(), {**stored, **paces}, durable=False)


# Measuring -----------------------------------------------------------------------------------------------------------


def _measured(runs: Sequence[Run], tell: Callable[[str], Any]) -> dict[Kind, float]:
    """The paces of these runs, one of each kind, measured in a process of its own; without those that fail, and those
    that MEASURE_SECONDS did not suffice for.
    """
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_send_paces, args=([dict(run.config) for run in runs], sender))
    with (
        one_thread(),
        without_main(*(each for run in runs for each in run.configuration.definitions)),
        without_interrupts(),
    ):
        process.start()
    sender.close()
    paces: dict[Kind, float] = {}
    latest = time.monotonic() + MEASURE_SECONDS
    try:
        for number, run in enumerate(runs, start=1):
            tell(f"measuring the pace of {run.kind[1]} on {run.kind[0]}, {run.kind[2]} ({number} of {len(runs)})")
            if not receiver.poll(max(0.0, latest - time.monotonic())):
                break
            pace = receiver.recv()
            if pace is not None:
                paces[run.kind] = pace
    except EOFError:
        pass
    finally:
        receiver.close()
        end_processes([process])
    return paces


def _send_paces(configs: Sequence[Mapping[str, Any]], sender: Any) -> None:
    _worker.end_cleanly()
    _worker.end_with_parent()
    for config in configs:
        pace = None
        with contextlib.suppress(Exception):  # the run will fail with the same error, and say so
            pace = pace_of(config)
        sender.send(pace)
    _worker.is_ending()


def pace_of(config: Mapping[str, Any]) -> float:
    """Seconds for a step of a run, measured on some steps, with learning from the beginning; with its share of an
    evaluation, unless a large space would have to be built for that.
    """
    from pharos.training import RunConfig, evaluate_agent, steps_in_seconds

    made = RunConfig.from_dict(config)
    together = 1 if made.engine != "batched" else lane_width("image" in made.observation)
    task = made.task(trust=True, strict=True)
    measured = MEASURED_OF_TABLES if made.is_tabular else MEASURED if together == 1 else MEASURED_OF_BATCHES
    seconds, agent = steps_in_seconds(made, task, WARM, measured, together)
    if made.engine != "batched" and most_states(task.env) > MANY_STATES:  # its space would be built for this alone
        return seconds / (measured * together)
    evaluate_agent(agent, task)
    began = time.perf_counter()
    evaluate_agent(agent, task)
    return seconds / (measured * together) + (time.perf_counter() - began) / made.evaluation_interval
