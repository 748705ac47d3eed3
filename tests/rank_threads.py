"""Ranks that are threads of the test, which can be made to fail or to be late."""

import contextlib
import random
import threading
import time
from collections import defaultdict, deque

import numpy as np
import pytest

from pharos.ranks import Alone, Rank, RankFailed, error_of, text_of


class _Room:
    """What the threads share."""

    def __init__(self, size):
        self.barrier = threading.Barrier(size)
        self.sent = [()] * size
        self.failure = None
        self.mail = defaultdict(deque)  # by (from, to)
        self.news = threading.Condition()  # of mail, and of the end
        self.is_over = False


class _Thread(Rank):
    def __init__(self, rank, size, room):
        self.rank, self.size, self.neighbors, self._room = rank, size, size, room
        self._expected = []

    def exchange(self, parts):
        self._room.sent[self.rank] = parts
        self._wait()
        received = [self._room.sent[rank][self.rank].copy() for rank in range(self.size)]
        self._wait()
        return received

    def _wait(self):
        try:
            self._room.barrier.wait()
        except threading.BrokenBarrierError:
            raise self._failure() from None

    def _failure(self):
        rank, text = self._room.failure or (0, "RankFailed\nthe others have ended")
        return error_of(text, rank)

    def send(self, to, array):
        with self._room.news:
            self._room.mail[self.rank, to].append(array.copy())
            self._room.news.notify_all()

    def receive(self, source, into):
        self._expected.append((source, into))

    def finish(self):
        room = self._room
        for source, into in self._expected:
            with room.news:
                box = room.mail[source, self.rank]
                room.news.wait_for(lambda box=box: box or room.is_over)
                if not box:
                    raise self._failure()
                array = box.popleft()
            assert (array.shape, array.dtype) == (into.shape, into.dtype)
            into[...] = array
        self._expected.clear()

    def fail(self, error):
        if self._room.failure is None and not isinstance(error, RankFailed):
            self._room.failure = self.rank, text_of(error)
        with self._room.news:
            self._room.is_over = True
            self._room.news.notify_all()
        self._room.barrier.abort()


@contextlib.contextmanager
def loop(size, answer):
    """Rank 0, while threads run `answer` as the others."""
    room = _Room(size)
    here = _Thread(0, size, room)

    def run(rank):
        there = _Thread(rank, size, room)
        try:
            answer(there)
        except BaseException as error:
            there.fail(error)

    threads = [threading.Thread(target=run, args=(rank,), daemon=True) for rank in range(1, size)]
    for thread in threads:
        thread.start()
    try:
        yield here
    except BaseException as error:
        here.fail(error)
        raise
    finally:
        for thread in threads:
            thread.join()


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


@contextlib.contextmanager
def threads(module, size, disturb=lambda rank: None):
    """A module's programs of "mpi" run in `size` threads; none sends nothing, or anything to itself."""

    def run_spmd(processes, program):
        def run(rank):
            send = rank.send

            def sent(to, array):
                assert array.size and to != rank.rank
                send(to, np.array(array))

            rank.send = sent
            disturb(rank)
            return program(rank)

        if processes != "mpi":
            return run(Alone())
        with loop(size, run) as rank:
            return run(rank)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "run_spmd", run_spmd)
        yield
