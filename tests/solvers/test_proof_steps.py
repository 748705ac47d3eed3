"""Each step of the proof is needed: without it, a value of one of a few small worlds is wrong, or its bound is.

A step is taken out of the text of a module, which is executed beside the real one. The values are those of rational
numbers and every policy (`naive.goals`), or known in closed form.
"""

import sys
import types
from pathlib import Path

import numpy as np
import pytest
from test_reaching import costs

import pharos
from naive import goals as naive
from pharos.errors import DivergenceError, PharosError
from pharos.mdp import BEST, WORST, TabularMDP
from pharos.solvers import goals, reaching


def world(lists, rewards):
    """An MDP of outcomes [(next state, probability), ...] of each state and action; -1 ends."""
    P = np.zeros((len(lists[0]), len(lists), len(lists)))
    for s, actions in enumerate(lists):
        for a, outcomes in enumerate(actions):
            for successor, p in outcomes:
                if successor >= 0:
                    P[a, s, successor] += p
    return TabularMDP.from_matrices(list(P), rewards, gamma=1.0, ends=True)


def rest():
    """State 0 may stay for nothing, or leave for -1; half of the ways from 1 lead there."""
    return world([[[(0, 1)], [(-1, 1)]], [[(0, 0.5), (1, 0.5)]] * 2], [[0, -1], [0, 0]])


def nested():
    """0 and 1 go round for nothing; from 1 there is a way to 2, which goes back and forth for less and less."""
    return world(
        [
            [[(1, 1)], [(0, 0.5), (1, 0.5)]],
            [[(0, 1)], [(2, 0.5), (0, 0.5)]],
            [[(1, 0.25), (2, 0.75)], [(-1, 1)]],
        ],
        [[0, 0], [0, -1], [-1, 3]],
    )


def gains():
    """Each round of 0 and 1 gains 1/2 on average, beside a way out."""
    return world([[[(1, 1)], [(-1, 1)]], [[(0, 0.5), (1, 0.5)], [(-1, 1)]]], [[2, 0], [-0.5, 0]])


def patient():
    """The better action ends once in 10^12 steps, and pays 10^-12 of 5 a step; the other one ends for 4."""
    return world([[[(0, 1 - 1e-12), (-1, 1e-12)], [(-1, 1)]], [[(0, 1)]] * 2], [[5e-12, 4], [0, 0]])


def later():
    """What is best is seen after the others were improved: a way of five steps to 8 beside 1 at each of them."""
    lists = [[[(s + 1, 0.5), (s, 0.5)], [(-1, 1)]] for s in range(5)]
    return world([*lists, [[(-1, 1)]] * 2], [[0, 1]] * 5 + [[8, 8]])


def thirds():
    """Values that no float is."""
    parts = [[(0, 1 / 3), (1, 1 / 3), (-1, 1 / 3)], [(1, 0.9), (-1, 0.1)]]
    return world([parts, parts[::-1]], [[0.1, 0.3], [0.7, 0.1]])


WORLDS = {"rest": rest, "nested": nested, "gains": gains, "patient": patient, "later": later, "thirds": thirds}


def agrees(total_reward, mdp, select, expected):
    """Whether a solver gives the values (S,), None if there are none, within a bound of at most 1e-6."""
    try:
        solved = total_reward(mdp, select, 1e-6)
    except DivergenceError:
        return expected is None
    except PharosError:
        return False
    if expected is None or not solved.error.max() <= 1e-6:
        return False
    return all(abs(solved.v[s] - value) <= solved.error[s] for s, value in enumerate(expected))


def expected_values():
    for name, make in WORLDS.items():
        for select, sign in ((BEST, 1), (WORST, -1)):
            values = naive.best_values(make(), sign)
            yield name, make(), select, None if values is None else [values[s, None] for s in range(make().num_states)]


def mutant(monkeypatch, module, name, *edits):
    """The module with pieces of its text replaced: old, new, old, new, ..."""
    text = Path(module.__file__).read_text()
    for old, new in zip(edits[::2], edits[1::2], strict=True):
        assert text.count(old) == 1, (module.__name__, old, text.count(old))
        text = text.replace(old, new)
    other = types.ModuleType(name)
    other.__dict__["__file__"] = module.__file__
    monkeypatch.setitem(sys.modules, name, other)
    exec(compile(text, name, "exec"), other.__dict__)
    return other


