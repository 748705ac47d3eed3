"""importers.jax_stepping: functions of JAX are the MDPs that they say. Skipped where JAX is not installed."""

import sys
from fractions import Fraction
from pathlib import Path

import gymnasium
import numpy as np
import planted
import pytest

from pharos import bisimulation, importers, value_iteration
from pharos.errors import MissingExtra, ParameterError, RuleError, StateSpaceTooLarge, UnknownName
from pharos.importers.step_target import GymnasiumEnvironment, StepTarget

HERE = Path(__file__)


def test_without_jax_it_says_which_extra_brings_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "jax", None)
    with pytest.raises(MissingExtra, match=r"needs jax.*\[jax\]"):
        importers.jax_stepping(step, reset, 2)


def test_functions_of_jax_without_their_prefix_are_refused():
    with pytest.raises(ParameterError, match=r"functions of JAX; expected jax: before what makes them"):
        importers.stepping(lambda: importers.JaxFunctions(step, reset, 2))


@pytest.fixture
def jax():
    return pytest.importorskip("jax")


def reset(key):
    """A corridor of five cells, and a clock: the second cell."""
    import jax.numpy as jnp

    return jnp.int32(1), {"cell": jnp.int32(1), "steps": 0}


def step(key, state, action):
    """Slips with probability 0.25. Ends, and pays 1, on the right."""
    import jax
    import jax.numpy as jnp

    moves = jnp.where(jax.random.uniform(key) < 0.25, 0, 2 * action - 1)
    cell = jnp.clip(state["cell"] + moves, 0, 4)
    return cell, {"cell": cell, "steps": state["steps"] + 1}, (cell == 4).astype(float), cell == 4


def corridor():
    return importers.JaxFunctions(step, reset, 2, name="corridor", time_limit=50)


def stepped(step=step, reset=reset, actions=2, **options):
    return importers.jax_stepping(step, reset, actions, **{"ignore": ["steps"], **options})


def distribution(jax, draw):
    """{outcome: probability} of a function of a key, by `jax_chance`."""
    from pharos.importers.jax_chance import TracedFunction

    traced, shares = TracedFunction("draw()", draw, (), 3_000), {}
    for tape, weight in zip(traced.tapes, traced.weights, strict=True):
        result, chances = traced.run(tape)
        outcome = tuple(np.ravel(result).tolist())
        shares[outcome] = shares.get(outcome, 0) + weight * Fraction(float(np.prod(chances)))
    return shares


def test_draws_are_those_of_jax(jax):
    third, half = Fraction(1, 3), Fraction(1, 2)
    random, jnp = jax.random, jax.numpy
    assert distribution(jax, lambda key: random.bernoulli(key, 0.25)) == {(True,): half / 2, (False,): 3 * half / 2}
    assert distribution(jax, lambda key: random.randint(key, (2,), 1, 4)) == {
        (a, b): third**2 for a in (1, 2, 3) for b in (1, 2, 3)
    }
    p = np.array([0.5, 0.0, 0.25, 0.25])
    assert distribution(jax, lambda key: random.choice(key, jnp.arange(4) * 10, p=p)) == {
        (0,): half,
        (20,): half / 2,
        (30,): half / 2,
    }
    assert distribution(jax, lambda key: random.categorical(key, np.log([0.5, 0.5]))) == {(0,): half, (1,): half}
    assert distribution(jax, lambda key: random.permutation(key, 3))[2, 0, 1] == third / 2
    assert len(distribution(jax, lambda key: random.choice(key, 4, (2,), replace=False))) == 12
    assert distribution(jax, lambda key: random.bernoulli(key, shape=(0,))) == {(): 1}
    assert distribution(jax, lambda key: random.uniform(key, (2,), minval=-1.0) > 0.5)[True, False] == 3 * half / 8
    assert distribution(jax, lambda key: random.bernoulli(key, jnp.float32(0.25) * 1)) == {
        (True,): half / 2,
        (False,): 3 * half / 2,
    }


