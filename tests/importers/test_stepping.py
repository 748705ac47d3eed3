"""importers.stepping: environments stepped from every state are the MDPs that their tables and rules say."""

import inspect
import itertools
import random
import threading
import warnings
from fractions import Fraction
from functools import partial

import fake_game
import gymnasium
import numpy as np
import planted
import pytest
from hypothesis import strategies as st

from pharos import bisimulation, importers, value_iteration
from pharos.errors import ParameterError, RuleError, StateSpaceTooLarge, UnknownName
from pharos.importers.chance import BranchingGenerator, BranchingPythonGenerator, DrawError, DrawTree
from pharos.importers.side_effects import SideEffects
from strategies import examples


def distribution(draw, generator=BranchingGenerator, most=3_000):
    """{outcome: probability} of a function of a generator."""
    tree, shares = DrawTree(most), {}
    for _ in tree.runs():
        outcome = draw(generator(tree))
        shares[outcome] = shares.get(outcome, 0) + tree.probability
    return shares


# Chance ---------------------------------------------------------------------------------------------------------------


@examples(100, st.lists(st.integers(0, 9), min_size=1, max_size=6).filter(any))
def test_the_inverse_of_a_distribution_function_gives_back_the_distribution(weights):
    p = np.array(weights) / sum(weights)
    shares = distribution(lambda rng: int(np.argmax(np.cumsum(p) > rng.random())))
    assert sum(shares.values()) <= 1 + Fraction(1, 10**12)
    for index, probability in enumerate(p):
        assert abs(float(shares.get(index, 0)) - probability) <= 2.3e-16


@examples(100, st.integers(1, 6), st.integers(-3, 3), st.integers(1, 5))
def test_whole_parts_of_scaled_numbers_are_uniform(count, low, scale):
    shares = distribution(lambda rng: int(np.floor(rng.uniform(low, low + count))))
    assert shares == {low + k: Fraction(1, count) for k in range(count)}
    shares = distribution(lambda rng: int(rng.random() * count))
    assert shares == {k: Fraction(1, count) for k in range(count)}
    assert distribution(lambda rng: bool(scale * rng.random() - 1 < 0)) in (
        {True: Fraction(1, scale), False: 1 - Fraction(1, scale)},
        {True: Fraction(1)},
        {True: Fraction(float(1 / Fraction(scale))), False: 1 - Fraction(float(1 / Fraction(scale)))},
    )


def test_draws_are_those_of_numpy_and_python():
    third, half = Fraction(1, 3), Fraction(1, 2)
    assert distribution(lambda rng: int(rng.integers(1, 3, endpoint=True))) == dict.fromkeys((1, 2, 3), third)
    assert distribution(lambda rng: int(rng.choice(3))) == dict.fromkeys(range(3), third)
    assert distribution(lambda rng: str(rng.choice(["a", "b", "a"]))) == {"a": 2 * third, "b": third}
    assert distribution(lambda rng: str(rng.choice(["a", "b"], p=[0.75, 0.25]))) == {"a": 3 * half / 2, "b": half / 2}
    assert distribution(lambda rng: tuple(rng.permutation(2).tolist())) == {(0, 1): half, (1, 0): half}
    assert distribution(lambda rng: int(rng.binomial(2, 0.5))) == {0: half / 2, 1: half, 2: half / 2}
    assert distribution(lambda rng: int(np.sign(rng.random(1) - 0.25)[0])) == {-1: half / 2, 1: 3 * half / 2}
    assert len(distribution(lambda rng: tuple(rng.choice(4, 2, replace=False).tolist()))) == 12
    python = partial(distribution, generator=BranchingPythonGenerator)
    assert python(lambda rng: rng.randint(1, 2)) == {1: half, 2: half}
    assert python(lambda rng: tuple(rng.sample("ab", 2))) == {("a", "b"): half, ("b", "a"): half}
    assert python(lambda rng: rng.choices("ab", [1, 3])[0]) == {"a": half / 2, "b": 3 * half / 2}
    assert python(lambda rng: rng.getrandbits(1)) == {0: half, 1: half}


def test_two_comparisons_of_one_number_narrow_it():
    shares = distribution(lambda rng: (lambda u: (bool(u < 0.5), bool(u < 0.25), bool(u > 0.75)))(rng.random()))
    quarter = Fraction(1, 4)
    assert shares == {
        (True, True, False): quarter,
        (True, False, False): quarter,
        (False, False, False): quarter,
        (False, False, True): quarter,
    }


