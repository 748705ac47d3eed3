"""MiniGrid: the states of the real environments, enumerated by playing them.

Source: Chevalier-Boisvert et al. (2023), "Minigrid & Miniworld".
"""

import io
import pickle  # noqa: TID251  (to copy an environment of the caller)
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from pharos.errors import MissingExtra, ParameterError, RuleError, StateSpaceTooLarge
from pharos.importers.bridge import MINIGRID_STEPS
from pharos.mdp import TabularMDP

DONE = 6  # the action that most tasks ignore
_NOT_STATE = frozenset(
    [
        "step_count",
        "max_steps",
        "gen_obs",
        "_np_random",
        "_np_random_seed",
        "action_space",
        "observation_space",
        "actions",
        "window",
        "clock",
        "render_size",
        "render_mode",
        "screen_size",
        "spec",
        "metadata",
    ]
)


def minigrid(
    env: object,
    *,
    seed: int = 0,
    actions: Sequence[int] | None = None,
    gamma: float = 1.0,
    horizon: int | None = MINIGRID_STEPS,
    max_states: int = 1_000_000,
    remember_carried: bool = False,
) -> TabularMDP:
    """Return the MDP of a MiniGrid environment, by stepping the environment from every state that can be reached.

    A state is all that the environment keeps, without the number of steps: grid, objects and what they contain,
    position, direction, what is carried, and which object is which. Rewards do not shrink with time: what pays more
    than 0 pays 1, as in BRIDGE. A transition that terminates the episode is -1. State 0 is the start, and states are
    numbered in the order of their discovery.

    Args:
        env: an environment or its name, such as "MiniGrid-KeyCorridorS3R1-v0". An environment given is reset and left
            somewhere.
        seed: of the reset that draws the layout.
        actions: those of the MDP, in their order; None: all of the environment, without `done` where it never does
            anything.
        gamma, horizon: of the MDP; 100 steps are those of BRIDGE. The environment's own time limit is not taken over.
        max_states: more are an error.
        remember_carried: each object knows whether it has ever been carried, as in BRIDGE, whose states keep that for
            rewards of progress; so a key put back where it was is another state, though nothing that can happen from
            there is different.
    Raises:
        MissingExtra: the package minigrid is not installed.
        ParameterError: there is no such environment, it is none of MiniGrid, or an action is none of its own.
        RuleError: a step draws random numbers, or touches what cannot be kept.
        StateSpaceTooLarge: there are more than `max_states` states.
    Cost: 0.1 to 1 ms a transition, by the size of the grid; 1 to 20 kB a state while it runs.
    """
    driver = _Driver(env, seed, remember_carried)
    table, rewards = driver.explore(actions, max_states)
    return TabularMDP.from_arrays(table, rewards, gamma=gamma, horizon=horizon)


def minigrid_recording(
    env: object,
    *,
    seed: int = 0,
    gamma: float = 1.0,
    horizon: int | None = MINIGRID_STEPS,
    max_states: int = 1_000_000,
    remember_carried: bool = False,
) -> tuple[TabularMDP, np.ndarray, tuple[str, ...]]:
    """Return what `minigrid` and `minigrid_grids` give, by one exploration, and the names of the actions.

    Args, errors and cost: as of `minigrid`, with all actions.
    """
    driver = _Driver(env, seed, remember_carried)
    table, rewards = driver.explore(None, max_states)
    names = tuple(action.name for action in driver.env.actions)[: table.shape[1]]
    grids = np.stack([driver.image(state) for state in driver.snapshots])
    return TabularMDP.from_arrays(table, rewards, gamma=gamma, horizon=horizon), grids, names


def minigrid_grids(
    env: object,
    *,
    seed: int = 0,
    actions: Sequence[int] | None = None,
    max_states: int = 1_000_000,
    remember_carried: bool = False,
) -> np.ndarray:
    """Return what one sees of each state of `minigrid` with the same arguments, (S, width, height, 3) uint8.

    The whole grid as MiniGrid encodes it (type, colour, condition), with the agent where it stands, its direction as
    condition: the image of MiniGrid's FullyObsWrapper. What is carried is not to be seen.

    Args, errors and cost: as of `minigrid`.
    """
    driver = _Driver(env, seed, remember_carried)
    driver.explore(actions, max_states)
    return np.stack([driver.image(state) for state in driver.snapshots])


