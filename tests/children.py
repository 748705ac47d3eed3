"""Forked processes, in which nothing is imported or compiled again."""

import multiprocessing
import os
import signal

fork = multiprocessing.get_context("fork")


def in_a_child(work, *args) -> multiprocessing.Process:
    """A forked process that has begun to work."""
    process = fork.Process(target=work, args=args)
    process.start()
    return process


def exit_code(work, *args) -> int:
    process = in_a_child(work, *args)
    process.join()
    return process.exitcode


def kill(process: multiprocessing.Process) -> None:
    os.kill(process.pid, signal.SIGKILL)
    process.join()
    assert process.exitcode == -signal.SIGKILL