@pytest.mark.parametrize(
    "draw",
    [
        lambda rng: rng.choice(3),
        lambda rng: rng.choice(3, p=[0.2, 0.3, 0.5]),
        lambda rng: rng.choice([0, 1]),
        lambda rng: rng.choice(["a", "b"]),
        lambda rng: rng.choice([1.5, 2]),
        lambda rng: rng.choice([True, False]),
        lambda rng: rng.choice([(0, 1), (1, 2)]),
        lambda rng: rng.choice([None, 1]),
        lambda rng: rng.choice(4, 2),
        lambda rng: rng.binomial(2, 0.5),
        lambda rng: rng.integers(3),
    ],
)
def test_draws_have_the_types_of_numpy(draw):
    """What an environment keeps is compared with what it keeps when it is played with NumPy's own generator."""
    drawn = []
    distribution(lambda rng: drawn.append(draw(rng)))
    rng = np.random.default_rng(0)
    own = {str(value): value for value in (draw(rng) for _ in range(200))}
    for value in drawn:
        assert type(value) is type(own[str(value)])
        assert getattr(value, "dtype", None) == getattr(own[str(value)], "dtype", None)


@pytest.mark.parametrize(
    "draw", [lambda rng: rng.random() ** 2, lambda rng: rng.normal(), lambda rng: float(rng.random())]
)
def test_numbers_themselves_are_refused(draw):
    with pytest.raises(DrawError, match=r"\(test_stepping\.py, line \d+\)"):
        distribution(draw)


# Tables of Gymnasium --------------------------------------------------------------------------------------------------


def rows_of(mdp, outcomes):
    """(offsets of the rows, next states, probabilities, rewards) of an MDP; -1 is the end."""
    if outcomes is not None:
        return outcomes
    matrix = mdp.dynamics.matrix().tocsr()  # its last column is the end
    states = np.where(matrix.indices == mdp.num_states, -1, matrix.indices)
    return matrix.indptr, states, matrix.data, np.repeat(mdp.rewards.ravel(), np.diff(matrix.indptr))


def differing_rows(name, **options):
    """({(state of the table, action): the stepped rows that differ from Gymnasium's}, largest difference of a
    probability in the other rows, MDP, recording); a row is {(next state of the table, or -1; reward): probability}."""
    env = gymnasium.make(name, **options).unwrapped
    mdp, recording = importers.stepping(partial(gymnasium.make, name, **options))
    number = recording.observations.argmax(axis=1)  # one-hot
    offsets, states, p, rewards = rows_of(mdp, recording.outcomes)
    differing, largest = {}, 0.0
    for row in range(len(offsets) - 1):
        s, a = divmod(row, mdp.num_actions)
        ours, theirs = {}, {}
        for i in range(offsets[row], offsets[row + 1]):
            key = (-1 if states[i] < 0 else int(number[states[i]]), float(rewards[i]))
            ours[key] = ours.get(key, 0) + p[i]
        for probability, successor, reward, ended in env.P[number[s]][a]:
            key = (-1 if ended else successor, float(reward))
            theirs[key] = theirs.get(key, 0) + probability
        theirs = {key: probability for key, probability in theirs.items() if probability > 0}
        if set(ours) != set(theirs):
            differing.setdefault((int(number[s]), a), []).append(ours)
        else:
            largest = max([largest, *(abs(ours[key] - theirs[key]) for key in ours)])
    return differing, largest, mdp, recording


@pytest.mark.parametrize(
    ("name", "options", "num_states"),
    [
        pytest.param("FrozenLake-v1", {"is_slippery": False}, 11, id="lake"),
        pytest.param("FrozenLake-v1", {}, 11, id="slippery lake"),
        pytest.param("CliffWalking-v1", {"is_slippery": True}, 37, marks=pytest.mark.long, id="slippery cliff"),
        pytest.param("Taxi-v4", {}, 425, marks=pytest.mark.long, id="taxi"),
    ],
)
def test_tables_of_gymnasium_are_found_again(name, options, num_states):
    differing, largest, mdp, recording = differing_rows(name, **options)
    assert differing == {}
    assert largest <= 1.2e-16
    assert bisimulation.minimize(mdp).num_classes == num_states
    assert recording.time_limit == gymnasium.spec(name).max_episode_steps