class _Driver:
    """An environment that can be put into any state that it has been in."""

    def __init__(self, env: Any, seed: int, remember_carried: bool):
        try:
            import minigrid as package  # registers its environments
            from minigrid.core.world_object import Wall
            from minigrid.minigrid_env import MiniGridEnv
        except ImportError:
            raise MissingExtra("importing MiniGrid", "minigrid", "minigrid") from None
        import gymnasium

        if isinstance(env, str):
            try:
                made = gymnasium.make(env, disable_env_checker=True)
            except gymnasium.error.Error as error:
                raise ParameterError(f"{env!r}: Gymnasium cannot make it: {' '.join(str(error).split())}") from None
        else:
            made = env
        self.env: Any = getattr(made, "unwrapped", made)
        if not isinstance(self.env, MiniGridEnv):
            raise ParameterError(f"{env!r}: is no environment of MiniGrid {package.__version__}")
        self.name = str(env)
        self.wall = Wall
        self.remember_carried = remember_carried
        self.fixed_types = (gymnasium.spaces.Space, np.random.Generator)
        self.fixed: list[Any] = []
        made.reset(seed=seed)
        vars(self.env)["gen_obs"] = dict  # partial views cost most of a step, and nothing here looks at them
        self.snapshots: list[bytes] = []

    def explore(self, chosen: Sequence[int] | None, max_states: int) -> tuple[np.ndarray, np.ndarray]:
        """(next states (S, A), rewards (S, A)), breadth first."""
        num_actions = int(self.env.action_space.n)
        actions = list(range(num_actions)) if chosen is None else [int(action) for action in chosen]
        if not actions or not set(actions) <= set(range(num_actions)) or len(set(actions)) < len(actions):
            raise ParameterError(f"actions are {actions}; expected different ones from 0 to {num_actions - 1}")
        try:
            return self._explore(actions, max_states, drop_done=chosen is None and num_actions == DONE + 1)
        finally:
            del self.env.gen_obs

    def _explore(self, actions: list[int], max_states: int, drop_done: bool) -> tuple[np.ndarray, np.ndarray]:
        snapshot = self.save()
        numbers = {self.key(): 0}
        self.snapshots = [snapshot]
        rows: list[list[int]] = []
        paid: list[list[float]] = []
        while len(rows) < len(self.snapshots):
            row, pay = [], []
            for action in actions:
                self.restore(self.snapshots[len(rows)])
                reward, ended = self.step(action, len(rows))
                pay.append(reward)
                if ended:
                    row.append(-1)
                    continue
                key = self.key()
                number = numbers.setdefault(key, len(numbers))
                if number == len(self.snapshots):
                    if number >= max_states:
                        raise StateSpaceTooLarge(
                            f"{self.name}: has more than max_states={max_states}; raise it or choose a smaller one"
                        )
                    self.snapshots.append(self.save())
                row.append(number)
            rows.append(row)
            paid.append(pay)
        table, rewards = np.array(rows, np.int64), np.array(paid)
        if drop_done and (table[:, DONE] == np.arange(len(table))).all() and (rewards[:, DONE] == 0).all():
            table, rewards = table[:, :DONE], rewards[:, :DONE]
        return table, rewards

    def step(self, action: int, state: int) -> tuple[float, bool]:
        """(reward without its discount by time, whether the episode ends)."""
        rng = self.env.np_random
        before = rng.bit_generator.state
        self.env.step_count = 0
        _, reward, terminated, _, _ = self.env.step(action)
        if self.remember_carried and self.env.carrying is not None:
            self.env.carrying.has_been_carried = True
        if rng.bit_generator.state != before:
            raise RuleError(
                f"{self.name}: draws random numbers in state {state} by action {action}; "
                f"expected one outcome of each action"
            )
        return (1.0 if reward > 0 else float(reward)), bool(terminated)

    def save(self) -> bytes:
        """The state, to be put back."""
        stored = io.BytesIO()
        pickler = pickle.Pickler(stored, protocol=5)
        pickler.persistent_id = self._number_of_fixed  # type: ignore[method-assign]
        pickler.dump(dict(self._attributes()))
        return stored.getvalue()

    def restore(self, snapshot: bytes) -> None:
        """Put a state back that `save` returned: a copy in memory, never a file."""
        reader = pickle.Unpickler(io.BytesIO(snapshot))
        reader.persistent_load = self.fixed.__getitem__  # type: ignore[method-assign,assignment]
        attributes = reader.load()
        for name in [name for name, _ in self._attributes() if name not in attributes]:
            delattr(self.env, name)
        vars(self.env).update(attributes)

    def _number_of_fixed(self, value: object) -> int | None:
        """What is no part of a state and stays where it is: the environment itself, its spaces, its generator."""
        if value is not self.env and not isinstance(value, self.fixed_types):
            return None
        for number, constant in enumerate(self.fixed):
            if constant is value:
                return number
        self.fixed.append(value)
        return len(self.fixed) - 1

    def image(self, snapshot: bytes) -> np.ndarray:
        """(width, height, 3), the grid with the agent in it."""
        from minigrid.core.constants import COLOR_TO_IDX, OBJECT_TO_IDX

        self.restore(snapshot)
        image = np.array(self.env.grid.encode())
        column, row = self.env.agent_pos
        image[int(column), int(row)] = (OBJECT_TO_IDX["agent"], COLOR_TO_IDX["red"], self.env.agent_dir)
        return image

    def key(self) -> bytes:
        """Equal for equal states, and for no others."""
        flat: list[Any] = []
        places: dict[int, int] = {}
        for name, value in self._attributes():
            flat.append(name)
            self._flatten(value, flat, places)
        return repr(flat).encode()

    def _attributes(self) -> Iterator[tuple[str, Any]]:
        """What the environment keeps; the grid first, so that objects are numbered by where they lie."""
        attributes = vars(self.env)
        for name in sorted(attributes, key=lambda name: (name != "grid", name)):
            if name not in _NOT_STATE:
                yield name, attributes[name]

    def _flatten(self, value: object, flat: list[Any], places: dict[int, int]) -> None:
        if isinstance(value, np.ndarray | np.generic):
            value = value.tolist()
        if value is None or isinstance(value, bool | int | float | str):
            flat.append(value)
        elif type(value) is self.wall:  # most cells, and nothing moves them
            flat.append(value.color)
        elif isinstance(value, tuple | list):  # MiniGrid writes positions as either
            flat.append(("list", len(value)))
            for item in value:
                self._flatten(item, flat, places)
        elif isinstance(value, dict):
            flat.append(("dict", len(value)))
            for name, item in value.items():
                self._flatten(name, flat, places)
                self._flatten(item, flat, places)
        elif value is self.env or callable(value) or isinstance(value, self.fixed_types):
            flat.append(type(value).__name__)
        elif id(value) in places:
            flat.append(("again", places[id(value)]))
        elif hasattr(value, "__dict__"):  # grids, rooms, doors, keys, ...
            places[id(value)] = len(places)
            flat.append(type(value).__name__)
            self._flatten(vars(value), flat, places)
        else:
            raise RuleError(f"{self.name}: keeps a {type(value).__name__}, which cannot be told apart from others")
