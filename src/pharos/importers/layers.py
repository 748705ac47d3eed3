"""The states of a deterministic game, layer by layer: those that can be reached in 0, 1, 2, ... steps.

A game is stepped from a saved state. States with equal bytes are one state. Each finished layer is kept in a folder, so
that a killed import goes on there; processes may share a layer, and the result depends on neither.
"""

import atexit
import contextlib
import multiprocessing
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np

from pharos.errors import FolderLocked, ParameterError, PharosError, StateSpaceTooLarge
from pharos.system import distinct_rows, storage
from pharos.system.distinct_rows import DistinctRows, RowCollector
from pharos.system.workers import end_cleanly, end_with_parent, without_main

LAYERS_FORMAT, LAYERS_MANIFEST = "pharos layers", "manifest.json"
END = -1
STATES_PER_JOB = 16
"""States that a process expands at a time."""
LARGEST_STATE = 1 << 24


class Console(Protocol):
    """A deterministic game that can be saved and restored.

    Attributes:
        actions: names of the actions.
    """

    actions: tuple[str, ...]

    def start(self) -> bytes:
        """Begin an episode; the saved start state."""

    def load(self, saved: bytes) -> object:
        """A saved state in the form that `step` takes."""

    def step(self, state: Any, action: int) -> tuple[float, bool]:
        """(reward, whether the episode ends) of an action in a state."""

    def save(self) -> bytes:
        """The state after the last step or the start."""

    def screen(self) -> np.ndarray:
        """(H, W, 3) uint8, what is seen after the last step or the start."""

    def last_reward(self) -> float:
        """Rewards after the last step of an episode that the horizon cuts off."""


class ConsoleLayers(NamedTuple):
    """All states at depth 0 to T - 1 of a game.

    Attributes:
        next_states: (S, A) int64, -1 for the end of an episode. Depth T is the end.
        rewards: (S, A) float64.
        screens: (S, H, W, 3).
        sizes: number of states of each depth.
        num_steps: steps of the game that were played now.
        actions: their names.
    """

    next_states: np.ndarray
    rewards: np.ndarray
    screens: DistinctRows
    sizes: list[int]
    num_steps: int
    actions: tuple[str, ...]


class ConsoleStep(NamedTuple):
    """One action of one state, as a process sends it.

    key is empty if the episode ends. saved (deflated) and screen come with the first of equal keys, but not in the last
    layer.
    """

    reward: float
    key: bytes
    saved: bytes = b""
    screen: np.ndarray | None = None


class LayerTask(NamedTuple):
    """Settings that all states of a layer share when it is expanded.

    Attributes:
        depth: of the states.
        dictionary, next_dictionary: saved states like which these, and those that they lead to, are deflated.
        is_last: whether the horizon ends the episode afterwards.
    """

    depth: int
    dictionary: bytes
    next_dictionary: bytes
    is_last: bool


class Player:
    """Expands states of a game, in this process or in one of its own."""

    def __init__(self, make: Callable[[], Console]):
        self.game = make()
        self.first = self.game.start()
        self._depth, self._sent = -1, set[bytes]()

    def expand(self, task: LayerTask, states: Sequence[bytes]) -> list[ConsoleStep]:
        """Steps of all actions in deflated states of one depth."""
        if task.depth != self._depth:
            self._depth, self._sent = task.depth, set()
        steps = []
        for packed in states:
            state = self.game.load(inflated(packed, task.dictionary))
            for action in range(len(self.game.actions)):
                reward, ends = self.game.step(state, action)
                if ends:
                    steps.append(ConsoleStep(reward, b""))
                elif task.is_last:
                    key = key_of(self.game.save())
                    steps.append(ConsoleStep(reward + self.game.last_reward(), key))
                else:
                    steps.append(self._step(reward, task.next_dictionary))
        return steps

    def _step(self, reward: float, dictionary: bytes) -> ConsoleStep:
        saved = self.game.save()
        key = key_of(saved)
        if key in self._sent:
            return ConsoleStep(reward, key)
        self._sent.add(key)
        return ConsoleStep(reward, key, deflated(saved, dictionary), self.game.screen())


def key_of(saved: bytes) -> bytes:
    """16 bytes that stand for a saved state."""
    return bytes.fromhex(storage.digest_of_bytes(saved))