@pytest.mark.long
def test_the_fickle_passenger_is_not_in_the_table_and_is_that_of_pharos():
    """72 stepped rows, of 23 rows of the table, do what it does not say; sampled steps do what stepping found.

    They are 7 x 3: moves out of the place where the passenger got in, by destination. Two more come from state 0, in
    which Gymnasium starts where its draw falls into the gap that rounding leaves below 1.
    """
    import pharos

    differing, _, mdp, _ = differing_rows("Taxi-v4", fickle_passenger=True)
    assert sum(map(len, differing.values())) == 72 and len(differing) == 23
    assert sum(state == 16 for state, _ in differing) == 2
    env = gymnasium.make("Taxi-v4", fickle_passenger=True).unwrapped
    env.reset(seed=0)
    for (state, action), rows in differing.items():
        row = rows[0]
        assert all(each == row for each in rows)
        counts = dict.fromkeys(row, 0)
        for _ in range(600):
            env.s, env.fickle_step = state, True
            _, reward, ended, *_ = env.step(action)
            counts[-1 if ended else int(env.s), float(reward)] += 1  # KeyError: impossible by stepping
        assert all(abs(counts[to] / 600 - p) <= 5 * (p * (1 - p) / 600) ** 0.5 for to, p in row.items())
        assert {to: p for p, to, *_ in env.P[state][action]} != {to: p for (to, _), p in row.items()}
    merged = bisimulation.minimize(mdp).mdp
    ours = pharos.build(pharos.make("taxi", fickle=True), progress=False).mdp(gamma=0.99)
    stepped, compiled = (value_iteration(each, 1e-10) for each in (merged, ours))
    assert abs(stepped.value_at_start - compiled.value_at_start) <= 3e-10


def boards(board=(0,) * 9):
    """Boards that go on and have the first player to move, as play can reach them."""
    reachable, front = {board}, [board]
    while front:
        board = front.pop()
        for mine, theirs in itertools.permutations([cell for cell in range(9) if not board[cell]], 2):
            after = list(board)
            after[mine] = 1
            if won(after, 1):
                continue
            after[theirs] = 2
            if not won(after, 2) and tuple(after) not in reachable:
                reachable.add(tuple(after))
                front.append(tuple(after))
    return reachable


def won(board, who):
    return any(all(board[cell] == who for cell in line) for line in planted.TicTacToe.LINES)


@pytest.mark.long
def test_tic_tac_toe_against_a_uniform_opponent_has_the_positions_that_play_can_reach():
    mdp, recording = importers.stepping(planted.TicTacToe, gamma=1.0, check=False)
    shown = {tuple(row.reshape(9, 3).argmax(axis=1).tolist()) for row in recording.observations}
    assert shown == boards()
    assert mdp.num_states == len(shown) == 2423
    assert value_iteration(mdp).value_at_start == pytest.approx(0.9948, abs=1e-4)


@pytest.mark.long
def test_minigrid_is_the_one_that_is_imported_by_its_own_rules():
    pytest.importorskip("minigrid")
    name = "MiniGrid-DoorKey-5x5-v0"
    theirs = importers.minigrid(name, horizon=None, gamma=0.9)
    ours, _ = importers.stepping(
        partial(gymnasium.make, f"minigrid:{name}"),
        seed=0,
        ignore=["step_count"],
        reward=lambda payment: float(payment > 0),
        actions=range(6),
        gamma=0.9,
        check=False,
    )
    merged = [bisimulation.minimize(each).mdp for each in (theirs, ours)]
    assert merged[0].num_states == merged[1].num_states
    first, second = (value_iteration(each, 1e-9) for each in merged)
    assert np.allclose(np.sort(first.v), np.sort(second.v), atol=3e-9)


# Chance of an environment, by hand ------------------------------------------------------------------------------------


def test_a_slip_has_its_probability():
    mdp, recording = importers.stepping(planted.slips)
    assert mdp.num_states == 4
    assert recording.time_limit == 50
    assert recording.observations.tolist() == np.eye(5, dtype=int)[[1, 0, 2, 3]].tolist()
    rows = dict(zip(recording.outcomes.next_states[:2].tolist(), recording.outcomes.probabilities[:2], strict=True))
    assert rows == {0: 0.25, 1: 0.75}


def test_generators_of_all_kinds_are_followed():
    mdp, _ = importers.stepping(planted.ManyGenerators)
    _, states, p, _ = rows_of(mdp, None)
    assert dict(zip(states[:2].tolist(), p[:2].tolist(), strict=True)) == {0: 7 / 8, 1: 1 / 8}


def test_wrappers_count():
    mdp, _ = importers.stepping(planted.sticky, gamma=0.9)
    plain, _ = importers.stepping(planted.Walk, gamma=0.9)
    import pharos

    value = value_iteration(mdp, 1e-10).value_at_start
    assert value == pytest.approx(value_iteration(pharos.sticky_actions(plain, 0.25), 1e-10).value_at_start, abs=1e-9)


def test_a_wrapper_that_draws_shows_each_state_its_own_picture():
    _, recording = importers.stepping(planted.pictured)
    assert recording.observed == "image"
    assert recording.observations[:, 0, :, 0].argmax(axis=1).tolist() == [1, 0, 2, 3]


