"""Processes that expand the states of one environment together.

Each process makes the environment for itself. States travel between them in memory as pickles of this program.
Results keep the order of the states, so that the MDP is the same with any number of processes.
"""

import pickle  # noqa: TID251  (the error of a factory that no other process can import)
from collections import deque
from collections.abc import Callable
from multiprocessing import Pipe, connection
from typing import TYPE_CHECKING, Any

from pharos.errors import ParameterError, PharosError, RuleError
from pharos.importers import side_effects
from pharos.importers.search import Arrival
from pharos.system.workers import Workers

if TYPE_CHECKING:
    from pharos.importers.stepped_environment import Factory, SteppedEnvironment, SteppingOptions

STATES_PER_TASK = 16
"""States that a process gets at once. It gets the next when it has handed over their outcomes: one that sends does not
listen."""
BLOCKS_AHEAD = 3


def step_for_others(
    factory: "Factory", options: "SteppingOptions", jobs: connection.Connection, send: Callable[[object], None]
) -> None:
    """The body of a process: expand blocks of states until there are no more."""
    from pharos.importers.stepped_environment import ConstantChanged, SteppedEnvironment

    try:
        with side_effects.undone():
            source = SteppedEnvironment(factory, options)
            source.snapshots.is_closed = True
            send(("ready", source.snapshots.outside_digest()))
            while True:
                number, block = jobs.recv()
                if block is None:
                    return
                send(("rows", number, source.expanded(block)))
    except (PharosError, ConstantChanged) as error:
        kind = type(error) if isinstance(error, ConstantChanged) else RuleError
        send(("error", kind, str(error)))


class ExpansionsElsewhere:
    """States that are expanded by other processes, a block at a time; results come in the order of submission.

    Args:
        source: the environment of this process.
        workers: number of processes.
    Raises:
        ParameterError: another process cannot import the factory.
    """

    def __init__(self, source: "SteppedEnvironment", workers: int):
        self.room = STATES_PER_TASK * BLOCKS_AHEAD * workers
        self._buffer: list[Any] = []
        self._waiting: deque[tuple[int, list[Any]]] = deque()
        self._at_work: dict[int, str] = {}
        self._rows: dict[int, list[list[list[Arrival]]]] = {}
        self._results: deque[list[list[Arrival]]] = deque()
        self._num_blocks = self._num_fetched = 0
        self._digest = source.snapshots.outside_digest()
        self._name = source.name
        source.snapshots.is_closed = True
        self._workers = Workers(__name__, "pharos.importers")
        self._pipes: dict[str, connection.Connection] = {}
        self._ready: set[str] = set()
        try:
            for number in range(workers):
                self._start(f"stepping {number + 1}", source)
        except BaseException:
            self.close()
            raise

    def _start(self, key: str, source: "SteppedEnvironment") -> None:
        receiver, sender = Pipe(duplex=False)
        definitions = (source.factory, source.options.key, source.options.reward)
        try:
            arguments = (source.factory, source.options, receiver)
            self._workers.start(key, step_for_others, arguments, [each for each in definitions if callable(each)])
        except (pickle.PicklingError, AttributeError, TypeError) as error:
            raise ParameterError(
                f"{source.name}: other processes cannot import its factory, key or reward ({error}): give functions of "
                f"a module, or one worker"
            ) from None
        receiver.close()
        self._pipes[key] = sender

    def submit(self, saved: object) -> None:
        """Add a state."""
        self._buffer.append(saved)
        if len(self._buffer) == STATES_PER_TASK:
            self._flush()

    def fetch(self) -> list[list[Arrival]]:
        """The outcomes of the first state that was not fetched."""
        while not self._results:
            if self._num_fetched == self._num_blocks:
                self._flush()
            self._hand_out()
            if (rows := self._rows.pop(self._num_fetched, None)) is not None:
                self._results.extend(rows)
                self._num_fetched += 1
            else:
                self._listen()
        self._hand_out()
        return self._results.popleft()

    def close(self) -> None:
        """End the processes."""
        for pipe in self._pipes.values():
            pipe.close()
        self._workers.__exit__(None, None, None)

    def _flush(self) -> None:
        self._waiting.append((self._num_blocks, self._buffer))
        self._num_blocks += 1
        self._buffer = []

    def _hand_out(self) -> None:
        """Give blocks to processes that have none."""
        busy = set(self._at_work.values())
        for key, pipe in self._pipes.items():
            if self._waiting and key in self._ready and key not in busy:
                number, block = self._waiting.popleft()
                self._at_work[number] = key
                pipe.send((number, block))

    def _listen(self) -> None:
        """Wait for messages of the processes."""
        for key, message in self._workers.events():
            if not isinstance(message, tuple):
                raise RuleError(f"{self._name}: {key} ended (exit code {message}); try one worker")
            kind, *parts = message
            if kind == "error":
                raise parts[0](parts[1])
            if kind == "ready" and parts[0] != self._digest:
                raise RuleError(f"{self._name}: two processes make it differently; try one worker (--workers 1)")
            if kind == "ready":
                self._ready.add(key)
            if kind == "rows":
                number, rows = parts
                del self._at_work[number]
                self._rows[number] = rows
