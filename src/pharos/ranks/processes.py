"""Ranks that are forked processes of one machine, and exchange through memory that they share.

No locks: each rank counts its exchanges in a place of its own and waits for the counts of the others, so one that is
killed blocks nobody. Arrays go through the outbox of who sends them. An outbox has two halves, used in turn: nobody
writes into one before everybody has read what was there, as two exchanges ago all have gone on from it. Messages from
one to one lie in two more halves, also used in turn, each anew once all that was in it has been taken; so who waits for
messages, waits for those alone that send to it.
"""

import contextlib
import mmap
import multiprocessing
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from pharos.errors import ParameterError
from pharos.ranks.rank import Rank, RankFailed, error_of, text_of

_LINE = 8  # int64 entries between two counts: a cache line
_TEXT = 1 << 12  # bytes of the text of a failure
_PATIENCE = 200  # looks at the counts before a process sleeps between them
_NAP, _LONG_NAP = 2e-5, 1e-3
_ALIGNMENT = 64
_SLOTS = 8  # messages from one rank to another that may wait to be taken


class _Memory:
    """What the processes share.

    Attributes:
        counts: (size * _LINE,) int64, exchanges of each rank. failure: (1 + _TEXT,) bytes: 0, or 1 + rank, and text.
        sent, taken: (size, size) int64, messages of one rank to another, and how many of them that one has taken.
        places: (size, size, _SLOTS) int64, where the last of them lie.
        outboxes: (size, 4, capacity) bytes: two halves for exchanges, two for messages.
    """

    def __init__(self, size: int, capacity: int):
        self.counts = np.frombuffer(mmap.mmap(-1, size * _LINE * 8), np.int64)
        self.failure = np.frombuffer(mmap.mmap(-1, 8 + _TEXT), np.uint8)
        self.capacity = -(-capacity // mmap.PAGESIZE) * mmap.PAGESIZE
        no_reserve = 0x4000 if sys.platform == "linux" else 0  # MAP_NORESERVE, which Python names from 3.13 on
        flags = mmap.MAP_SHARED | mmap.MAP_ANONYMOUS | no_reserve
        memory = mmap.mmap(-1, size * 4 * self.capacity, flags=flags)
        self.outboxes = np.frombuffer(memory, np.uint8).reshape(size, 4, self.capacity)
        mail = np.frombuffer(mmap.mmap(-1, size * size * (2 + _SLOTS) * 8), np.int64)
        self.sent, self.taken, places = np.split(mail, [size**2, 2 * size**2])
        self.sent, self.taken = self.sent.reshape(size, size), self.taken.reshape(size, size)
        self.places = places.reshape(size, size, _SLOTS)


class _Process(Rank):
    def __init__(self, rank: int, size: int, memory: _Memory, dead: Callable[[], str | None]):
        self.rank, self.size, self.neighbors, self._memory, self._dead = rank, size, size, memory, dead
        self._exchanges = 0
        self._expected: list[tuple[int, np.ndarray]] = []
        self._mail = 0  # bytes that messages to others have taken since the last `finish`
        self._finished = 0  # how often `finish` was called
        # messages to each rank until the last `finish` but one, and until the last
        self._until = np.zeros((2, size), np.int64)

    def exchange(self, parts: Sequence[np.ndarray]) -> list[np.ndarray]:
        half = self._exchanges % 2
        outbox = self._memory.outboxes[self.rank, half]
        self._put(parts, outbox)
        self._exchanges += 1
        self._memory.counts[self.rank * _LINE] = self._exchanges
        counts = self._memory.counts[::_LINE]
        self._wait(lambda: bool((counts >= self._exchanges).all()))
        return [self._take(self._memory.outboxes[rank, half], parts[rank]) for rank in range(self.size)]

    def _put(self, parts: Sequence[np.ndarray], outbox: np.ndarray) -> None:
        """Where each part begins, how many rows it has, then the parts."""
        table = outbox[: 16 * self.size].view(np.int64)
        place = -(-16 * self.size // _ALIGNMENT) * _ALIGNMENT
        for rank, part in enumerate(parts):
            if place + part.nbytes > len(outbox):
                raise ParameterError(f"an exchange of {place + part.nbytes} bytes; expected at most {len(outbox)}")
            table[2 * rank], table[2 * rank + 1] = place, len(part)
            if len(part):
                outbox[place : place + part.nbytes] = np.ascontiguousarray(part).reshape(-1).view(np.uint8)
            place += -(-part.nbytes // _ALIGNMENT) * _ALIGNMENT

    def _take(self, outbox: np.ndarray, like: np.ndarray) -> np.ndarray:
        """The part for this rank, copied."""
        table = outbox[: 16 * self.size].view(np.int64)
        place, rows = int(table[2 * self.rank]), int(table[2 * self.rank + 1])
        part = np.empty((rows, *like.shape[1:]), like.dtype)
        if rows:
            part.reshape(-1).view(np.uint8)[:] = outbox[place : place + part.nbytes]
        return part

    def send(self, to: int, array: np.ndarray) -> None:
        memory, me = self._memory, self.rank
        if not self._mail:
            self._wait(lambda: bool((memory.taken[me] >= self._until[0]).all()))
        place, number = self._mail, int(memory.sent[me, to])
        self._mail += max(1, -(-array.nbytes // _ALIGNMENT)) * _ALIGNMENT
        if self._mail > memory.capacity:
            raise ParameterError(f"messages of {self._mail} bytes; expected at most {memory.capacity}")
        assert number - memory.taken[me, to] < _SLOTS
        into = memory.outboxes[me, 2 + self._finished % 2, place : place + array.nbytes]
        into[:] = np.ascontiguousarray(array).reshape(-1).view(np.uint8)
        memory.places[me, to, number % _SLOTS] = place + self._finished % 2 * memory.capacity
        memory.sent[me, to] = number + 1

    def receive(self, source: int, into: np.ndarray) -> None:
        assert into.flags.c_contiguous
        self._expected.append((source, into))

    def finish(self) -> None:
        memory, me = self._memory, self.rank
        for source, into in self._expected:
            number = int(memory.taken[source, me])
            sent = memory.sent[source, me : me + 1]
            self._wait(lambda sent=sent, number=number: bool(sent[0] > number))  # type: ignore[misc]
            place = int(memory.places[source, me, number % _SLOTS])
            mail = memory.outboxes[source, 2:].reshape(-1)
            into.reshape(-1).view(np.uint8)[:] = mail[place : place + into.nbytes]
            memory.taken[source, me] = number + 1
        self._expected.clear()
        self._mail = 0
        self._finished += 1
        self._until = np.stack([self._until[1], memory.sent[me]])

    def _wait(self, is_over: Callable[[], bool]) -> None:
        """Until the others have come so far."""
        looks, next_look = 0, 0.0
        while not is_over():
            looks += 1
            if looks < _PATIENCE:
                time.sleep(0)
                continue
            self._raise_failure()
            if time.monotonic() > next_look:  # whether they live is a question to the system
                next_look = time.monotonic() + 0.05
                reason = self._dead()
                if reason and not is_over():
                    self._raise_failure()
                    raise RankFailed(reason)
            time.sleep(_NAP if looks < 10 * _PATIENCE else _LONG_NAP)

    def _raise_failure(self) -> None:
        failure = self._memory.failure
        if failure[0]:
            text = failure[8:].tobytes().rstrip(b"\0").decode(errors="replace")
            raise error_of(text, int(failure[0]) - 1)

    def fail(self, error: BaseException) -> None:
        failure = self._memory.failure
        if failure[0] == 0:
            text = np.frombuffer(text_of(error).encode()[:_TEXT], np.uint8)
            failure[8 : 8 + len(text)] = text
            failure[0] = min(self.rank, 254) + 1


@contextlib.contextmanager
def processes(size: int, answer: Callable[[Rank], None], capacity: int) -> Iterator[Rank]:
    """Rank 0, while forked processes run `answer` as the others.

    Args:
        capacity: bytes that a rank sends in an exchange, at most.
    Raises:
        ParameterError: this system cannot fork processes.
    """
    if "fork" not in multiprocessing.get_all_start_methods():
        raise ParameterError("several processes are forked, which this system cannot; expected processes=1, or MPI")
    memory = _Memory(size, capacity)
    parent = os.getpid()
    context = multiprocessing.get_context("fork")

    def orphaned() -> str | None:
        return None if os.getppid() == parent else "rank 0 died"

    def run(rank: int) -> None:
        there = _Process(rank, size, memory, orphaned)
        try:
            answer(there)
        except BaseException as error:
            there.fail(error)
            os._exit(1)
        os._exit(0)  # without what this process has inherited and would do at its end

    children = [context.Process(target=run, args=(rank,), daemon=True) for rank in range(1, size)]

    def dead() -> str | None:
        for rank, child in enumerate(children, 1):
            if not child.is_alive():
                return f"rank {rank} of {size} died (exit code {child.exitcode}); the same command resumes"
        return None

    here = _Process(0, size, memory, dead)
    try:
        for child in children:
            child.start()
        yield here
    except BaseException as error:
        here.fail(error)
        raise
    finally:
        for child in children:
            if child.pid is not None:
                child.join(5)
                if child.is_alive():
                    child.kill()
                    child.join()