def test_all_starts_are_drawn():
    mdp, _ = importers.stepping(planted.StartsAnywhere)
    assert mdp.start_states.tolist() == [0, 1, 2, 3]
    assert mdp.start_probabilities.tolist() == [0.25] * 4
    seeded, _ = importers.stepping(planted.StartsAnywhere, seed=0, check=False)
    assert len(seeded.start_states) == 1


@examples(10, st.integers(1, 4))
def test_with_a_horizon_values_are_those_of_all_states(horizon):
    whole, _ = importers.stepping(planted.Slips, check=False)
    part, _ = importers.stepping(planted.Slips, horizon=horizon, check=False)
    import dataclasses

    all_states = dataclasses.replace(whole, gamma=1.0, horizon=horizon)
    assert value_iteration(part).value_at_start == pytest.approx(value_iteration(all_states).value_at_start)


def test_actions_of_several_parts_and_observations_in_a_dictionary():
    mdp, recording = importers.stepping(planted.ManyKinds)
    assert mdp.num_actions == 6
    assert recording.actions == ("0,0", "0,1", "0,2", "1,0", "1,1", "1,2")
    assert recording.observations.shape == (4, 6)
    assert recording.observations[0].tolist() == [1, 0, 0, 0, 0, 0]


# Traps ----------------------------------------------------------------------------------------------------------------


def test_heirs_of_ezpickle_are_copied_with_their_state():
    mdp, _ = importers.stepping(planted.WithEzPickle)
    assert bisimulation.minimize(mdp).num_classes == 4


def test_views_stay_views():
    mdp, _ = importers.stepping(planted.View)
    assert mdp.num_states == 3  # nothing, the first, the second


def test_numbers_of_classes_of_their_own_are_told_apart():
    mdp, _ = importers.stepping(planted.KeepsNumbers)
    assert mdp.num_states == 4


@pytest.mark.long
def test_a_table_that_changes_late_is_copied():
    mdp, _ = importers.stepping(planted.ChangesATable, gamma=1.0)
    assert mdp.num_states == 342
    assert value_iteration(mdp).value_at_start == 7 * 3


def first_line(factory):
    """The number of the first line of code of a method."""
    return inspect.getsourcelines(factory.move)[1] + 1


REFUSED = {
    planted.Forgetful: r"a copy is not in the state of the original",
    planted.HiddenPython: rf"drew from a global generator .*\(planted\.py, line {first_line(planted.HiddenPython)}\)",
    planted.HiddenNumpy: rf"drew from a global generator .*\(planted\.py, line {first_line(planted.HiddenNumpy)}\)",
    planted.ReadsTheTime: r"with the same draws ended in different states \(planted\.py, line \d+\)",
    planted.DrawsAnew: r"with the same draws ended in different states",
    planted.GeneratorOfTheModule: r"with the same draws ended in different states",
    planted.CopiesItself: r"played with its own generators, .* which stepping gives the probabilities 0\.25, 0\.75",
    planted.CountsInTheClass: r"with the same draws ended in different states",
    planted.LazyGenerator: r"made a generator of its own \(numpy\.random\._generator\.Generator\)",
    planted.Rejects: r"more than 200 draws in one step: rejection sampling.*\(planted\.py, line \d+\)",
    planted.Continuous: r"step\(1\) drew normal\(\) \(planted\.py, line \d+\)",
    planted.UsesTheNumber: r"the number itself and not a comparison with it \(planted\.py, line \d+\)",
    planted.CatchesErrors: r"drew normal\(\)",
    planted.StartsThreads: r"started a thread",
    planted.Unpicklable: r"keeps what cannot be copied: field file of Unpicklable \(generator\)",
    planted.Raises: r"step\(0\) raised IndexError: off the map \(planted\.py, line \d+\)",
    planted.Different: r"map differs between two environments that the factory made",
}


@pytest.mark.parametrize("factory", REFUSED, ids=lambda factory: factory.__name__)
def test_refused_in_one_line(factory):
    before = random.getstate(), np.random.get_state(legacy=False)["state"]["pos"]
    with pytest.raises(RuleError, match=REFUSED[factory]) as caught:
        importers.stepping(factory)
    assert "\n" not in str(caught.value)
    assert (random.getstate(), np.random.get_state(legacy=False)["state"]["pos"]) == before


def test_seeding_a_global_generator_is_no_chance():
    mdp, recording = importers.stepping(planted.SeedsItself)
    assert mdp.dynamics.is_deterministic
    assert "seeds the global generators" in "".join(recording.notes)


