"""check_environment accepts what keeps the contract, and names the rule and the state of every kind of breach."""

import itertools
import random
from dataclasses import dataclass

import numpy as np
import pytest

import pharos
import worlds
from pharos.environments import Environment, Layer
from pharos.errors import ParameterError, RuleError

COUNTER = itertools.count()
RED, BLUE = (200, 60, 60), (60, 60, 200)


@dataclass(frozen=True, kw_only=True)
class Corridor(worlds.Corridor):
    """Walk right to the end of a corridor. A good class, which the tests below break in one place each."""

    variable = "position"
    layers = {"end": Layer("E", RED), "agent": Layer(("A", "a"), (BLUE, RED))}

    def transition(self, state, action, out):
        if action == 1:
            out[0] = state[0] + 1
        elif state[0] > 0:
            out[0] = state[0] - 1

    def grid(self):
        return 1, self.length

    def draw(self, state, planes):
        planes[0, 0, self.length - 1] = 1
        planes[1, 0, state[0]] = 1 + state[0] % 2


def corridor(**attributes):
    """A Corridor in which `attributes` (rules, declarations) are replaced."""
    return dataclass(frozen=True, kw_only=True)(type("Broken", (Corridor,), attributes))()


def message(env, **options):
    with pytest.raises(RuleError) as error:
        pharos.check_environment(env, **options)
    assert "\n" not in str(error.value)
    return str(error.value)


@pytest.mark.slow
def test_a_good_class_passes_and_the_report_says_what_was_checked():
    report = pharos.check_environment(Corridor())
    assert (report.num_states, report.num_transitions, report.complete, report.compiled) == (5, 8, True, True)
    assert report.notes == ()
    assert str(report) == "Corridor(length=5) keeps the contract in all 5 states"


def test_a_large_space_is_sampled_near_the_start_and_far_from_it():
    report = pharos.check_environment(Corridor(length=10_000), max_states=60)
    assert (report.num_states, report.complete) == (60, False)
    assert len(report.notes) == 1
    assert "position is declared as 0 to 9999; in the 60 states looked at it takes 0 to" in report.notes[0]
    assert "a sample of 60 states" in str(report)


@pytest.mark.long
def test_the_sample_does_not_depend_on_anything_but_the_seed():
    env = pharos.make("breakout")
    assert pharos.check_environment(env, max_states=50) == pharos.check_environment(env, max_states=50)


def test_max_states_must_be_positive():
    with pytest.raises(ParameterError, match="max_states=0"):
        pharos.check_environment(Corridor(), max_states=0)


# Declarations --------------------------------------------------------------------------------------------------------


def test_what_is_no_environment_is_refused():
    assert "expected an instance of a subclass" in message(Corridor)


def test_a_class_must_be_a_frozen_dataclass():
    class Plain(Corridor):
        pass

    @dataclass(kw_only=True, eq=False)
    class Thawed(Environment):
        pass

    for env in (Plain(), Thawed()):
        assert "is no frozen dataclass" in message(env)


@pytest.mark.parametrize(
    ("attribute", "value", "words"),
    [
        ("name", "", "Broken.name is ''"),
        ("name", None, "Broken.name is None"),
        ("actions", (), "Broken.actions is ()"),
        ("actions", ["left", "right"], "expected a tuple"),
        ("actions", ("left", "left"), "different names"),
        ("version", 0, "version is 0"),
        ("max_episode_steps", 0.5, "max_episode_steps is 0.5"),
        ("variables", lambda self: {}, "variables() declares nothing"),
        ("variables", lambda self: {"position": range(0)}, "non-empty range"),
        ("variables", lambda self: {"position": range(0, 10, 2)}, "step 1"),
        ("initial_state", lambda self: (5,), "position = 5; expected 0 to 4"),
        ("initial_state", lambda self: (0, 0), "has 2 components; expected 1"),
        ("initial_states", lambda self: [((0,), 0.5)], "sum to 0.5"),
        ("initial_states", lambda self: [((0,), -1.0), ((1,), 2.0)], "probability -1.0"),
        ("initial_states", lambda self: [((next(COUNTER),), 1.0)], "differs from call to call"),
        ("layers", {"agent": "A"}, "expected a Layer"),
        ("layers", ["agent"], "expected a dict"),
        ("layers", {"agent": Layer("AB", RED)}, "expected one character"),
        ("layers", {"agent": Layer("A", (0, 0, 256))}, "0 to 255"),
        ("layers", {"agent": Layer("A", (0, 0))}, "(red, green, blue)"),
        ("layers", {"agent": Layer("A", (RED, BLUE))}, "1 glyphs and 2 colors"),
        ("layers", {"agent": Layer("A", RED, ("##", "#"))}, "rows of equal length"),
        ("layers", {"agent": Layer("A", RED, ("#x",))}, "letters . # 1-9"),
        ("layers", {"agent": Layer(("A", "B", "C"), RED, (("#",), ("#",)))}, "2 sprites for 3 values"),
        ("grid", lambda self: (0, 3), "two integers, at least 1"),
        ("grid", Environment.grid, "grid() does not give"),
    ],
)
def test_a_wrong_declaration_is_named(attribute, value, words):
    assert words in message(corridor(**{attribute: value}))


