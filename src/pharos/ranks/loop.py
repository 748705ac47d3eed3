"""Ranks that are threads of this process: the same program, for tests."""

import contextlib
import threading
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from pharos.ranks.rank import Rank, RankFailed, error_of, text_of


class _Room:
    """What the threads share."""

    def __init__(self, size: int):
        self.barrier = threading.Barrier(size)
        self.sent: list[Sequence[np.ndarray]] = [()] * size
        self.failure: tuple[int, str] | None = None


class _Thread(Rank):
    def __init__(self, rank: int, size: int, room: _Room):
        self.rank, self.size, self.neighbors, self._room = rank, size, size, room

    def exchange(self, parts: Sequence[np.ndarray]) -> list[np.ndarray]:
        self._room.sent[self.rank] = parts
        self._wait()
        received = [self._room.sent[rank][self.rank].copy() for rank in range(self.size)]
        self._wait()
        return received

    def _wait(self) -> None:
        try:
            self._room.barrier.wait()
        except threading.BrokenBarrierError:
            rank, text = self._room.failure or (0, "RankFailed\nthe others have ended")
            raise error_of(text, rank) from None

    def fail(self, error: BaseException) -> None:
        if self._room.failure is None and not isinstance(error, RankFailed):
            self._room.failure = self.rank, text_of(error)
        self._room.barrier.abort()


@contextlib.contextmanager
def loop(size: int, answer: Callable[[Rank], None]) -> Iterator[Rank]:
    """Rank 0, while threads run `answer` as the others."""
    room = _Room(size)
    here = _Thread(0, size, room)

    def run(rank: int) -> None:
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
