"""What comes before the runs of a study: state spaces are built, and tasks solved, once for all runs on them."""

import contextlib
import json
import multiprocessing
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from pharos.errors import StateSpaceLocked
from pharos.state_space import build
from pharos.study import values as _values
from pharos.study import worker as _worker
from pharos.study.blocks import Run
from pharos.study.processes import end_processes
from pharos.system.workers import check_guard, without_interrupts, without_main

POLL_SECONDS = 2.0


def prepare_instance(config: Mapping[str, Any]) -> None:
    """Build the state space of a run into the cache, and keep the values of its task at the start."""
    build(_values.task_of(config).env, wait=False)
    _values.solve(config)


def prepare_instances(
    prepare: Callable[[Mapping[str, Any]], Any], runs: Iterable[Run], tell: Callable[[str], Any]
) -> None:
    """Call `prepare` with one config of each instance of the runs, and `tell` what it is at; failures are not told."""
    instances: dict[str, Run] = {}
    for run in runs:
        config = run.config
        key = json.dumps([config[name] for name in ("environment", "parameters", "chance", "gamma", "horizon")])
        instances.setdefault(key, run)
    todo = list(instances.values())
    while todo:
        del todo[: _prepare(prepare, todo, len(instances), tell)]


def _prepare(
    prepare: Callable[[Mapping[str, Any]], Any], todo: Sequence[Run], total: int, tell: Callable[[str], Any]
) -> int:
    """Prepare instances in a process of their own; how many are done, the one at which it died included."""
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_prepare_all, args=(prepare, [run.config for run in todo], sender))
    with without_main(prepare, *(each for run in todo for each in run.configuration.definitions)), without_interrupts():
        process.start()
    sender.close()
    done, waits_for = 0, ""
    try:
        while done < len(todo):
            run = todo[done]
            number = total - len(todo) + done + 1
            tell(f"preparing {run.instance}, {run.chance} ({number} of {total}){waits_for}")
            if receiver.poll(POLL_SECONDS):
                message = receiver.recv()
                waits_for = f"; {message}" if message else ""
                done += not message
    except EOFError:
        done += 1
    except BaseException:
        end_processes([process])
        raise
    finally:
        receiver.close()
    process.join()
    check_guard(process.exitcode)
    return done


def _prepare_all(
    prepare: Callable[[Mapping[str, Any]], Any], configs: Iterable[Mapping[str, Any]], sender: Any
) -> None:
    """Prepare instances one after the other; send "" after each, and why where it waits."""
    _worker.end_cleanly()
    _worker.end_with_parent()
    for config in configs:
        with contextlib.suppress(Exception):  # the runs of this instance will fail with the same error, and say so
            unless_locked(prepare, config, sender.send)
        sender.send("")
    _worker.is_ending()


def unless_locked(
    prepare: Callable[[Mapping[str, Any]], Any], config: Mapping[str, Any], tell: Callable[[str], None]
) -> None:
    """Prepare an instance; where another process is building it, wait for that one."""
    while True:
        try:
            prepare(config)
            return
        except StateSpaceLocked as error:
            tell(str(error))
            time.sleep(POLL_SECONDS)