def test_parameters_must_survive_json():
    @dataclass(frozen=True, kw_only=True)
    class WithSet(Corridor):
        holes: frozenset = frozenset({1})

    @dataclass(frozen=True, kw_only=True)
    class WithTuple(Corridor):
        holes: tuple = (1, 2)

    assert "do not survive JSON" in message(WithSet())
    assert "expected an equal instance" in message(WithTuple())


# Transition ----------------------------------------------------------------------------------------------------------


def test_a_transition_that_leaves_the_range_is_named_with_state_and_action():
    def transition(self, state, action, out):
        out[0] = state[0] + 2 * action

    words = message(corridor(transition=transition, is_terminal=lambda self, state: False))
    assert "transition of action 'right' in state (position=4) writes position = 6; declared: 0 to 4" in words


def test_a_transition_must_not_write_to_its_state():
    def transition(self, state, action, out):
        state[0] = 1

    assert "transition of action 'left' in state (position=0) writes to its state" in message(
        corridor(transition=transition)
    )


@pytest.mark.parametrize("value", [0.5, 1.0, "1", None])
def test_a_transition_must_write_integers(value):
    def transition(self, state, action, out):
        out[0] = self.value

    assert f"writes position = {value!r}; expected an integer" in message(corridor(transition=transition, value=value))


def test_a_transition_must_write_instead_of_returning():
    def transition(self, state, action, out):
        return (1,)

    assert "returns (1,); expected nothing" in message(corridor(transition=transition))


def test_a_transition_must_keep_the_length_of_the_state():
    def transition(self, state, action, out):
        out.append(1)

    assert "leaves 2 components" in message(corridor(transition=transition))


def test_a_transition_must_not_draw_lots():
    rng = itertools.cycle([0, 1])

    def transition(self, state, action, out):
        out[0] = next(rng)

    assert "leads to (position=0), then to (position=1); expected the same answer" in message(
        corridor(transition=transition)
    )


def test_a_transition_must_not_remember():
    asked = []

    def transition(self, state, action, out):
        asked.append(state[0])
        out[0] = 1 if len(asked) <= 8 else 0

    words = message(corridor(transition=transition))
    assert "now leads to (position=0), before to (position=1)" in words


def test_an_exception_in_a_rule_is_reported_with_its_state():
    def transition(self, state, action, out):
        out[action] = 0

    assert "transition of action 'right' in state (position=0) raises IndexError" in message(
        corridor(transition=transition)
    )


# is_terminal, reward -------------------------------------------------------------------------------------------------


def test_is_terminal_must_say_true_or_false():
    assert "is_terminal in state (position=0) says 0; expected True or False" in message(
        corridor(is_terminal=lambda self, state: state[0])
    )


def test_is_terminal_must_not_draw_lots():
    rng = itertools.cycle([False, True])
    assert "is_terminal in state (position=0) says False, then True" in message(
        corridor(is_terminal=lambda self, state: next(rng))
    )


def test_is_terminal_must_not_remember():
    asked = []

    def is_terminal(self, state):
        asked.append(state)
        return len(asked) > 4 and state[0] == 0

    env = corridor(is_terminal=is_terminal, transition=lambda self, state, action, out: out.__setitem__(0, action))
    assert "is_terminal in state (position=0) now says True" in message(env)


