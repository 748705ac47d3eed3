"""State spaces on disk: a folder, read through memory maps. docs/format.md specifies it to the byte."""

import itertools
import math
import os
from collections.abc import Sequence
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xxhash

from pharos.environments import Environment, State, as_tuples, class_called
from pharos.errors import (
    ParameterError,
    StateSpaceCorrupted,
    StateSpaceError,
    StateSpaceIncomplete,
    StateSpaceMismatch,
)
from pharos.rules import Layout, pack_states, rules_of, unpack_states
from pharos.state_space.manifest import (
    BUILD_AGAIN,
    CHECKSUM_BYTES,
    MANIFEST,
    STATES,
    TERMINAL,
    Plan,
    has_chance,
    read_manifest,
    successors_name,
)
from pharos.state_space.stored import (
    byte_blocks,
    check_components,
    check_files,
    check_outcome_rules,
    check_outcomes,
    check_rules,
    check_states,
    check_successors,
    file_parts,
    mapped,
    outcomes_to_check,
    states_to_check,
    stored_outcomes,
)
from pharos.system.arrays import Indices, OutcomeRows, dtype_of, from_stored

if TYPE_CHECKING:
    from pharos.mdp import Dynamics, TabularMDP

MOST_QUOTED = 500  # characters of what a manifest says, in a message
_AGE_BLOCK = 1 << 16  # states whose ages are asked for at a time


# States whose sets of actions are worked out in one go.
ROWS_OF_SETS = 1 << 16


