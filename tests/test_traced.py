"""Traced rules: successors are those of rules asked in every state, whatever way a rule has of looking at it; else
tracing ends."""

import copy
import itertools
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import pharos
from pharos import build
from pharos.environments import Environment
from pharos.errors import RuleError
from pharos.rules import traced as _traced
from pharos.rules.interpreted_branches import interpreted_branches
from pharos.rules.traced import TracedRules


@dataclass(frozen=True, kw_only=True)
class Cube(Environment):
    """Four components of 0 to 4; what `transition` does is given."""

    name = "cube"
    actions = ("one", "two")
    rule = staticmethod(lambda state, action, out: None)
    end = staticmethod(lambda state: False)

    def variables(self):
        return {"x": [range(5)] * 4}

    def initial_state(self):
        return (0, 0, 0, 0)

    def transition(self, state, action, out):
        self.rule(state, action, out)

    def is_terminal(self, state):
        return self.end(state)


STATES = np.array(list(itertools.product(range(5), repeat=4)), np.int64)


def cube(rule, end=lambda state: False):
    return type("Cube", (Cube,), {"rule": staticmethod(rule), "end": staticmethod(end)})()


def assert_traced_rightly(env, states, is_on=True):
    """The traced successors, in two batches, are those of every state; so nothing depends on what was asked before."""
    traced = TracedRules(env)
    for part in np.array_split(states, 2):
        found = traced.branches(part)
        assert (found is not None) == is_on
        if found is not None:
            following, terminal, _ = interpreted_branches(env, part.tolist())
            np.testing.assert_array_equal(found[0], following)
            np.testing.assert_array_equal(found[1], terminal)
    assert traced.is_on == is_on
    return traced


@pytest.mark.parametrize(
    "env",
    (
        pharos.make("simple_grid/6x6-decoy"),
        pharos.make("frozen_lake/8x8"),
        pharos.make("breakout", height=7, columns=4),
        pharos.make("breakout", height=7, columns=4, respawn=False, extra_paddle_width=1),
        pharos.make("freeway", num_cars=3, lane_length=4),
    ),
    ids=str,
)
def test_traced_successors_are_those_of_every_state(env, tmp_path):
    space = build(env, tmp_path / "space", progress=False)
    states = np.random.default_rng(0).permutation(space.states(np.arange(space.num_states)))
    traced = assert_traced_rightly(env, states)
    assert traced.asked <= len(states) * (env.num_actions + 1)


def bump(value):
    return (value + 1) % 5


LOOKS = {
    "index": lambda state: state[1],
    "from the end": lambda state: state[-3] + 2 * state[-1],
    "slice": lambda state: sum(state[1:3]),
    "steps": lambda state: state[::-2][0],
    "loop": lambda state: max(x for x in state),
    "unpacking": lambda state: (lambda a, b, c, d: b * d)(*state),
    "names": lambda state: next(a + c for a, _, c, _ in [state]),
    "tuple": lambda state: tuple(state)[2],
    "list": lambda state: sorted(list(state))[2],
    "array": lambda state: int(np.asarray(state).sum()),
    "equal": lambda state: state == (1, 2, 3, 4) or state == (0, 0, 1, 0),
    "not equal": lambda state: int(state != (1, 2, 3, 4)),
    "key": lambda state: {(1, 1, 1, 1): 3, (0, 1, 2, 3): 2}.get(state, 0),
    "member": lambda state: 4 in state,
    "one of": lambda state: state in {(2, 2, 2, 2), (0, 4, 0, 4)},
    "text": lambda state: len(set(f"{state}")) + len(str(state)) + hash(repr(state)) % 3,
    "shape": lambda state: len(state) if state else 0,
    "kind": lambda state: state[0] if isinstance(state, tuple) else 3,
    "early": lambda state: 0 if state[3] < 3 else state[2] if state[1] else state[0],
    "copied": lambda state: list(reversed([*state]))[1],
}


@pytest.mark.parametrize("look", LOOKS.values(), ids=LOOKS)
def test_whatever_way_a_rule_looks_at_the_state(look):
    def rule(state, action, out):
        out[action] = bump(int(look(state)))

    assert_traced_rightly(cube(rule, lambda state: bool(look(state) == 2)), STATES)


def writes_all(state, action, out):
    out[:] = [bump(x) for x in state]


def reads_what_it_wrote(state, action, out):
    out[0] = bump(state[1])
    out[-1] = out[0] if action else out[1]
    if out[2] == out[0] and list(out)[3] < 3:
        out[2:4] = [0, *out[:1]]


def augments(state, action, out):
    out[1] += state[0] < 2 and out[1] < 4
    if out == [0, 1, 2, 3] or out == state:
        out[3] = 0


def swaps(state, action, out):
    out[0], out[1] = out[1], out[0]


def writes_booleans(state, action, out):
    out[0] = state[1] > 2
    out[1] = np.int64(state[0])


@pytest.mark.parametrize("rule", (writes_all, reads_what_it_wrote, augments, swaps, writes_booleans))
def test_whatever_way_a_rule_writes(rule):
    assert_traced_rightly(cube(rule), STATES)


def copies(state, action, out):
    out[0] = copy.deepcopy(state)[1]


def counts(state, action, out):
    out[0] = state.count(0)


def appends(state, action, out):
    out.append(0)
    out.pop()