def test_is_terminal_must_not_write_to_its_state():
    def is_terminal(self, state):
        state[0] = 0

    assert "is_terminal in state (position=0) writes to its state" in message(corridor(is_terminal=is_terminal))


@pytest.mark.parametrize("value", [float("nan"), float("inf"), None, "1", 1j])
def test_a_reward_must_be_a_finite_number(value):
    env = corridor(reward=lambda self, state, action, next_state: self.value, value=value)
    assert f"reward of action 'left' in state (position=0) is {value!r}; expected a finite number" in message(env)


def test_a_reward_must_not_draw_lots():
    rng = itertools.count()
    env = corridor(reward=lambda self, state, action, next_state: float(next(rng)))
    assert "is 0.0, then 1.0; expected the same answer" in message(env)


def test_a_reward_must_not_remember():
    asked = []

    def reward(self, state, action, next_state):
        asked.append(state)
        return float(len(asked) > 18)

    assert "reward of action" in (words := message(corridor(reward=reward)))
    assert "is now 1.0, before 0.0" in words


@pytest.mark.parametrize("which", [0, 1])
def test_a_reward_must_not_write_to_the_states(which):
    def reward(self, state, action, next_state):
        (state, next_state)[self.which][0] = 0

    assert "reward of action 'left' in state (position=0) writes to its state" in message(
        corridor(reward=reward, which=which)
    )


# draw ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("index", [(0, 0, 5), (0, 0, -1), (2, 0, 0), (0, 1, 0)])
def test_a_drawing_must_stay_in_its_planes(index):
    def draw(self, state, planes):
        planes[self.index] = 1

    assert f"lies outside of planes {(2, 1, 5)}" in message(corridor(draw=draw, index=index))


def test_a_drawing_may_only_use_values_that_have_a_glyph():
    def draw(self, state, planes):
        planes[0, 0, 0] = 2

    assert "draw in state (position=0) writes 2 on layer 'end'; expected 0 to 1" in message(corridor(draw=draw))


def test_a_drawing_must_not_draw_lots():
    rng = itertools.cycle([0, 1])

    def draw(self, state, planes):
        planes[0, 0, next(rng)] = 1

    assert "draws two different things" in message(corridor(draw=draw))


def test_a_drawing_must_not_write_to_its_state():
    def draw(self, state, planes):
        state[0] = 0

    assert "draw in state (position=0) writes to its state" in message(corridor(draw=draw))


@pytest.mark.long
def test_slices_of_the_planes_may_be_drawn():
    def draw(self, state, planes):
        planes[0, :, 1:3] = 1

    assert pharos.check_environment(corridor(draw=draw)).notes == ()


# Interpreted and compiled --------------------------------------------------------------------------------------------

LAST_BIT = 63  # integers of compiled code have 64 bits, those of Python any number


@pytest.mark.long
def test_rules_must_say_the_same_compiled():
    def transition(self, state, action, out):
        out[0] = (state[0] + action) % self.length if (1 + state[0]) << LAST_BIT > 0 else 0

    def is_terminal(self, state):
        return state[0] == self.length - 1 or (1 + state[0]) << LAST_BIT < 0

    def reward(self, state, action, next_state):
        return float((1 + state[0]) << LAST_BIT)

    def draw(self, state, planes):
        planes[0, 0, 0] = 1 if (1 + state[0]) << LAST_BIT > 0 else 0

    assert "transition of action 'right' in state (position=0) leads to (position=0) compiled, to (position=1)" in (
        message(corridor(transition=transition))
    )
    assert "is_terminal in state (position=0) says True compiled, False interpreted" in message(
        corridor(is_terminal=is_terminal)
    )
    assert f"is {-(2.0**63)} compiled, {2.0**63} interpreted" in message(corridor(reward=reward))
    assert "draw in state (position=0) writes 0 at [0, 0, 0] compiled, 1 interpreted" in message(corridor(draw=draw))


@pytest.mark.long
def test_a_value_in_between_must_stay_in_the_range_too():
    def transition(self, state, action, out):
        out[0] = state[0] + 2 * action - 1
        if out[0] < 0:
            out[0] = 0

    assert "compiled, it reads or writes position outside its declared range" in message(
        corridor(transition=transition)
    )