def test_draws_in_branches_loops_and_compiled_functions_are_followed(jax):
    random, half = jax.random, Fraction(1, 2)
    compiled = jax.jit(lambda key: random.bernoulli(key))
    compiled(random.key(0))

    def scan(key):
        return jax.lax.scan(lambda total, one: (total + random.randint(one, (), 0, 2), None), 0, random.split(key, 2))[
            0
        ]

    def branch(key):
        one, other = random.split(key)
        return jax.lax.cond(random.bernoulli(one), lambda: random.randint(other, (), 1, 3), lambda: 0)

    assert distribution(jax, compiled) == {(True,): half, (False,): half}
    assert distribution(jax, scan) == {(0,): half / 2, (1,): half, (2,): half / 2}
    assert distribution(jax, branch) == {(0,): half, (1,): half / 2, (2,): half / 2}
    assert distribution(jax, lambda _: random.bernoulli(random.key(0), shape=(3,))) == {
        tuple(np.asarray(random.bernoulli(random.key(0), shape=(3,))).tolist()): 1
    }


REFUSED = {
    "normal": (lambda jax, key: jax.random.normal(key), r"drew normal\(\) \(test_jax_stepping\.py, line \d+\)"),
    "number": (lambda jax, key: jax.random.uniform(key) * 2, "the number itself and not a comparison"),
    "twice": (lambda jax, key: (lambda u: (u < 0.5) & (u < 0.2))(jax.random.uniform(key)), "compared once"),
    "vmap": (
        lambda jax, key: jax.vmap(jax.random.bernoulli)(jax.random.split(key, 2)),
        r"drew bernoulli\(\).*jax\.vmap",
    ),
    "many": (
        lambda jax, key: jax.random.randint(key, (8,), 0, 5),
        r"more than 3,000 outcomes \(randint\(\) \(.*\): one of 5, 8 times\)",
    ),
    "shuffle": (lambda jax, key: jax.random.permutation(key, 10), "3,628,800 outcomes"),
    "loop": (
        lambda jax, key: jax.lax.while_loop(
            lambda n: n < 3, lambda n: n + jax.random.randint(key, (), 0, 2), jax.random.randint(key, (), 0, 2)
        ),
        "a loop whose length depends on the state",
    ),
    "elsewhere": (lambda jax, key: jax._src.random.bits(key), "other ways than the functions of jax.random"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_refused_in_one_line(jax, name):
    draw, message = REFUSED[name]

    def drawing(key, state, action):
        return state["cell"], state, draw(jax, key).sum() * 0.0, False

    with pytest.raises(RuleError, match=message) as caught:
        stepped(drawing)
    assert "\n" not in str(caught.value)


@pytest.mark.slow
def test_the_corridor_is_that_of_gymnasium_stepped(jax):
    mdp, recording = stepped(gamma=0.9)
    twin, _ = importers.stepping(planted.Slips, gamma=0.9, check=False)
    assert recording.observations.ravel().tolist() == [1, 0, 2, 3]
    assert (mdp.dynamics.matrix() != twin.dynamics.matrix()).nnz == 0
    assert np.array_equal(mdp.rewards, twin.rewards)
    assert mdp.start_states.tolist() == twin.start_states.tolist()


@pytest.mark.slow
def test_counters_are_named_and_what_matters_is_not_ignored(jax):
    mdp, recording = stepped(ignore=(), horizon=4)
    assert [note for note in recording.notes if note.startswith("steps equals the number of steps")]
    assert mdp.num_states > 5

    def pays_late(key, state, action):
        seen, state, _, ended = step(key, state, action)
        return seen, state, (state["steps"] == 3).astype(float), ended

    with pytest.raises(RuleError, match=r"behave differently \(action \d.*: reward 0 and 1\)"):
        stepped(pays_late)
    from pharos.importers.jax_stepping import jax_source
    from pharos.importers.stepping import SteppingOptions, SteppingRun

    late = importers.JaxFunctions(pays_late, reset, 2, counters=("steps",))
    mdp, _ = SteppingRun(lambda: late, SteppingOptions(), horizon=5, source_of=jax_source).finish(None)
    assert value_iteration(mdp).value_at_start == 1.0 and mdp.num_states > 5
    with pytest.raises(UnknownName, match="'stepz'"):
        stepped(ignore=["stepz"])
    with pytest.raises(StateSpaceTooLarge, match="more than 9 states"):
        stepped(ignore=(), max_states=9)


@pytest.mark.slow
def test_probabilities_that_depend_on_the_state_and_starts_that_are_drawn(jax):
    def starts(key):
        cell = jax.random.choice(key, 4)
        return cell, {"cell": cell, "steps": 0}

    def weighted(key, state, action):
        weights = jax.numpy.arange(5) <= state["cell"]
        cell = jax.random.choice(key, 5, p=weights.astype(float))
        return cell, {"cell": cell, "steps": 0}, 0.0, False

    mdp, recording = stepped(weighted, starts, 1)
    assert mdp.start_probabilities.tolist() == [0.25] * 4
    cells, matrix = recording.observations.ravel(), mdp.dynamics.matrix().toarray()
    for state, cell in enumerate(cells):
        assert matrix[state, np.argsort(cells)] == pytest.approx(
            [1 / (cell + 1)] * (cell + 1) + [0] * (3 - cell), abs=1e-7
        )
    seeded, _ = stepped(weighted, starts, 1, seed=0)
    assert len(seeded.start_states) == 1


@pytest.mark.slow
def test_the_command_goes_on_where_it_stopped(jax, tmp_path, monkeypatch):
    monkeypatch.chdir(HERE.parent)

    def imported(folder, most):
        target = StepTarget("jax:test_jax_stepping.py:corridor")
        return target.import_into(folder, max_outcomes=100, max_states=most, horizon=6, check=False, seconds=0.0)

    imported(tmp_path / "whole", 100)
    with pytest.raises(StateSpaceTooLarge):
        imported(tmp_path / "parts", 9)
    imported(tmp_path / "parts", 100)
    whole, parts = ({file.name: file.read_bytes() for file in path.iterdir()} for path in sorted(tmp_path.iterdir()))
    assert whole == parts
    with pytest.raises(ParameterError, match="workers are 2"):
        StepTarget("jax:test_jax_stepping.py:corridor").import_into(
            tmp_path / "two", max_outcomes=100, max_states=9, workers=2
        )


# Witnesses ------------------------------------------------------------------------------------------------------------


def of_gymnax(name, **options):
    pytest.importorskip("gymnax")
    from pharos.importers.jax_stepping import GymnaxEnvironment

    made = GymnaxEnvironment(name, {})()
    return importers.jax_stepping(made.step, made.reset, made.actions, ignore=["time"], **options)


@pytest.mark.long
def test_the_lake_of_gymnax_is_the_table_of_gymnasium(jax):
    """gymnax has the chance of success 1/3 in float32, and no state for the end."""
    ours, recording = of_gymnax("FrozenLake-misc", gamma=0.95)
    table = importers.gymnasium(gymnasium.make("FrozenLake-v1"), gamma=0.95)
    first, second = (value_iteration(each, 1e-10).v for each in (ours, table))
    assert first == pytest.approx(second[recording.observations.ravel().astype(int)], abs=1e-6)


@pytest.mark.long
def test_space_invaders_of_gymnax_has_the_states_of_minatar(jax):
    """Two libraries, of which one is JAX and the other Python: merged, they have as many states and the same value."""
    pytest.importorskip("minatar")
    ours, _ = of_gymnax("SpaceInvaders-MinAtar", horizon=4, check=False)
    theirs = GymnasiumEnvironment("MinAtar/SpaceInvaders-v1", {"sticky_action_prob": 0.0})
    minatar, _ = importers.stepping(theirs, horizon=4, check=False)
    assert bisimulation.minimize(ours).num_classes == bisimulation.minimize(minatar).num_classes
    assert value_iteration(ours).value_at_start == value_iteration(minatar).value_at_start