def deflated(saved: bytes, dictionary: bytes) -> bytes:
    """A saved state, by how it differs from another one: some 1 kB of a game of Atari, of 14 kB."""
    machine = zlib.compressobj(1, zlib.DEFLATED, zlib.MAX_WBITS, zdict=dictionary[-(1 << 15) :])
    return machine.compress(saved) + machine.flush()


def inflated(packed: bytes, dictionary: bytes) -> bytes:
    """The saved state of `deflated`.

    Raises:
        ValueError: the bytes are something else.
    """
    try:
        return zlib.decompressobj(zdict=dictionary[-(1 << 15) :]).decompress(packed, LARGEST_STATE)
    except zlib.error as error:
        raise ValueError(f"a saved state cannot be read: {error}") from None


# The search -----------------------------------------------------------------------------------------------------------


@dataclass
class LayerSearch:
    """States in the order in which they are met first: breadth first, by action.

    Attributes:
        dictionary: a saved state; the states of the frontier are deflated with it. It is the first one of the layer
            before, as random generators of a console are renewed every few hundred frames.
        keys: number of each state by its key.
        sizes: number of states of each depth so far.
        rows, rewards: one array of each expanded layer.
        screen_numbers: (states,) numbers of their screens. collector: the distinct ones.
        shown: number of distinct screens after each layer.
        frontier: deflated states of the deepest layer.
    """

    dictionary: bytes
    collector: RowCollector
    keys: dict[bytes, int] = field(default_factory=dict)
    sizes: list[int] = field(default_factory=list)
    rows: list[np.ndarray] = field(default_factory=list)
    rewards: list[np.ndarray] = field(default_factory=list)
    screen_numbers: list[int] = field(default_factory=list)
    shown: list[int] = field(default_factory=list)
    frontier: list[bytes] = field(default_factory=list)

    def add(self, step: ConsoleStep) -> int:
        """Number of the state that a step leads to; it joins the next layer if it is new.

        A step of the last layer, which has no screen, ends the episode in a new state.
        """
        if not step.key or (step.screen is None and step.key not in self.keys):
            return END
        number = self.keys.setdefault(step.key, len(self.keys))
        if number == len(self.screen_numbers):
            assert step.screen is not None
            self.screen_numbers.append(self.collector.add(step.screen))
            self.frontier.append(step.saved)
        return number


def explored(
    make: Callable[[], Console],
    identity: Mapping[str, Any],
    *,
    horizon: int,
    max_states: int,
    folder: Path | None,
    workers: int,
    settles: bool,
    progress: Callable[[str], object] | None = None,
) -> ConsoleLayers:
    """Return all states that a game reaches within a horizon, each expanded.

    Args:
        make: a new game; importable, as processes of their own call it too.
        identity: what decides the game; layers of another one are refused.
        folder: of finished layers; None: nothing is stored.
        settles: whether the last step may pay more than a step before would.
        progress: called with a line after each layer and now and then.
    Raises:
        StateSpaceTooLarge: more than max_states. ParameterError: the folder holds another game. FolderLocked: another
            process imports there.
    """
    player, name = Player(make), str(identity["game"])
    search = LayerSearch(player.first, RowCollector((*player.game.screen().shape,), np.uint8))
    store, steps = None, 0
    with contextlib.ExitStack() as held:
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)
            held.enter_context(storage.lock(folder, FolderLocked, "importing"))
            store = KeptLayers(folder, {**identity, "start": key_of(player.first).hex()})
            store.restore(search, horizon - settles)
        if not search.keys:
            step = ConsoleStep(0.0, key_of(player.first), deflated(player.first, player.first), player.game.screen())
            search.add(step)
            search.sizes.append(1)
            search.shown.append(1)
        team = held.enter_context(Team(player, make, workers))
        while len(search.rows) < horizon and search.frontier:
            depth = len(search.rows)
            is_last = depth == horizon - 1
            states, search.frontier = search.frontier, []
            task = LayerTask(depth, search.dictionary, inflated(states[0], search.dictionary), is_last)
            search.dictionary = task.next_dictionary
            rows, rewards = [], []
            for done, block in team.expanded(task, states):
                for step in block:
                    rows.append(search.add(step))
                    rewards.append(step.reward)
                if len(search.keys) > max_states:
                    raise _too_large(name, search, max_states, done, len(states))
                if progress is not None:
                    progress(f"depth {depth}: {done:,} of {len(states):,} states, {len(search.keys):,} in all")
            steps += len(rows)
            search.rows.append(np.array(rows, np.int64).reshape(len(states), -1))
            search.rewards.append(np.array(rewards, np.float64).reshape(len(states), -1))
            if not is_last:
                search.sizes.append(len(search.frontier))
                search.shown.append(search.collector.num_distinct)
                if store is not None:
                    store.append(search)
    return _layers(search, horizon, steps, player.game.actions)


