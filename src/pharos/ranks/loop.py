"""Ranks that are threads of this process: the same program, for tests."""

import contextlib
import threading
from collections import defaultdict, deque
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from pharos.errors import PharosError
from pharos.ranks.rank import Rank, RankFailed, error_of, text_of


class _Room:
    """What the threads share."""

    def __init__(self, size: int):
        self.barrier = threading.Barrier(size)
        self.sent: list[Sequence[np.ndarray]] = [()] * size
        self.failure: tuple[int, str] | None = None
        self.mail: dict[tuple[int, int], deque[np.ndarray]] = defaultdict(deque)  # by (from, to)
        self.news = threading.Condition()  # of mail, and of the end
        self.is_over = False


class _Thread(Rank):
    def __init__(self, rank: int, size: int, room: _Room):
        self.rank, self.size, self.neighbors, self._room = rank, size, size, room
        self._expected: list[tuple[int, np.ndarray]] = []

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
            raise self._failure() from None

    def _failure(self) -> PharosError:
        rank, text = self._room.failure or (0, "RankFailed\nthe others have ended")
        return error_of(text, rank)

    def send(self, to: int, array: np.ndarray) -> None:
        with self._room.news:
            self._room.mail[self.rank, to].append(array.copy())
            self._room.news.notify_all()

    def receive(self, source: int, into: np.ndarray) -> None:
        self._expected.append((source, into))

    def finish(self) -> None:
        room = self._room
        for source, into in self._expected:
            with room.news:
                box = room.mail[source, self.rank]
                room.news.wait_for(lambda box=box: box or room.is_over)  # type: ignore[misc]
                if not box:
                    raise self._failure()
                array = box.popleft()
            assert (array.shape, array.dtype) == (into.shape, into.dtype)
            into[...] = array
        self._expected.clear()

    def fail(self, error: BaseException) -> None:
        if self._room.failure is None and not isinstance(error, RankFailed):
            self._room.failure = self.rank, text_of(error)
        with self._room.news:
            self._room.is_over = True
            self._room.news.notify_all()
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