@pytest.mark.long
def test_rules_that_numba_cannot_compile_are_noted():
    def transition(self, state, action, out):
        out[0] = max(0, state[0] + eval("2 * action - 1"))

    report = pharos.check_environment(corridor(transition=transition))
    assert not report.compiled
    assert report.complete
    assert len(report.notes) == 1
    assert "Numba cannot compile its rules, so they run interpreted" in report.notes[0]


@pytest.mark.slow
def test_a_drawing_that_numba_cannot_compile_is_noted():
    def draw(self, state, planes):
        planes[0, 0, eval("0")] = 1

    report = pharos.check_environment(corridor(draw=draw))
    assert report.compiled
    assert len(report.notes) == 1
    assert "Numba cannot compile draw" in report.notes[0]


@pytest.mark.long
def test_the_built_state_space_is_compared(monkeypatch):
    import pharos.state_space

    build = pharos.state_space.build
    monkeypatch.setattr(pharos.state_space, "build", lambda env, *a, **k: build(Corridor(length=4), *a, **k))
    assert "the builder finds 4 states, calling the rules one by one 5" in message(Corridor())

    def other(self, state, action, out):
        out[0] = min(state[0] + 1, self.length - 1)

    monkeypatch.setattr(pharos.state_space, "build", lambda env, *a, **k: build(corridor(transition=other), *a, **k))
    assert "built, it leads to states [1, 1]; expected [0, 1]" in message(Corridor())


def test_a_rule_that_prints_is_named_before_it_prints(capsys):
    def show(state):
        print(state)

    def transition(self, state, action, out):
        show(state)
        out[0] = state[0]

    with pytest.raises(RuleError, match="transition prints: remove it"):
        pharos.check_environment(corridor(transition=transition))
    assert capsys.readouterr().out == ""


# Notes ---------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_declared_values_that_no_state_takes_are_noted():
    env = corridor(variables=lambda self: {"position": range(-1, 8)})
    assert pharos.check_environment(env).notes == (
        "position is declared as -1 to 7; in any reachable state it takes 0 to 4",
    )


@pytest.mark.slow
def test_an_environment_that_cannot_be_drawn_is_noted():
    report = pharos.check_environment(corridor(layers={}, grid=Environment.grid, draw=Environment.draw))
    assert report.notes == ("it declares no layers: it cannot be drawn, and has no image observations",)


def test_rewards_that_no_action_changes_are_noted():
    report = pharos.check_environment(corridor(reward=lambda self, state, action, next_state: 0.0))
    assert report.notes[0] == "no policy beats another: at discount 0.99, V* is the value of uniform play"


@pytest.mark.long
def test_attributes_that_can_change_are_noted_where_rules_read_them():
    reward = lambda self, state, action, next_state: float(self.prizes[next_state[0]])  # noqa: E731
    notes = pharos.check_environment(corridor(prizes=[0, 0, 0, 0, 1], reward=reward)).notes
    assert "rules read prizes, a list, which can change after states were enumerated; expected a tuple" in notes
    assert not any(
        "prizes" in note for note in pharos.check_environment(corridor(prizes=(0, 0, 0, 0, 1), reward=reward)).notes
    )


def test_episodes_that_end_before_they_begin_are_noted():
    report = pharos.check_environment(corridor(initial_state=lambda self: (4,)))
    assert report.notes[0].startswith("every start state is terminal")
    assert report.num_states == 1


@pytest.mark.parametrize(
    ("name", "meant"),
    [
        *[(name, "max_episode_steps") for name in ("time_limit", "horizon", "max_episode_step")],
        *[("layer", "layers"), ("is_termina", "is_terminal"), ("initial_sates", "initial_states")],
    ],
)
def test_attributes_that_nothing_reads_and_are_near_to_one_of_the_contract_are_noted(name, meant):
    assert pharos.check_environment(corridor(**{name: 60})).notes[-1] == f"{name} is not used; did you mean {meant}?"


@pytest.mark.long
def test_attributes_of_the_users_own_are_not_noted():
    reward = lambda self, state, action, next_state: float(self.rewards[next_state[0]])  # noqa: E731
    report = pharos.check_environment(corridor(rewards=(0, 0, 0, 0, 1), reward=reward, palette=RED, speed=3))
    assert report.notes == ()