def test_a_clock_is_named_and_left_out_on_demand():
    mdp, recording = importers.stepping(planted.Clock)
    assert [note for note in recording.notes if note.startswith("elapsed equals the number of steps in every state")]
    assert mdp.num_states > 12
    shorter, recording = importers.stepping(planted.Clock, ignore=["elapsed"])
    assert shorter.num_states == 4
    assert recording.notes == ()


def test_a_start_that_is_drawn_from_a_range_is_imported_with_a_seed():
    mdp, _ = importers.stepping(lambda: gymnasium.make("CartPole-v1"), seed=0, horizon=3)
    assert mdp.num_states == 1 + 2 + 4


def test_a_place_that_begins_at_0_is_no_clock():
    """A step against the wall stays at 0, though each new place is one step farther."""
    _, recording = importers.stepping(planted.Place)
    assert recording.notes == ()


def test_what_is_ignored_must_not_matter():
    with pytest.raises(
        RuleError, match=r"behave differently \(actions [01, ]+: reward \d+ and \d+\): --ignore leaves out"
    ):
        importers.stepping(planted.PaysByTheClock, ignore=["elapsed"])


def test_a_field_to_ignore_must_be_there():
    with pytest.raises(UnknownName, match=r"'elapsd'.*elapsed"):
        importers.stepping(planted.Clock, ignore=["elapsd"])


def test_a_key_is_checked():
    mdp, _ = importers.stepping(planted.Slips, key=planted.cell)
    assert mdp.num_states == 4
    with pytest.raises(RuleError, match="two states with the same key behave differently"):
        importers.stepping(planted.Walk, key=planted.nothing)


def test_vectors_of_rewards_need_weights():
    with pytest.raises(ParameterError, match=r"pays a vector of 2 rewards; give weights"):
        importers.stepping(planted.PaysVectors)
    mdp, _ = importers.stepping(planted.PaysVectors, reward=(10.0, 1.0), gamma=1.0)
    assert value_iteration(mdp).value_at_start == 10 - 3


def test_too_many_states_say_how_far_the_frontier_is():
    with pytest.raises(
        StateSpaceTooLarge, match=r"more than 9 states after \d steps, \d+ to expand; .*--ignore elapsed"
    ):
        importers.stepping(planted.Clock, max_states=9)


def test_other_threads_print_where_they_did(capsys):
    with SideEffects().watched():
        thread = threading.Thread(target=print, args=("a bar",))
        thread.start()
        thread.join()
        print("an environment")
    assert capsys.readouterr().out == "a bar\n"


def test_windows_stay_closed():
    """FrozenLake waits a quarter of a second for each frame that it shows."""
    lake = partial(gymnasium.make, "FrozenLake-v1", is_slippery=False, render_mode="human")
    mdp, recording = importers.stepping(lake, horizon=2, check=False)
    assert mdp.num_states == 5  # the last action is a field: none, and each of four
    assert recording.notes == ("FrozenLake-v1: it shows itself in a window, without which it was stepped",)


def test_what_an_environment_prints_is_one_line_each():
    with warnings.catch_warnings(record=True) as caught:
        _, recording = importers.stepping(planted.Loud)
    assert caught == []
    text = "\n".join(recording.notes)
    assert "lines, the first: hello from the factory" in text
    assert "it warned: old style" in text


@pytest.mark.parametrize("base", [planted.MasksInInformation, planted.MasksInMethod])
def test_action_masks_that_are_not_read_are_named(base):
    mdp, recording = importers.stepping(base)
    assert mdp.available is None
    assert "its action masks are not read" in "".join(recording.notes)


# Games ----------------------------------------------------------------------------------------------------------------


def against(policies=None, player=None):
    return importers.OnePlayer(fake_game.Stones(), player, policies)


def test_a_game_of_two_is_an_mdp_of_one():
    """Of four stones the first takes one. Three are left: a uniform opponent takes one or two, and the rest is won."""
    mdp, recording = importers.stepping(against, gamma=1.0)
    assert value_iteration(mdp).value_at_start == 1.0
    assert recording.observations.argmax(axis=1).tolist() == [4, 2, 1]
    second, _ = importers.stepping(partial(against, player="second"), gamma=1.0)
    assert sorted(second.start_probabilities) == [0.5, 0.5]
    clumsy, _ = importers.stepping(partial(against, {"second": fake_game.clumsy}), gamma=1.0)
    assert clumsy.dynamics.is_deterministic
    assert value_iteration(clumsy).value_at_start == 1.0
    with pytest.raises(ParameterError, match="'third': is no player; expected one of first, second"):
        against(player="third")
