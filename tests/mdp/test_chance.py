"""Chance in the rules: what is built of a class with outcomes, against a plain enumeration and against matrices."""

import importlib
from dataclasses import dataclass, replace

import numpy as np
import pytest

import pharos
from naive import builder as naive_builder
from pharos.errors import RuleError, StateSpaceError, StateSpaceTooLarge
from pharos.plots import states_by_depth
from strategies import examples
from worlds import ChanceWorld, Row, chance_worlds

search = importlib.import_module("pharos.state_space.search")
table = importlib.import_module("pharos.state_space.table")
rules = importlib.import_module("pharos.rules.rules")
stepping = importlib.import_module("pharos.rules.stepping")


def build(env, folder, **options) -> pharos.StateSpace:
    return pharos.build(env, folder, progress=False, **options)


def matrices_of(env) -> tuple[naive_builder.NaiveOutcomes, np.ndarray, np.ndarray]:
    """The twin, and its probabilities (S, A, S) and expected rewards (S, A)."""
    twin = naive_builder.build_outcomes(env)
    size = len(twin.states)
    P, R = np.zeros((size, env.num_actions, size)), np.zeros((size, env.num_actions))
    for s, state in enumerate(twin.states):
        for a in range(env.num_actions):
            for following, probability in twin.outcomes[s][a]:
                P[s, a, following] += probability
                if not twin.terminal[s]:
                    R[s, a] += probability * env.reward(state, a, twin.states[following])
    return twin, P, R


def assert_agrees(space: pharos.StateSpace, env) -> None:
    twin, P, R = matrices_of(env)
    assert [tuple(state) for state in space.states().tolist()] == twin.states
    assert (space.terminal == twin.terminal).all()
    assert space.depth == max(twin.levels)
    stored = space.outcomes.of_states(np.arange(space.num_states), env.num_actions)
    for s, rows in enumerate(twin.outcomes):
        for (successors, probabilities), expected in zip(stored[s], rows, strict=True):
            assert list(zip(successors.tolist(), probabilities.tolist(), strict=True)) == expected
    mdp = space.mdp(gamma=0.9)
    np.testing.assert_allclose(mdp.dynamics.matrix().toarray()[:, :-1], P.reshape(-1, len(P)), rtol=0, atol=1e-15)
    np.testing.assert_allclose(mdp.rewards, R, rtol=1e-12, atol=1e-12)


@pytest.mark.long
@examples(25, env=chance_worlds())
def test_build_agrees_with_a_plain_enumeration_on_random_worlds(env, tmp_path_factory):
    assert_agrees(build(env, tmp_path_factory.mktemp("space") / "space"), env)


# Every engine, thread and block gives the same files -----------------------------------------------------------------

WORLD = ChanceWorld(num_positions=3000, seed=1, vectors=0, end_share=0.05)


def files_of(folder) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory) -> dict[str, bytes]:
    return files_of(build(WORLD, tmp_path_factory.mktemp("undisturbed") / "space", workers=1).folder)


@pytest.fixture
def small_blocks(monkeypatch):
    monkeypatch.setattr(search, "CHUNK", 256)
    monkeypatch.setattr(search, "WIDE_FOR_THREADS", 50)


@pytest.mark.long
def test_files_do_not_depend_on_threads_or_blocks(tmp_path, undisturbed, small_blocks):
    folder = build(WORLD, tmp_path / "space", workers=3, checkpoint_seconds=0.0).folder
    assert files_of(folder) == undisturbed


@pytest.mark.long
def test_files_do_not_depend_on_where_the_table_is(tmp_path, undisturbed, small_blocks, monkeypatch):
    monkeypatch.setattr(table.MemoryTable, "fits", lambda *_: False)
    folder = build(WORLD, tmp_path / "space", workers=2, checkpoint_seconds=0.0).folder
    assert files_of(folder) == undisturbed


@pytest.mark.long
def test_files_do_not_depend_on_the_engine(tmp_path, undisturbed, monkeypatch):
    monkeypatch.setattr(rules, "compiled_or_none", lambda *_: None)
    space = build(WORLD, tmp_path / "space", workers=2)
    assert files_of(space.folder) == undisturbed
    interpreted = space.mdp().rewards
    monkeypatch.undo()
    assert (space.mdp().rewards == interpreted).all()


# Drawing outcomes -----------------------------------------------------------------------------------------------------


