"""Runs of the batched engine in several processes: whole lanes each, and files as the only results.

Results do not depend on it, as a run does not depend on its batch.
"""

import multiprocessing
import signal
import sys
from collections.abc import Sequence
from multiprocessing import connection
from pathlib import Path
from typing import Any

from pharos.agents.batched import lane_width
from pharos.errors import FileFormatError, ParameterError, PharosError
from pharos.system.workers import check_guard, end_with_parent, without_interrupts, without_main
from pharos.training import results as _results
from pharos.training.batch import Progress, ProgressCallback, train_configs
from pharos.training.config import RunConfig
from pharos.training.run_folder import TrainingResult, finished_result
from pharos.training.task_cache import FailedRun, TaskCache


def parts_of(configs: Sequence[RunConfig], workers: int, device: str = "cpu") -> list[list[int]]:
    """Places of the runs by process: whole lanes, dealt out in turn; one list where there is nothing to share."""
    width = lane_width(any("image" in config.observation for config in configs), device)
    lanes = [list(range(first, min(first + width, len(configs)))) for first in range(0, len(configs), width)]
    number = min(workers, len(lanes))
    if number < 2 or any(config.engine != "batched" for config in configs):
        return [list(range(len(configs)))]
    return [[place for lane in lanes[part::number] for place in lane] for part in range(number)]


def train_parts(
    configs: Sequence[RunConfig],
    folders: Sequence[Path],
    parts: Sequence[Sequence[int]],
    *,
    checkpoints: Path | None,
    device: str,
    progress: ProgressCallback | None,
) -> list[TrainingResult | FailedRun]:
    """As `train_configs`, each part in a process of its own, which ends with this one."""
    context = multiprocessing.get_context("spawn")
    processes: list[Any] = []
    places: dict[Any, tuple[int, Sequence[int]]] = {}
    done, finished, failed = [0] * len(parts), [0] * len(parts), [0] * len(parts)
    total = sum(config.steps for config in configs)
    try:
        for number, part in enumerate(parts):
            receiver, sender = context.Pipe(duplex=False)
            entries = [(configs[place].to_dict(), folders[place]) for place in part]
            process = context.Process(target=_train, args=(entries, checkpoints, device, sender), daemon=True)
            with without_main(*configs[0].definitions), without_interrupts():
                process.start()
            sender.close()
            processes.append(process)
            places[receiver] = (number, part)
        while places:
            for ready in connection.wait(list(places)):
                number, part = places[ready]
                said: Any = ready
                try:
                    now: Progress = said.recv()
                except EOFError:
                    del places[ready]
                    continue
                done[number], finished[number], failed[number] = now.done, now.finished, now.failed
                if progress is not None:
                    rows = {part[place]: row for place, row in now.rows.items()}
                    progress(Progress(sum(done), total, rows, sum(finished), sum(failed)))
    finally:
        for process in processes:
            if places:
                process.terminate()
            process.join()
    for process in processes:
        check_guard(process.exitcode)
    return [_end(config, folder) for config, folder in zip(configs, folders, strict=True)]


def _train(entries: Sequence[tuple[dict[str, Any], Path]], checkpoints: Path | None, device: str, sender: Any) -> None:
    """What a process does: it tells how far it is, and ends when nobody listens; interrupts are for the first one."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent()

    def tell(now: Progress) -> None:
        try:
            sender.send(now)
        except OSError:
            sys.exit(1)

    configs, folders = zip(*entries, strict=True)
    members = TaskCache(trust=True, device=device)  # of code that the process which started this one has imported
    train_configs(configs, folders, checkpoints=checkpoints, progress=tell, members=members)


def _end(config: RunConfig, folder: Path) -> TrainingResult | FailedRun:
    """What a run has left."""
    try:
        done = finished_result(folder, config)
        if done is not None:
            return done
        said = _results.read_record(folder).get("error") if (folder / _results.RECORD).exists() else None
    except (ParameterError, FileFormatError) as error:
        return FailedRun(config.to_dict(), folder, error)
    text = said or f"{folder}: the process that trained it ended without a result; the same command goes on from there"
    return FailedRun(config.to_dict(), folder, PharosError(text))