def _layers(search: LayerSearch, horizon: int, steps: int, actions: tuple[str, ...]) -> ConsoleLayers:
    sizes = [size for size in search.sizes[:horizon] if size]
    count = sum(sizes)
    table = np.concatenate(search.rows[: len(sizes)])
    rewards = np.concatenate(search.rewards[: len(sizes)])
    screens = search.collector.rows(np.array(search.screen_numbers[:count], np.int64))
    if count < len(search.screen_numbers):  # layers of a longer horizon
        screens = distinct_rows.shorten_rows(screens, search.shown[len(sizes) - 1])
    return ConsoleLayers(np.where(table >= count, END, table), rewards, screens, sizes, steps, actions)


def _too_large(name: str, search: LayerSearch, most: int, done: int, states: int) -> StateSpaceTooLarge:
    depth = len(search.rows)
    held = sum(search.sizes)
    sizes = ", ".join(f"{size:,}" for size in search.sizes)
    return StateSpaceTooLarge(
        f"{name}: more than {most:,} states at depth {depth + 1}, after {done:,} of the {states:,} states of depth "
        f"{depth} (layers: {sizes}); --horizon {depth + 1} fits, with {held:,} states, or raise --max-states"
    )


# Processes ------------------------------------------------------------------------------------------------------------


_player: Player | None = None  # of a process that works for another


def _begin(make: Callable[[], Console]) -> None:
    global _player
    end_cleanly()
    end_with_parent()
    atexit.register(globals().update, _player=None)  # an emulator that outlives its library complains
    _player = Player(make)


def _expand(task: LayerTask, states: Sequence[bytes]) -> list[ConsoleStep]:
    assert _player is not None
    return _player.expand(task, states)


class Team:
    """The processes that share a layer: this one alone, or several others."""

    def __init__(self, player: Player, make: Callable[[], Console], workers: int):
        self._player, self._make = player, make
        self._pool: ProcessPoolExecutor | None = None
        if workers > 1:
            context = multiprocessing.get_context("spawn")
            self._pool = ProcessPoolExecutor(workers, mp_context=context, initializer=_begin, initargs=(make,))

    def __enter__(self) -> "Team":
        return self

    def __exit__(self, *_: object) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)

    def expanded(self, task: LayerTask, states: Sequence[bytes]) -> Iterator[tuple[int, list[ConsoleStep]]]:
        """Yield (states done, steps) of the blocks of a layer, in order."""
        blocks = [states[first : first + STATES_PER_JOB] for first in range(0, len(states), STATES_PER_JOB)]
        done = 0
        for block, steps in zip(blocks, self._steps(task, blocks), strict=True):
            done += len(block)
            yield done, steps

    def _steps(self, task: LayerTask, blocks: Sequence[Sequence[bytes]]) -> Iterator[list[ConsoleStep]]:
        if self._pool is None:
            for block in blocks:
                yield self._player.expand(task, block)
            return
        try:
            with without_main(self._make):
                steps = self._pool.map(_expand, [task] * len(blocks), blocks)
            yield from steps
        except BrokenProcessPool:
            raise PharosError(
                "a process that shared a layer has ended, perhaps for want of memory; the same command goes on from "
                "the last layer, and --workers 1 needs no other process"
            ) from None


# Layers on disk -------------------------------------------------------------------------------------------------------