@pytest.mark.long
def test_compiled_and_interpreted_outcomes_are_drawn_alike_and_as_often_as_they_should():
    env = ChanceWorld(num_positions=40, seed=5)
    compiled, interpreted = rules.rules_of(env).stepping, stepping.InterpretedStepping(env)
    assert compiled.is_compiled
    numbers = np.random.default_rng(0).random(2000)
    for position in range(3):
        state = np.array([position])
        drawn = [compiled.outcome_one(compiled.parameters, state, 1, u) for u in numbers]
        assert drawn == [interpreted.outcome_one(None, state, 1, u) for u in numbers]
        for outcome, probability in enumerate(env.likely[position, 1]):
            share = np.mean([each == outcome for each, _ in drawn])
            assert abs(share - probability) <= 4 * (probability * (1 - probability) / 2000) ** 0.5
            assert all(likely == probability for each, likely in drawn if each == outcome)
    assert compiled.outcome_one(compiled.parameters, np.array([0]), 0, 1 - 2**-53)[1] > 0


@pytest.mark.long
def test_many_environments_draw_outcomes_compiled_as_interpreted():
    env = ChanceWorld(num_positions=40, seed=5)
    ranges = np.stack([env.components.low, env.components.high])
    starts = np.array([state for state, _ in env.initial_states()])
    setting = (ranges, np.zeros(0), (0.7, 0.2, 0.1, 0.8, 0.0), 50, 0, -1, starts, np.ones(1))
    visited = []
    for engine in (rules.rules_of(env).stepping, stepping.InterpretedStepping(env)):
        rng, integers = np.arange(8, dtype=np.uint64), [np.zeros(8, np.int64) for _ in range(3)]
        states, flags = np.repeat(starts[:1], 8, axis=0), [np.zeros(8, bool) for _ in range(3)]
        actions, previous, elapsed = integers[0], np.full(8, -1), integers[1]
        rewards, executed, final = np.zeros(8), integers[2], np.zeros((8, 1), np.int64)
        ended, terminated, truncated = flags
        batch = (rng, actions, states, previous, elapsed, ended, rewards, terminated, truncated, executed, final)
        batch = (*batch, np.zeros((0, 1), np.float32), np.zeros(8))
        found = []
        for step in range(60):
            actions[:] = step % 2
            assert engine.step_many(engine.parameters, setting, batch, 0, 8) == -1
            found.append((states.copy(), rewards.copy(), terminated.copy(), executed.copy()))
        visited.append(found)
    for one, other in zip(*visited, strict=True):
        for a, b in zip(one, other, strict=True):
            np.testing.assert_array_equal(a, b)


# Rules that break their contract while they are built ----------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Dice(Row):
    """Add what a die of three sides shows, until 30. Broken from position 12 on, where `broken` says so."""

    length: int = 33
    broken: int = 0

    name, variable = "dice", "total"
    actions = ("roll", "pass")
    outcomes = 3
    SUM, NEGATIVE, NONE, RANGE, AGE = range(1, 6)

    def probability(self, state, action, outcome):
        wrong = self.broken if state[0] >= 12 else 0
        if wrong == self.NONE and outcome == 1:
            return float("nan")
        if wrong == self.NEGATIVE:
            return 1.5 if outcome == 0 else -0.25
        return 0.5 if outcome == 0 else 0.25 + (0.01 if wrong == self.SUM else 0.0)

    def transition(self, state, action, outcome, out):
        wrong = self.broken if state[0] >= 12 else 0
        out[0] = state[0] + 1 + outcome
        if wrong == self.RANGE and outcome == 2:
            out[0] = 33 + action
        if wrong == self.AGE and outcome == 1:
            out[0] = state[0]

    def is_terminal(self, state):
        return state[0] >= 30

    def reward(self, state, action, next_state):
        return float(next_state[0] == 30)

    def age(self, state):
        return state[0] - 5


WRONG = (
    (Dice.SUM, "the probabilities of outcomes 0 to 2 of action 'roll' in state (12,) sum to 1.02; expected 1"),
    (Dice.NEGATIVE, "probability of outcome 0 of action 'roll' in state (12,) is 1.5; expected a number from 0 to 1"),
    (Dice.NONE, "probability of outcome 1 of action 'roll' in state (12,) is nan; expected a number from 0 to 1"),
    (Dice.RANGE, "outcome 2 of action 'roll' in state (12,) leads to total = 33; declared: 0 to 32"),
    (Dice.AGE, "outcome 1 of action 'roll' leads from state (12,) of age 7 to state (12,) of age 7; expected a larger"),
)


@pytest.mark.parametrize("engine", ("compiled", "threads", "interpreted"))
@pytest.mark.parametrize(("broken", "expected"), WRONG)
def test_a_rule_that_breaks_the_contract_is_named_with_its_outcome(broken, expected, engine, tmp_path, monkeypatch):
    if engine == "threads":
        monkeypatch.setattr(search, "WIDE_FOR_THREADS", 1)
    elif engine != "compiled":
        monkeypatch.setattr(rules, "compiled_or_none", lambda *_: None)
    env = Dice(broken=broken)
    with pytest.raises(RuleError) as error:
        build(env, tmp_path / "space", workers=2)
    assert str(error.value).startswith(f"{env}: {expected}") and "\n" not in str(error.value)
    assert pharos.state_space.read_manifest(tmp_path / "space")["complete"] is False  # what was found is kept


