"""Ranks that are threads of the test's process: their exchanges are measured, and one of them can be made to fail."""

import contextlib

import pytest

from pharos import ranks


class Killed(Exception):
    """In place of a kill."""


def fails_at(who, number):
    """One rank fails at one of its exchanges."""

    def disturb(rank):
        exchange, calls = rank.exchange, iter(range(10**9))

        def disturbed(parts):
            if rank.rank == who and next(calls) == number:
                raise Killed(f"at exchange {number}")
            return exchange(parts)

        rank.exchange = disturbed

    return disturb


@contextlib.contextmanager
def threads(module, disturb=lambda rank: None):
    """What a module runs by several processes runs in threads; no exchange is larger than the module said."""

    def together(size, program, capacity):
        def run(rank):
            exchange = rank.exchange

            def bounded(parts):
                assert sum(-(-part.nbytes // 64) * 64 for part in parts) + 64 + 16 * size <= capacity
                return exchange(parts)

            rank.exchange = bounded
            disturb(rank)
            return program(rank)

        with ranks.loop(size, run) as rank:
            return run(rank)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "together", together)
        yield