class KeptLayers:
    """Finished layers in a folder: FOLDER/manifest.json, written last, and FOLDER/layer-00000.npz and so on.

    The file of a layer holds the rows of its states, and keys, screens and saved bytes of the states that it leads to.
    Bytes are the emulator's own; nothing in a file is executed.

    Args:
        identity: what decides the game, its version and its start.
    Raises:
        ParameterError: the folder holds layers of another game.
    """

    def __init__(self, folder: Path, identity: Mapping[str, Any]):
        self.folder, self.identity = folder, storage.plain(identity)
        self.digests: list[str] = []
        self._written = 0  # chunks of screens

    def restore(self, search: LayerSearch, most: int) -> None:
        """Put the layers that lie there, at most so many, into a new search, up to the first damaged one."""
        path = self.folder / LAYERS_MANIFEST
        if not path.exists():
            return
        manifest = storage.read_json(path)
        if not isinstance(manifest, dict) or manifest.get("format") != LAYERS_FORMAT or not storage.is_intact(manifest):
            return
        if manifest["identity"] != self.identity:
            before, now = manifest["identity"], self.identity
            other = [key for key in {**before, **now} if before.get(key) != now.get(key)]
            words = ", ".join(f"{key} {before.get(key)!r}, now {now.get(key)!r}" for key in other)
            raise ParameterError(
                f"{self.folder}: holds layers of another import ({words}); delete it, or choose another folder"
            )
        for depth, digest in enumerate(manifest["layers"][: max(most, 0)]):
            file = self.folder / f"layer-{depth:05}.npz"
            if not file.is_file() or storage.digest_of_file(file) != digest:
                return
            with np.load(file, allow_pickle=False) as arrays:
                self._put(search, {name: arrays[name] for name in arrays.files})
            self.digests.append(digest)

    def _put(self, search: LayerSearch, arrays: Mapping[str, np.ndarray]) -> None:
        search.rows.append(arrays["next_states"])
        search.rewards.append(arrays["rewards"])
        keys = arrays["keys"].tobytes()
        for first in range(0, len(keys), 16):
            search.keys.setdefault(keys[first : first + 16], len(search.keys))
        before = sum(search.sizes)
        search.sizes += [1] * (not search.sizes)
        search.shown += [1] * (not search.shown)
        search.sizes.append(len(search.keys) - max(before, 1))
        search.screen_numbers += arrays["seen"].tolist()
        search.dictionary = arrays["dictionary"].tobytes()
        search.frontier = split_chunks(arrays["saved"], arrays["saved_lengths"])
        digests = arrays["screen_keys"].tobytes()
        search.collector.resume(
            split_chunks(arrays["chunks"], arrays["chunk_lengths"]),
            bytes(arrays["pending"]),
            [digests[first : first + 16].hex() for first in range(0, len(digests), 16)],
        )
        search.shown.append(search.collector.num_distinct)
        self._written = len(search.collector.chunks)

    def append(self, search: LayerSearch) -> None:
        """Keep the layer that was expanded last."""
        depth = len(search.rows) - 1
        since = 0 if depth == 0 else sum(search.sizes[:-1])  # the start state comes with the first layer
        shown = 0 if depth == 0 else search.shown[-2]
        saved, saved_lengths = join_chunks(search.frontier)
        chunks, chunk_lengths = join_chunks(search.collector.chunks[self._written :])
        keys = list(search.keys)[since:]
        arrays = {
            "next_states": search.rows[-1],
            "rewards": search.rewards[-1],
            "keys": np.frombuffer(b"".join(keys), np.uint8),
            "seen": np.array(search.screen_numbers[since:], np.int64),
            "dictionary": np.frombuffer(search.dictionary, np.uint8),
            "saved": saved,
            "saved_lengths": saved_lengths,
            "chunks": chunks,
            "chunk_lengths": chunk_lengths,
            "pending": np.frombuffer(search.collector.packed_pending(), np.uint8),
            "screen_keys": np.frombuffer(bytes.fromhex("".join(search.collector.digests(shown))), np.uint8),
        }
        file = self.folder / f"layer-{depth:05}.npz"
        with storage.replacing(file) as target:
            np.savez(target, allow_pickle=False, **arrays)
        self._written = len(search.collector.chunks)
        self.digests = [*self.digests[:depth], storage.digest_of_file(file)]
        manifest = {"format": LAYERS_FORMAT, "identity": self.identity, "layers": self.digests}
        storage.replace_json(self.folder / LAYERS_MANIFEST, storage.sealed(manifest))


def join_chunks(parts: Sequence[bytes]) -> tuple[np.ndarray, np.ndarray]:
    """(bytes one after another, length of each)."""
    return np.frombuffer(b"".join(parts), np.uint8), np.array([len(part) for part in parts], np.int64)


def split_chunks(data: np.ndarray, lengths: np.ndarray) -> list[bytes]:
    """The parts that `join_chunks` put together."""
    ends = np.cumsum(lengths).tolist()
    text = data.tobytes()
    return [text[end - length : end] for end, length in zip(ends, lengths.tolist(), strict=True)]