@pytest.mark.long
def test_growth_counts_states_by_their_distance(tmp_path):
    for env in (WORLD, pharos.make("simple_grid")):
        space = build(env, tmp_path / env.name)
        twin = naive_builder.build_outcomes(env)
        assert states_by_depth(space).tolist() == np.bincount(twin.levels).tolist()


@pytest.mark.long
def test_the_arrays_that_a_space_does_not_have_are_refused_in_one_line(tmp_path):
    lake, grid = (build(pharos.make(name), tmp_path / name) for name in ("frozen_lake", "simple_grid"))
    slippery = build(pharos.make("frozen_lake", slippery=True), tmp_path / "slippery")
    assert (lake.has_chance, slippery.has_chance) == (False, True)
    with pytest.raises(StateSpaceError, match="several outcomes, in `outcomes`; there are no `successors`"):
        slippery.successors  # noqa: B018
    with pytest.raises(StateSpaceError, match="each action has one outcome, in `successors`; there are no `outcomes`"):
        grid.outcomes  # noqa: B018


@pytest.mark.long
def test_ages_are_those_of_the_rule(tmp_path, monkeypatch):
    space = build(Dice(), tmp_path / "space")
    assert (space.ages == space.states()[:, 0] - 5).all()
    assert (space.mdp().age == space.ages).all()
    monkeypatch.setattr(rules, "compiled_or_none", lambda *_: None)
    again = pharos.load(tmp_path / "space", environment=Dice())
    assert (again.ages == space.ages).all()
    with pytest.raises(StateSpaceError, match="frozen_lake declares no age"):
        build(pharos.make("frozen_lake/4x4"), tmp_path / "lake").ages  # noqa: B018


@pytest.mark.long
def test_the_mdp_of_a_class_with_an_age_is_solved_in_one_pass(tmp_path):
    space = build(Dice(), tmp_path / "space")
    mdp = space.mdp(gamma=0.9)
    assert (mdp.age == space.ages).all()
    found, swept = (pharos.value_iteration(each, 1e-9) for each in (mdp, replace(mdp, age=None)))
    assert found.sweeps == 1
    assert np.abs(found.v - swept.v).max() <= found.error_bound + swept.error_bound
    assert build(pharos.make("frozen_lake/4x4"), tmp_path / "lake").mdp().age is None


@pytest.mark.long
def test_an_age_without_chance_is_checked_too(tmp_path):
    @dataclass(frozen=True, kw_only=True)
    class Steps(Row):
        length: int = 100
        back: bool = False
        name = variable = "steps"
        actions = ("on", "on_too")

        def transition(self, state, action, out):
            out[0] = 3 if self.back and state[0] == 50 and action == 1 else state[0] + 1 + action

        def is_terminal(self, state):
            return state[0] >= 97

        def reward(self, state, action, next_state):
            return 1.0

        def age(self, state):
            return state[0]

    space = build(Steps(), tmp_path / "space")
    assert space.manifest["format_version"] == 1 and (space.ages == space.states()[:, 0]).all()
    with pytest.raises(RuleError, match=r"action 'on_too' leads from state \(50,\) of age 50 to state \(3,\) of age 3"):
        build(Steps(back=True), tmp_path / "back")


@pytest.mark.long
@pytest.mark.parametrize("workers", [1, 3])
def test_a_build_forgets_states_that_are_younger_than_all_that_wait(workers, tmp_path, monkeypatch, small_blocks):
    """2048 on 2 x 3, 21,752 states: the same files from a table with room for a fifth of them, after a stop as well."""
    env, tables = pharos.make("game_2048/2x3"), []
    expected = files_of(build(env, tmp_path / "whole", workers=1).folder)

    def slots_for(self, count):
        return 1 << max(8, int((1.4 * count + self._margin) / table.LOAD - 1).bit_length())

    def grow(self, *arguments, plain=table.MemoryTable.grow):
        plain(self, *arguments)
        tables.append(len(self.slots))

    monkeypatch.setattr(table.MemoryTable, "_slots_for", slots_for)
    monkeypatch.setattr(table.MemoryTable, "grow", grow)
    monkeypatch.setattr(search, "WORTH_FORGETTING", 0)
    monkeypatch.setattr(search, "FORGETTING_BLOCK", 1000)
    with pytest.raises(StateSpaceTooLarge):
        build(env, tmp_path / "stopped", workers=workers, max_states=9000)
    for folder in ("stopped", "at once"):
        assert files_of(build(env, tmp_path / folder, workers=workers).folder) == expected
    assert max(tables) <= 8192