@pytest.mark.long
def test_a_world_without_ends_says_when_episodes_end():
    def transition(self, state, action, out):
        out[0] = (state[0] + action) % 5

    endless = {"is_terminal": Environment.is_terminal, "transition": transition}
    note = pharos.check_environment(corridor(**endless)).notes[-1]
    assert note.startswith("no state is terminal") and "1,000 steps" in note and "max_episode_steps" in note
    limited = pharos.check_environment(corridor(max_episode_steps=50, **endless))
    assert not any("terminal" in each for each in limited.notes)


def test_a_name_that_a_class_of_pharos_has_is_noted():
    assert (
        "'frozen_lake' is the name of a class of pharos"
        in pharos.check_environment(corridor(name="frozen_lake")).notes[-1]
    )


@pytest.mark.parametrize(
    ("rule", "told"),
    [("grid", "grid() fails: NameError"), ("variables", "variables() or initial_state() fails: NameError")],
)
def test_a_slip_in_a_declaration_is_one_line(rule, told):
    def broken(self):
        return undeclared  # noqa: F821

    assert told in message(corridor(**{rule: broken}))


@pytest.mark.long
def test_truths_and_numbers_of_numpy_are_accepted():
    def reward(self, state, action, next_state):
        return np.float64(next_state[0])

    def is_terminal(self, state):
        return np.bool_(state[0] == self.length - 1)

    assert pharos.check_environment(corridor(reward=reward, is_terminal=is_terminal)).complete


# Chance and ages ------------------------------------------------------------------------------------------------------


class Windy(Corridor):
    """With chance: outcome 1 leads two cells to the right; in the last cell but one it is impossible."""

    outcomes = 2

    def probability(self, state, action, outcome):
        if state[0] == self.length - 2:
            return 1.0 - outcome
        return 0.25 if outcome == 1 else 0.75

    def transition(self, state, action, outcome, out):
        out[0] = state[0] + 1 + outcome if action == 1 else max(state[0] - 1, 0)


def windy(**attributes):
    return dataclass(frozen=True, kw_only=True)(type("Broken", (Windy,), attributes))()


@pytest.mark.long
def test_a_good_class_with_chance_passes():
    done = pharos.check_environment(pharos.make("frozen_lake", slippery=True))
    assert done.complete and done.compiled and (done.num_states, done.num_transitions) == (16, 11 * 4 * 3)


@pytest.mark.slow
def test_a_good_class_with_an_age_passes():
    def age(self, state):
        return 3 * state[0]

    forward = {"actions": ("right",), "transition": lambda self, state, action, outcome, out: _go(state, outcome, out)}
    assert pharos.check_environment(windy(**forward, age=age)).compiled


def _go(state, outcome, out):
    out[0] = state[0] + 1 + outcome


OUTCOME_0 = r"Broken(length=5): probability of outcome 0 of action 'left' in state (position=0)"


@pytest.mark.parametrize(
    ("rule", "expected"),
    (
        (lambda self, s, a, k: 0.6, "Broken(length=5): probability of action 'left' in state (position=0): those of "),
        (lambda self, s, a, k: -0.5 if k else 1.5, f"{OUTCOME_0} is 1.5; expected a number from 0 to 1"),
        (lambda self, s, a, k: float("nan"), f"{OUTCOME_0} is nan; expected a number from 0 to 1"),
        (lambda self, s, a, k: "half", f"{OUTCOME_0} is 'half'; expected a number from 0 to 1"),
        (lambda self, s, a, k: 1 / (k - k), f"{OUTCOME_0} raises ZeroDivisionError"),
        (lambda self, s, a, k: 0.5 + 2e-9 * k, "sum to 1.0000000020000002; expected 1"),
    ),
)
def test_probabilities_that_are_none_are_named_with_state_action_and_outcome(rule, expected):
    assert expected in message(windy(probability=rule))


def test_probabilities_must_not_draw_lots():
    lots = random.Random(0)
    found = message(windy(probability=lambda self, s, a, k: lots.random()))
    assert found.startswith(f"{OUTCOME_0} is 0.844") and "expected the same answer to the same question" in found


def test_an_outcome_that_leaves_the_range_is_named():
    where = "Broken(length=5): transition of outcome 1 of action 'right' in state (position=3) writes position = 5"
    assert where in message(windy(probability=lambda self, s, a, k: 0.5))


@pytest.mark.long
def test_an_impossible_outcome_is_not_followed():
    done = pharos.check_environment(windy())
    assert done.complete and done.compiled and (done.num_states, done.num_transitions) == (5, 14)