def hashes_out(state, action, out):
    out[0] = 0 if {id(out): 1} and not out else len({tuple(out)})
    out.sort()


@pytest.mark.parametrize("rule", (copies, counts, appends, hashes_out))
def test_what_a_stand_in_does_not_offer_ends_tracing(rule):
    assert_traced_rightly(cube(rule), STATES, is_on=False)


def test_a_rule_that_is_not_a_function_of_the_state_is_not_traced():
    calls = itertools.count()

    def rule(state, action, out):
        out[0] = next(calls) % 3

    assert TracedRules(cube(rule)).branches(STATES) is None

    def wanders(state, action, out):
        out[0] = state[next(calls) % 4]

    assert TracedRules(cube(wanders)).branches(STATES) is None


def test_a_rule_that_fails_is_blamed_as_ever(tmp_path, monkeypatch):
    monkeypatch.setattr("pharos.rules.rules.compiled_or_none", lambda *args: None)

    def rule(state, action, out):
        out[state[0] % 4] = bump(state[state[0] % 4])
        out[action] = bump(state[action])
        if state[3] == 4 and state[2] == 2:
            out[1] = {}[action]

    with pytest.raises(RuleError, match="a rule raises KeyError"):
        build(cube(rule), tmp_path / "space", progress=False)

    def leaves(state, action, out):
        out[action] = bump(state[action])
        out[2 + action] = state[2 + action] + (state[0] == 4)

    with pytest.raises(RuleError, match=r"leads to x\[\d\] = 5; declared: 0 to 4"):
        build(cube(leaves), tmp_path / "other", progress=False)


def test_a_component_with_very_many_values_is_not_for_a_tree():
    class Long(Cube):
        def variables(self):
            return {"x": [range(10**9)] + [range(5)] * 3}

    def rule(state, action, out):
        out[0] = state[0] // 2

    env = type("Long", (Long,), {"rule": staticmethod(rule)})()
    assert TracedRules(env).branches(STATES) is None


def test_tracing_ends_where_it_saves_nothing(monkeypatch):
    monkeypatch.setattr(_traced, "FAIR_TRIAL", 300)

    def looks_at_all(state, action, out):
        out[0] = bump(sum(state))

    traced = TracedRules(cube(looks_at_all))
    assert traced.branches(STATES) is None and traced.asked < len(STATES)

    def looks_at_one(state, action, out):
        out[0] = bump(state[1])

    traced = TracedRules(cube(looks_at_one))
    assert traced.branches(STATES) is not None and traced.asked <= 2 * 5 + 1


def test_files_do_not_depend_on_tracing(tmp_path, monkeypatch):
    monkeypatch.setattr("pharos.rules.rules.compiled_or_none", lambda *args: None)
    env = pharos.make("breakout", height=7, columns=4)
    build(env, tmp_path / "traced", progress=False)
    monkeypatch.setattr(TracedRules, "branches", lambda self, states: None)
    build(env, tmp_path / "asked", progress=False)
    for file in (tmp_path / "traced").iterdir():
        if file.suffix != ".json":
            assert file.read_bytes() == (tmp_path / "asked" / file.name).read_bytes()


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.tuples(st.integers(0, 3), st.integers(0, 4), st.integers(0, 3), st.integers(0, 4)), max_size=6),
    st.lists(st.tuples(st.integers(0, 3), st.integers(0, 4)), max_size=2),
)
def test_any_rule_of_cases(cases, ends):
    """`if state[i] == v: out[j] = w`, one after the other, some by what was written."""

    def rule(state, action, out):
        for i, value, j, new in cases:
            if (out if (i + j) % 2 else state)[i] == value:
                out[j] = (new + action) % 5

    assert_traced_rightly(cube(rule, lambda state: any(state[i] == value for i, value in ends)), STATES)


@pytest.mark.parametrize(
    "env",
    (
        pharos.make("breakout", height=7, columns=4),
        pharos.make("freeway", num_cars=3, lane_length=4),
        pharos.make("frozen_lake", size=12, seed=0),
    ),
    ids=str,
)
def test_traced_rewards_are_those_of_every_transition(env, tmp_path, monkeypatch):
    space = build(env, tmp_path / "space", progress=False)
    expected = space.mdp().rewards
    monkeypatch.setattr("pharos.rules.rules.compiled_or_none", lambda *args: None)
    monkeypatch.setattr("pharos.rules.interpreted.InterpretedRewards.block", lambda *args: pytest.fail("not traced"))
    np.testing.assert_array_equal(space.mdp().rewards, expected)


def test_a_reward_that_cannot_be_traced_is_asked_for_everywhere(tmp_path, monkeypatch):
    env = pharos.make("breakout", height=7, columns=4)
    space = build(env, tmp_path / "space", progress=False)
    monkeypatch.setattr("pharos.rules.rules.compiled_or_none", lambda *args: None)

    def counted(self, state, action, next_state):
        return float(state.count(0) + next_state[0] + (state == next_state))

    found = space.mdp(rewards=counted).rewards
    for s in (0, 5, 100):
        state, following = space.state(s), [space.state(t) for t in space.successors[s]]
        assert found[s].tolist() == [counted(env, state, a, following[a]) for a in range(3)]

    def undefined(self, state, action, next_state):
        return float("nan") if next_state[4] == 2 else 0.0

    with pytest.raises(RuleError, match="is nan; expected a finite number"):
        space.mdp(rewards=undefined)