class StateSpace:
    """The reachable states of an environment and their transitions, S states and A actions.

    States are numbered in the order in which breadth-first search finds them: start states first.

    Attributes:
        environment: the environment, with its parameters. None for a folder whose class pharos does not know.
        folder: of the files.
        num_states, num_actions, num_terminal_states, depth: S, A, terminal states, largest distance from the start
            states.
        has_chance: whether actions have several outcomes, which `outcomes` has in place of `successors`.
        successors: (S, A) int32 (`PackedIndices` beyond 2^31 states), index of the next state. Terminal states lead to
            themselves.
        packed_states: (S, W) uint64, see docs/format.md.
        start_states, start_probabilities: indices and probabilities of the start states.
    """

    def __init__(self, folder: Path, manifest: dict[str, Any], environment: Environment | None):
        self.folder = folder
        self.manifest = manifest
        self.environment = environment
        self.num_states: int = manifest["num_states"]
        self.num_actions: int = manifest["num_actions"]
        self.num_terminal_states: int = manifest["num_terminal_states"]
        self.depth: int = manifest["depth"]
        self.has_chance: bool = has_chance(manifest)
        self.parameters: dict[str, Any] = manifest["parameters"]
        self.start_states = np.array([index for index, _ in manifest["initial"]], np.int64)
        self.start_probabilities = np.array([probability for _, probability in manifest["initial"]], np.float64)

    @cached_property
    def packed_states(self) -> np.ndarray:
        """Packed states (S, W) uint64, a read-only memory map.

        Raises:
            StateSpaceCorrupted: a component of a state is out of its range. The first access looks at all of them.
        """
        check_states(self.folder / STATES, self.layout, self._stored_states)
        return self._stored_states

    @cached_property
    def successors(self) -> Indices:
        """Next states (S, A) int32, or, beyond 2^31 states, `PackedIndices` of five bytes each, in a read-only memory
        map.

        Raises:
            StateSpaceCorrupted: one is no state, or a terminal state does not lead to itself. The first access looks at
                all.
            StateSpaceError: actions have several outcomes.
        """
        path = self.folder / successors_name(self.manifest["arrays"])
        check_successors(path, self._stored_successors, self.terminal_bits, self.num_terminal_states)
        return self._stored_successors

    @cached_property
    def outcomes(self) -> OutcomeRows:
        """Outcomes of each action, if it has several, in the form of the files, which `dynamics` hides.

        Raises:
            StateSpaceCorrupted: an index is no state, probabilities do not sum to 1, or rows or codes are out of range.
                The first access looks at all of them.
            StateSpaceError: actions have one outcome each.
        """
        check_outcomes(self.folder, self.manifest, self._stored_outcomes, self.terminal_bits)
        return self._stored_outcomes

    @cached_property
    def dynamics(self) -> "Dynamics":
        """Transitions, with one interface whether there is chance or not."""
        from pharos.mdp import OutcomeTable, Table

        if not self.has_chance:
            return Table(self.successors)
        return OutcomeTable(num_actions=self.num_actions, **self.outcomes.by_name)

    @cached_property
    def ages(self) -> np.ndarray:
        """Ages (S,) int64 of the states, in memory.

        Raises:
            StateSpaceError: the class declares no age.
        Cost: some 10 ns a state if Numba compiles the rule.
        """
        if self.environment is None or not self.environment.has_age:
            raise StateSpaceError(f"{self}: {self.manifest['environment']} declares no age of states")
        ages = np.empty(self.num_states, np.int64)
        rule = rules_of(self.environment).ages
        for start in range(0, self.num_states, _AGE_BLOCK):
            stop = min(start + _AGE_BLOCK, self.num_states)
            ages[start:stop] = rule.block(self.packed_states, start, stop)
        ages.flags.writeable = False
        return ages

    @cached_property
    def _stored_outcomes(self) -> OutcomeRows:
        if not self.has_chance:
            raise StateSpaceError(f"{self}: each action has one outcome, in `successors`; there are no `outcomes`")
        return stored_outcomes(self.folder, self.manifest)

    @cached_property
    def _stored_states(self) -> np.ndarray:
        return self._map(STATES, "<u8", (self.num_states, self.layout.num_words))

    @cached_property
    def _stored_successors(self) -> Indices:
        if self.has_chance:
            raise StateSpaceError(f"{self}: actions have several outcomes, in `outcomes`; there are no `successors`")
        name = successors_name(self.manifest["arrays"])
        shape = (self.num_states, self.num_actions)
        return from_stored(self._map(name, dtype_of(self.manifest["arrays"][name]["dtype"]), shape))

    @cached_property
    def terminal_bits(self) -> np.ndarray:
        """Terminal bits (ceil(S / 8),) uint8, a read-only memory map.

        State i is terminal if bit i % 8 of byte i // 8 is set.
        """
        return self._map(TERMINAL, "|u1", (-(-self.num_states // 8),))

    @cached_property
    def terminal(self) -> np.ndarray:
        """Whether each state is terminal, (S,) bool, in memory."""
        terminal = np.unpackbits(self.terminal_bits, count=self.num_states, bitorder="little").view(np.bool_)
        terminal.flags.writeable = False
        return terminal

    @cached_property
    def layout(self) -> Layout:
        """Place of each component of a state in its words."""
        table = self.manifest["layout"]
        return Layout(
            word=np.array(table["word"], np.uint64),
            shift=np.array(table["shift"], np.uint64),
            mask=np.array([(1 << bits) - 1 for bits in table["bits"]], np.uint64),
            low=np.array(table["low"], np.int64),
            size=np.array(table["size"], np.int64),
            num_words=table["num_words"],
        )

    @property
    def component_names(self) -> tuple[str, ...]:
        """Names of the D components of a state."""
        return tuple(self.manifest["layout"]["names"])

    def states(self, indices: "slice | Sequence[int] | np.ndarray" = slice(None)) -> np.ndarray:
        """States (N, D) int64 with these indices (an array of integers or a slice)."""
        return unpack_states(self.layout, np.atleast_2d(self.packed_states[indices]))

    def column(self, variable: int, block: slice = slice(None)) -> np.ndarray:
        """(N,) int64, the values of one component in a block of states."""
        layout = self.layout
        words = self.packed_states[block, int(layout.word[variable])]
        return ((words >> layout.shift[variable]) & layout.mask[variable]).astype(np.int64) + layout.low[variable]

    def state(self, i: int) -> State:
        """State number i, as a tuple of D integers."""
        self._check_index(i)
        return tuple(int(value) for value in self.states(np.array([i]))[0])

    def is_terminal(self, i: int) -> bool:
        """Whether state number i is terminal."""
        self._check_index(i)
        return bool(self.terminal_bits[i // 8] >> (i % 8) & 1)

    def index(self, state: Sequence[int]) -> int:
        """The number of a state. ParameterError if it is not reachable.

        The first call indexes all states, in O(S).
        """
        return int(self.indices(np.array([tuple(state)]))[0])

    def indices(self, states: np.ndarray) -> np.ndarray:
        """Numbers (N,) int64 of states (N, D). ParameterError if one is not reachable."""
        from pharos.kernels.hash_table import find_states

        states = np.asarray(states)
        if states.ndim != 2 or states.shape[1] != len(self.component_names):
            raise ParameterError(
                f"{self}: a state has {len(self.component_names)} components; found an array of shape {states.shape}"
            )
        if states.dtype.kind not in "iub":
            raise ParameterError(f"{self}: a state consists of integers; found {states.dtype}")
        out = np.empty(len(states), np.int64)
        inside = (states >= self.layout.low) & (states < self.layout.low + self.layout.size)
        keys = pack_states(self.layout, np.where(inside, states, self.layout.low))
        find_states(self._table, self.packed_states, keys, out)
        wrong = np.flatnonzero((out < 0) | ~inside.all(axis=1))
        if wrong.size:
            raise ParameterError(
                f"{self}: state {tuple(int(v) for v in states[wrong[0]])} is not reachable from the start"
            )
        return out

    @cached_property
    def _table(self) -> np.ndarray:
        from pharos.kernels.hash_table import fill

        slots = max(65536, -(-int(self.num_states / 0.6) // 65536) * 65536)
        table = np.full(slots, -1, np.int32 if self.num_states < 2**31 else np.int64)
        fill(table, self.packed_states, self.num_states)
        return table

    def mdp(
        self,
        gamma: float = 0.99,
        rewards: Any = None,
        *,
        by_range: bool = False,
    ) -> "TabularMDP":
        """The tabular MDP on these states.

        Args:
            gamma: discount, in [0, 1].
            rewards: None for the environment's own, computed from the stored transitions, an (S, A) array, or a
                function reward(self, state, action, next_state) in place of the environment's.
            by_range: compute the environment's own rewards when they are asked for, so that a rank of many computes
                the rewards of its range alone.
        If the class declares an age, the MDP has it, so that values are solved in one backward pass.
        Raises:
            ParameterError: a transition leads to a state that is not older, or a state that is not terminal has no
                available action.
        Cost: the rewards of all S A transitions, 20 to 50 ns each on one core. Nothing is built again.
        """
        from pharos.mdp import (
            Residual,
            TabularMDP,
            filled,
            ranged_rewards,
            rewards_of_space,
            rewards_of_staying,
            with_sets,
        )

        by_rules = rewards is None or callable(rewards)
        staying = partial(rewards_of_staying, self, rewards) if by_rules else None
        is_ranged = by_range and rewards is None and self.environment is not None
        if not by_rules and self.available is not None:
            rewards = filled(np.asarray(rewards, np.float64), self.available)
        table = ranged_rewards(self) if is_ranged else rewards_of_space(self, rewards)
        mdp = TabularMDP(
            self.dynamics,
            table,
            self.terminal,
            gamma,
            None,
            self.start_states,
            self.start_probabilities,
            folder=self.folder,
            staying=staying,
            space=self,
            residual=Residual() if self.environment is None else Residual(*self.environment.residual),
        )
        mdp = with_sets(mdp, self.available)
        has_age = self.environment is not None and self.environment.has_age
        return mdp.with_age(self.ages) if has_age else mdp

    @cached_property
    def available(self) -> np.ndarray | None:
        """(S, A) bool, the actions that exist in each state. None if all do everywhere.

        Cost: the rule `is_available` for each state and action.
        """
        if self.environment is None or not self.environment.has_sets:
            return None
        rules, sets = rules_of(self.environment), np.empty((self.num_states, self.num_actions), np.bool_)
        for start in range(0, self.num_states, ROWS_OF_SETS):
            numbers = np.arange(start, min(start + ROWS_OF_SETS, self.num_states))
            sets[numbers] = rules.available(self.states(numbers))
        return None if sets.all() else sets

    def verify(self) -> None:
        """Read every file once and compare it with its checksums. StateSpaceCorrupted if one differs."""
        for name, entry in self.manifest["arrays"].items():
            blocks = byte_blocks(file_parts(self.folder, self.manifest, name), CHECKSUM_BYTES)
            for number, (expected, block) in enumerate(
                itertools.zip_longest(entry["checksums"], blocks, fillvalue=b"")
            ):
                if xxhash.xxh3_128_hexdigest(block) != expected:
                    raise StateSpaceCorrupted(
                        f"{self.folder / name}: block {number} (bytes {number * CHECKSUM_BYTES} on) does not match "
                        f"its checksum: the file was changed after it was written; {BUILD_AGAIN}"
                    )

    def _map(self, name: str, dtype: str | np.dtype, shape: tuple[int, ...]) -> np.ndarray:
        return mapped(file_parts(self.folder, self.manifest, name), dtype)[: math.prod(shape)].reshape(shape)

    def _check_index(self, i: int) -> None:
        if not 0 <= i < self.num_states:
            raise ParameterError(f"{self}: state number {i} does not exist; expected 0 to {self.num_states - 1}")

    def __repr__(self) -> str:
        what = self.environment or f"{self.manifest['environment']} {self.parameters}"
        return f"StateSpace({what}, num_states={self.num_states})"


def load(folder: str | os.PathLike, *, verify: bool = True, environment: Environment | None = None) -> StateSpace:
    """Open a state space that `build` wrote.

    Args:
        folder: of the state space.
        verify: compare every file with its checksums (one read of the files, several GB/s). False trusts their lengths.
        environment: of the state space. Default: what the manifest says, if pharos knows its class.
    Raises:
        StateSpaceError: there is no state space. StateSpaceIncomplete: its build did not finish. StateSpaceCorrupted: a
            file is missing, truncated or changed. StateSpaceMismatch: the rules of the environment are not those it was
        built with.
    """
    folder = Path(folder)
    manifest = read_manifest(folder)
    if manifest is None:
        raise StateSpaceError(
            f"{folder}: no state space there (no {MANIFEST}); build one with pharos.build or `pharos build`"
        )
    if not manifest["complete"]:
        raise StateSpaceIncomplete(
            f"{folder}: the build stopped at {manifest['num_states']} states; the same build command resumes it"
        )
    check_files(folder, manifest)
    space = StateSpace(folder, manifest, environment or _environment_of(folder, manifest))
    if verify:
        space.verify()
    if space.environment is not None:
        check_components(folder, space.environment, manifest)
        if space.has_chance:
            _check_outcome_rules(space, space.environment)
        else:
            stored = space._stored_states, space._stored_successors, space.terminal_bits
            check_rules(folder, space.environment, space.layout, *stored)
    return space


def _check_outcome_rules(space: StateSpace, env: Environment) -> None:
    """Raise StateSpaceMismatch if the rules of `env` disagree with the stored outcomes of 64 states."""
    states = states_to_check(space.num_states)
    outcomes = outcomes_to_check(space.folder, space.manifest, space._stored_outcomes, states)
    all_states = np.concatenate([states, *(successors for each in outcomes.values() for successors, _ in each)])
    check_states(space.folder / STATES, space.layout, space._stored_states[all_states])
    check_outcome_rules(space.folder, env, space.layout, space._stored_states, outcomes, space.terminal_bits)


def _environment_of(folder: Path, manifest: dict[str, Any]) -> Environment | None:
    """The environment that a manifest names, if its class is a built-in or registered one."""
    cls = class_called(manifest["environment"])
    if cls is None:
        return None
    try:
        env = cls(**{name: as_tuples(value) for name, value in manifest["parameters"].items()})
        identity = Plan(env).identity
    except Exception as error:  # whatever a class does with parameters that are none of its own
        raise StateSpaceMismatch(
            f"{folder}: its parameters are not those of this pharos' {manifest['environment']}: "
            f"{' '.join(str(error).split())[:MOST_QUOTED]}; build again"
        ) from error
    for key in ("rules_version", "parameters", "actions", "outcomes", "layout", "start"):
        if identity.get(key) != manifest.get(key):
            raise StateSpaceMismatch(
                f"{folder}: {key} of {env.name} is {str(manifest.get(key))[:MOST_QUOTED]} in the folder and "
                f"{identity.get(key)} in this pharos; build again"
            )
    return env