@pytest.mark.parametrize(
    ("age", "expected"),
    (
        (lambda self, s: s[0] // 2, "transition of outcome 0 of action 'left' in state (position=0) leads from age 0"),
        (lambda self, s: 0.5, "age in state (position=0) is 0.5; expected an integer"),
    ),
)
def test_an_age_that_does_not_increase_is_named(age, expected):
    assert expected in message(windy(age=age))


@pytest.mark.parametrize("outcomes", (0, 1.5, None))
def test_outcomes_must_be_a_number_of_them(outcomes):
    assert f"outcomes is {outcomes!r}; expected an integer of at least 1" in message(windy(outcomes=outcomes))


def test_one_outcome_is_certain():
    assert "those of outcomes 0 to 0 sum to 0.75; expected 1" in message(windy(outcomes=1))


@pytest.mark.long
def test_chance_must_be_the_same_compiled():
    def probability(self, state, action, outcome):
        return 0.25 if ((1 + state[0]) << LAST_BIT > 0) == (outcome == 0) else 0.75

    assert "probability of outcome 0 of action 'left' in state (position=0) is 0.75 compiled, 0.25" in message(
        windy(probability=probability, transition=lambda self, s, a, k, out: _go(s, 0, out))
    )

    def reward(self, state, action, next_state):
        return float((1 + state[0]) << LAST_BIT)

    assert "reward of outcome 0 of action 'left' in state (position=0) is -9" in message(windy(reward=reward))


# A look at a few states before a build ------------------------------------------------------------------------------


def leads_by_half(self, state, action, out):
    out[0] = state[0] + 0.5


@pytest.mark.parametrize(
    ("attributes", "said"),
    [
        ({"transition": lambda self, state, action, out: (0,)}, "returns (0,); expected nothing"),
        ({"transition": leads_by_half}, "writes position = 0.5; expected an integer"),
        ({"reward": lambda self, state, action, next_state: "1"}, "is '1'; expected a finite number"),
        ({"reward": lambda self, state, action, next_state: float(next(COUNTER))}, "expected the same answer"),
        (
            {
                "probability": lambda self, state, action, outcome: 0.7,
                "transition": lambda self, state, action, outcome, out: None,
            },
            "those of outcomes 0 to 0 sum to 0.7; expected 1",
        ),
    ],
)
def test_rules_that_a_build_would_misunderstand_are_refused_before_it(tmp_path, attributes, said):
    with pytest.raises(RuleError) as error:
        pharos.build(corridor(**attributes), tmp_path / "space")
    assert said in str(error.value)


def test_truth_as_a_number_whole_floats_and_actions_that_are_not_there_are_taken_as_ever(tmp_path):
    def transition(self, state, action, out):
        out[0] = float(state[0] + 1 if action == 1 else state[0] - 1)

    attributes = {
        "is_terminal": lambda self, state: int(state[0] == self.length - 1),
        "is_available": lambda self, state, action: int(action == 1 or state[0] > 0),
        "transition": transition,
    }
    assert pharos.build(corridor(**attributes), tmp_path / "space").num_states == 5


@pytest.mark.parametrize(
    ("attributes", "said"),
    [
        ({"actions": ()}, "actions is (); expected a tuple of different names"),
        ({"actions": 2}, "actions is 2; expected a tuple of different names"),
        ({"variables": lambda self: [range(3)]}, "variables() or initial_state() fails: AttributeError"),
        ({"variables": lambda self: {0: range(3)}}, "variables() or initial_state() fails: TypeError"),
        ({"initial_state": lambda self: 0}, "variables() or initial_state() fails: TypeError"),
        ({"initial_states": lambda self: [(0,), (1,)]}, "variables() or initial_state() fails: ValueError"),
        ({"max_episode_steps": "10"}, "max_episode_steps is '10'; expected an integer"),
        ({"max_episode_steps": 2.5}, "max_episode_steps is 2.5; expected an integer"),
    ],
)
def test_declarations_that_no_build_can_begin_with_are_one_line(tmp_path, attributes, said):
    with pytest.raises(RuleError) as error:
        pharos.build(corridor(**attributes), tmp_path / "space")
    assert said in str(error.value) and "\n" not in str(error.value)
