"""Environment: what the base class derives from the declarations of a class, and which declarations it refuses."""

import dataclasses
from dataclasses import dataclass
from typing import Any

import pytest

import pharos
from pharos.environments import Environment, start_distribution
from pharos.errors import ParameterError, PharosError, RuleError, UnknownName
from refusals import refusal


@dataclass(frozen=True, kw_only=True)
class Declared(Environment):
    """Declares whatever it is told to."""

    declared: Any = None
    starts: Any = (((0, 0), 1.0),)

    name = "declared"
    actions = ("stay",)

    def variables(self):
        return self.declared if self.declared is not None else {"x": range(3), "y": range(-2, 2)}

    def initial_states(self):
        return self.starts

    def transition(self, state, action, out):
        pass

    def reward(self, state, action, next_state):
        return 0.0


def test_components_follow_the_order_of_declaration():
    env = Declared(
        declared={"b": range(2), "a": [[range(3), range(1, 4)], [range(-5, 0), range(7)]], "c": [range(4)] * 2}
    )
    components = env.components
    assert components.names == ("b", "a[0,0]", "a[0,1]", "a[1,0]", "a[1,1]", "c[0]", "c[1]")
    assert components.low.tolist() == [0, 0, 1, -5, 0, 0, 0]
    assert components.high.tolist() == [1, 2, 3, -1, 6, 3, 3]
    assert components.size.tolist() == [2, 3, 3, 5, 7, 4, 4]
    assert components.variables == {"b": slice(0, 1), "a": slice(1, 5), "c": slice(5, 7)}
    assert len(components) == 7
    assert env.components is components


@pytest.mark.parametrize(
    ("declared", "expected"),
    (
        ({"x": range(0)}, "variable 'x' is declared as range(0, 0); expected a non-empty range with step 1"),
        ({"x": range(0, 9, 2)}, "expected a non-empty range with step 1"),
        ({"x": 3}, "variable 'x' is declared as 3"),
        ({"x": [range(2), "abc"]}, "variable 'x' is declared as [range(0, 2), 'abc']; expected a non-empty range"),
        ({"x": [0, 1, 2, 5]}, "variable 'x' is declared as [0, 1, 2, 5]"),
        ({"x": []}, "variables() declares nothing"),
        ({}, "variables() declares nothing"),
        ({"x": range(2**64)}, "at most 2^63 - 1 values"),
        ({"x": range(2**63, 2**63 + 2)}, "64 bits"),
        ({"x": range(-(2**62), 2**62)}, "at most 2^63 - 1 values"),
    ),
)
def test_declarations_that_make_no_sense_are_refused(declared, expected):
    with pytest.raises(ParameterError) as error:
        _ = Declared(declared=declared).components
    assert expected in str(error.value)


def test_start_states_that_are_given_twice_are_merged_in_order():
    env = Declared(starts=(((2, 1), 0.25), ((0, 0), 0.5), ((2, 1), 0.25)))
    states, probabilities = start_distribution(env)
    assert states == [(2, 1), (0, 0)]
    assert probabilities.tolist() == [0.5, 0.5]


@pytest.mark.parametrize(
    ("starts", "expected"),
    (
        ((), "probabilities of the start states sum to 0; expected 1"),
        ((((0, 0), 0.4), ((1, 0), 0.4)), "sum to 0.8; expected 1"),
        ((((0, 0), 1.5), ((1, 0), -0.5)), "start state (1, 0) has probability -0.5; expected one in (0, 1]"),
        ((((0, 0), float("nan")),), "has probability nan"),
        ((((0, 0, 0), 1.0),), "start state (0, 0, 0) has 3 components; expected 2"),
        ((((0, 2), 1.0),), "start state (0, 2) has y = 2; expected -2 to 1"),
        ((((0, -3), 1.0),), "start state (0, -3) has y = -3; expected -2 to 1"),
        ((((0.5, 0), 1.0),), "start state (0.5, 0) has x = 0.5; expected an integer"),
    ),
)
def test_start_states_that_make_no_sense_are_refused(starts, expected):
    assert expected in refusal(ParameterError, start_distribution, Declared(starts=starts))


def test_one_start_state_is_a_distribution():
    env = pharos.make("simple_grid")
    assert env.initial_states() == [((0, 0), 1.0)]


