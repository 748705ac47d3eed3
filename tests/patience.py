"""The one limit of tests against waiting for ever. No test fails because a machine is slow."""

import time

PATIENCE = 1800.0
"""Seconds that a process may take, or what is waited for, before a test gives up."""


def wait_for(condition, process=None):
    """The first value of `condition()` that is true; AssertionError if it takes too long, or the process has ended."""
    end = time.monotonic() + PATIENCE
    while not (value := condition()):
        assert process is None or process.poll() is None, f"the process ended with {process.returncode}"
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.01)
    return value
