"""Ranks that are threads of the test: their exchanges are measured, and they can be made to fail or to be late."""

import contextlib
import random
import time

import numpy as np
import pytest

from pharos import ranks


class Killed(Exception):
    """In place of a kill."""


def fails_at(who, number):
    """One rank fails at one of its exchanges, or as it sends a message or waits for some."""

    def disturb(rank):
        calls = iter(range(10**9))

        def failing(call):
            def disturbed(*arguments):
                if rank.rank == who and next(calls) == number:
                    raise Killed(f"at exchange {number}")
                return call(*arguments)

            return disturbed

        rank.exchange, rank.send, rank.finish = map(failing, (rank.exchange, rank.send, rank.finish))

    return disturb


def out_of_order(seed):
    """Messages leave late and in any order, and until `finish` there is rubbish where they are to arrive."""

    def disturb(rank):
        rng = random.Random(f"{seed}, {rank.rank}")
        send, receive, finish = rank.send, rank.receive, rank.finish
        waiting, places = [], []

        def leave(count):
            for _ in range(count):
                first = {}  # of those to each rank, as these stay in order
                for i, (to, _, _) in enumerate(waiting):
                    first.setdefault(to, i)
                to, array, before = waiting.pop(rng.choice(sorted(first.values())))
                assert array.tobytes() == before
                send(to, array)

        def sent(to, array):
            waiting.append((to, array, array.tobytes()))
            moved()

        def received(source, into):
            places.append(into)
            receive(source, into)
            moved()

        def moved():
            leave(rng.randint(0, len(waiting)))
            for into in places:
                into[...] = rng.choice([-77, 0, 10**6])
            if rng.random() < 0.1:
                time.sleep(1e-4)

        def finished():
            moved()
            leave(len(waiting))
            places.clear()
            finish()

        rank.send, rank.receive, rank.progress, rank.finish = sent, received, moved, finished

    return disturb


def aligned(array):
    return max(1, -(-array.nbytes // 64)) * 64


@contextlib.contextmanager
def threads(module, disturb=lambda rank: None):
    """What a module runs by several processes runs in threads; none sends more at a time than the module said."""

    def together(size, program, capacity):
        def run(rank):
            exchange, send, finish, sizes = rank.exchange, rank.send, rank.finish, []

            def bounded(parts):
                assert sum(-(-part.nbytes // 64) * 64 for part in parts) + 64 + 16 * size <= capacity
                return exchange(parts)

            def sent(to, array):
                sizes.append(aligned(array))
                assert sum(sizes) <= capacity
                assert array.size and to != rank.rank
                send(to, np.array(array))

            def finished():
                sizes.clear()
                finish()

            rank.exchange, rank.send, rank.finish = bounded, sent, finished
            disturb(rank)
            return program(rank)

        with ranks.loop(size, run) as rank:
            return run(rank)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "together", together)
        yield