STEPS = {
    "end components that pay nothing are collapsed": (
        "component, inside = free.labels.ravel(), free.pairs.ravel()",
        "component, inside = np.full(free.labels.size, -1), np.zeros(free.pairs.size, np.bool_)",
    ),
    "those that pay are not": ("(size == 0).reshape(shape)", "(size >= 0).reshape(shape)"),
    "whoever is in one may stop there": (
        "stops = np.zeros(0 if arrived is not None else total)",
        "stops = np.zeros(0)",
    ),
    "a policy is the best one if no action is better, not if none was looked at": (
        "if (above <= 0).all():",
        "if True:",
        "if not is_better.any():",
        "if True:",
    ),
    "a policy that gains in a cycle is no value": (
        "raise infinite(choices, changed[stuck]) if _pays(choices, changed, stuck) else Undecided(policy)",
        "return v.real[:-1], own, policy, improvements",
    ),
    "the values come with a bound": ("return v.real[:-1], error, policy", "return v.real[:-1], 0 * error, policy"),
}


def test_the_real_solver_agrees():
    for name, mdp, select, expected in expected_values():
        assert agrees(goals.total_reward, mdp, select, expected), (name, select.kind)


@pytest.mark.parametrize("step", STEPS)
def test_without_a_step_some_value_is_wrong(step, monkeypatch):
    other = mutant(monkeypatch, goals, "mutant_of_goals", *STEPS[step])
    wrong = []
    for name, mdp, select, expected in expected_values():
        try:
            fits = agrees(other.total_reward, mdp, select, expected)
        except Exception:  # a wrong step may end in anything
            fits = False
        wrong += [] if fits else [(name, select.kind)]
    assert wrong, step


def stalls():
    """State 1 pays and ends with 2^-60 a step: worth 1, and no sweep beyond 2^-7 changes anything in floats."""
    tiny = 2.0**-60
    return TabularMDP.from_outcomes(
        [[[1, 0]], [[1, 2]], [[2, 2]]],
        [[[0.5, 0.5]], [[1.0, tiny]], [[1.0, 0.0]]],
        [[0.5], [tiny], [0.0]],
        gamma=1.0,
        terminal=[False, False, True],
    )


def slow():
    """A state that is left once in 64 steps, to one that is left once in 16, each for 1 a step: worth 80 and 16."""
    return TabularMDP.from_outcomes(
        [[[0, 1]], [[1, 2]], [[2, 2]]],
        [[[63 / 64, 1 / 64]], [[15 / 16, 1 / 16]], [[1.0, 0.0]]],
        [[1.0], [1.0], [0.0]],
        gamma=1.0,
        terminal=[False, False, True],
    )


SWEPT = {
    "a sweep moves all values back": ("if (side * (y - before) <= 0).all():", "if True:"),
    "from both sides": ("for side in (1.0, -1.0):", "for side in (-1.0, -1.0):"),
}


@pytest.mark.long
@pytest.mark.parametrize("step", SWEPT)
def test_sweeps_that_change_nothing_are_no_proof(step, monkeypatch):
    other = mutant(monkeypatch, goals, "mutant_of_goals", *SWEPT[step])
    wrong = 0
    for mdp, values in ((stalls(), [2.0, 1.0, 0.0]), (slow(), [80.0, 16.0, 0.0])):
        for solver, is_real in ((goals.swept_goals, True), (other.swept_goals, False)):
            solved = solver(mdp, BEST, 1e-6, None)
            fits = solved is None or (np.abs(solved.v - values) <= solved.error + 1e-14).all()
            assert fits or not is_real
            wrong += not fits
    assert goals.swept_goals(slow(), BEST, 1e-6, None) is not None
    assert wrong, step


REACHED = {
    "costs are those of policies that surely arrive": (
        "surely = problem.proper(problem.choices)[0]",
        "surely = np.ones(problem.choices.num_nodes + 1, np.bool_)",
    ),
    "a component that may be kept to misses the target": (
        "missed[problem.node_of[:-2][components]] = True",
        "pass",
    ),
    "so does another end": ("missed[-2] = True  # the trap", "pass"),
    "the target is reached": ("bound[self.target] = 1.0", "pass"),
}


@pytest.mark.parametrize("step", REACHED)
def test_without_a_step_some_probability_or_cost_is_wrong(step, monkeypatch):
    other = mutant(monkeypatch, reaching, "mutant_of_reaching", *REACHED[step])
    other_end = TabularMDP.from_outcomes(
        [[[1, 2]], [[1, 1]], [[2, 2]]],
        [[[0.5, 0.5]], [[1.0, 0.0]], [[1.0, 0.0]]],
        [[1.0], [0.0], [0.0]],
        terminal=[False, True, True],
    )
    wrong = 0
    for mdp, target in ((costs(), [1]), (other_end, [1])):
        real = pharos.reach(mdp, target)
        try:
            mutated = other.reach(mdp, target)
            for name in ("maximum", "minimum", "least_cost", "largest_cost"):
                mine, theirs = getattr(mutated, name), getattr(real, name)
                wrong += not ((mine.lower <= theirs.upper) & (theirs.lower <= mine.upper)).all()
        except Exception:
            wrong += 1
    assert wrong, step