def test_an_environment_is_its_parameters():
    env = pharos.make("breakout", height=9, columns=4)
    assert env == pharos.make("breakout", columns=4, height=9)
    assert hash(env) == hash(pharos.make("breakout", columns=4, height=9))
    assert env != pharos.make("breakout", height=9, columns=5)
    assert env.parameters == {"height": 9, "columns": 4, "brick_rows": 2, "extra_paddle_width": 0, "respawn": True}
    assert str(env) == "Breakout(height=9, columns=4, brick_rows=2, extra_paddle_width=0, respawn=True)"
    with pytest.raises(dataclasses.FrozenInstanceError):
        env.height = 3


def test_next_state_is_a_tuple_and_leaves_its_argument_alone():
    env = pharos.make("simple_grid")
    state = [1, 1]
    assert env.next_state(state, 1) == (1, 2)
    assert state == [1, 1]


def test_parameters_of_a_named_instance_can_be_overridden():
    env = pharos.make("breakout/12x10x3", height=9)
    assert (env.height, env.columns, env.extra_paddle_width) == (9, 10, 1)


def test_every_name_that_is_listed_can_be_made():
    names = pharos.list_environments()
    assert len(set(names)) == len(names)
    for name in names:
        env = pharos.make(name)
        assert env.num_actions == len(env.actions) > 0
        assert env.name == name.split("/")[0]


@pytest.mark.parametrize(
    ("name", "parameters", "expected"),
    (
        ("./absent", {}, "'./absent'; no such folder; expected what `pharos import` writes"),
        ("/", {}, "'/'; no imported MDP is in that folder; expected"),
        ("brekout", {}, "unknown environment 'brekout'; did you mean 'breakout'?"),
        ("breakout", {"hight": 9}, "unknown parameter of breakout 'hight'; did you mean 'height'?"),
        ("simple_grid", {"zzz": 9}, "known: goal, height, penalties, rewards, width"),
    ),
)
def test_a_name_that_is_not_known_suggests_the_nearest(name, parameters, expected):
    assert expected in refusal(UnknownName, pharos.make, name, **parameters)


def test_every_error_is_caught_by_pharos_error():
    from pharos import errors

    classes = [value for value in vars(errors).values() if isinstance(value, type) and issubclass(value, Exception)]
    assert len(classes) > 10
    assert all(issubclass(cls, PharosError) and cls.__name__ in errors.__doc__ for cls in classes)


@pytest.mark.parametrize("method", ("variables", "initial_state", "grid"))
def test_what_a_class_must_define_is_said(method):
    class Bare(Environment):
        name = "bare"
        actions = ("stay",)

    with pytest.raises(NotImplementedError, match=f"Bare must define {method}"):
        getattr(Bare(), method)()


class Coin(Declared):
    """With chance: by outcome 1 the first variable grows."""

    outcomes = 2

    def probability(self, state, action, outcome):
        return 0.5 if state[0] < 2 else 1.0 - outcome

    def transition(self, state, action, outcome, out):
        out[0] = min(state[0] + outcome, 2)


def test_a_class_has_chance_where_it_declares_outcomes_and_their_probabilities():
    coin, declared = Coin(), Declared()
    assert (coin.has_chance, coin.takes_outcomes(), coin.has_age) == (True, True, False)
    assert (declared.has_chance, declared.takes_outcomes(), declared.outcomes) == (False, False, 1)
    assert [coin.next_state((0, 0), 0, outcome) for outcome in range(2)] == [(0, 0), (1, 0)]
    assert coin.next_state((0, 0), 0) == declared.next_state((0, 0), 0) == (0, 0)
    assert [declared.probability((0, 0), 0, outcome) for outcome in range(2)] == [1.0, 0.0]
    with pytest.raises(ParameterError, match="an action has one outcome; found outcome 1, expected 0"):
        declared.next_state((0, 0), 0, 1)


def test_a_class_with_one_outcome_in_this_instance_has_no_chance():
    class One(Coin):
        outcomes = 1

    assert not One().has_chance
    assert One().next_state((0, 0), 0) == (0, 0)


@pytest.mark.parametrize("outcomes", (0, -1, 1.5, True, None, "2"))
def test_outcomes_that_are_no_number_of_them_are_refused(outcomes):
    class Wrong(Coin):
        pass

    Wrong.outcomes = outcomes
    with pytest.raises(RuleError, match="expected an integer of at least 1"):
        _ = Wrong().has_chance


def test_outcomes_without_probabilities_are_refused():
    class Unlikely(Declared):
        outcomes = 2

    with pytest.raises(RuleError, match=r"outcomes is 2, but Unlikely defines no probability\(\)"):
        _ = Unlikely().has_chance


def test_an_age_is_optional():
    class Aged(Declared):
        def age(self, state):
            return state[0]

    assert Aged().has_age
    assert "Declared defines no age" in refusal(NotImplementedError, Declared().age, (0, 0))
