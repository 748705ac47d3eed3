"""Pocket cube: rules and net against 24 stickers in space; as many positions at each distance as are published."""

import math

import numpy as np
import pytest
from hypothesis import strategies as st

import pharos
from naive import environments as naive
from pharos.drawing import text_drawing
from solution_lengths import solution_lengths
from strategies import examples

pytestmark = pytest.mark.long  # with each class compiled and walked through in full

SOLVED = (*range(7), *[0] * 7)
# Positions that need 0, 1, 2, ... turns: Jaap Scherphuis, "Mini Cube, the 2x2x2 Rubik's Cube", number of positions;
# the same table is in Wikipedia's "Pocket Cube"
COUNTS = {
    "half": (1, 9, 54, 321, 1847, 9992, 50136, 227536, 870072, 1887748, 623800, 2644),
    "quarter": (*(1, 6, 27, 120, 534, 2256, 8969, 33058, 114149, 360508, 930588, 1350852, 782536, 90280, 276),),
}


@examples(100, st.lists(st.sampled_from(["U", "U2", "U'", "R", "R2", "R'", "F", "F2", "F'"]), max_size=25))
def test_its_net_is_that_of_stickers_turned_in_space(turns):
    env, state, twin = pharos.make("pocket_cube"), SOLVED, naive.PocketCube()
    assert text_drawing(env, state) == twin.net()
    for turn in turns:
        state = env.next_state(state, env.actions.index(turn))
        reward, terminated = twin.step(turn)
        assert text_drawing(env, state) == twin.net()
        assert (env.reward(state, 0, state), env.is_terminal(state)) == (reward, terminated)
    if turns and not env.is_terminal(state):
        assert pharos.make("pocket_cube", scramble=" ".join(turns)).initial_state() == state


@pytest.mark.parametrize("metric", ["half", "quarter"])
def test_the_first_turns_lead_to_as_many_positions_as_published(metric):
    env = pharos.make("pocket_cube", metric=metric)
    counts, frontier, seen = [], {SOLVED}, {SOLVED}
    for _ in range(5):
        counts.append(len(frontier))
        frontier = {env.next_state(state, action) for state in frontier for action in range(env.num_actions)} - seen
        seen |= frontier
    assert tuple(counts) == COUNTS[metric][:5]


@pytest.mark.slow
def test_as_many_positions_need_as_many_turns_as_published():
    """All 3,674,160, the solved one included, though it ends the episode; the start is one of the farthest. Without the
    half turns the same table is that of quarter turns."""
    space = pharos.build(pharos.make("pocket_cube/half"), progress=False)
    assert space.num_states == 3_674_160 == math.factorial(7) * 3**6
    quarters = [i for i, turn in enumerate(space.environment.actions) if not turn.endswith("2")]
    for metric, actions, farthest in (("half", None, 11), ("quarter", quarters, 14)):
        lengths = solution_lengths(space, actions)
        assert tuple(np.bincount(lengths)) == COUNTS[metric]
        assert lengths[0] == lengths.max() == farthest
        assert lengths[space.index(pharos.make(f"pocket_cube/{metric}-4").initial_state())] == 4


def test_twists_sum_to_a_multiple_of_three_and_seeds_draw_all_of_them():
    starts = [pharos.make("pocket_cube", seed=seed).initial_state() for seed in range(300)]
    assert all(sorted(start[:7]) == list(range(7)) and sum(start[7:]) % 3 == 0 for start in starts)
    assert len(set(starts)) == 300
    assert all({start[i] for start in starts} == set(range(7)) for i in range(7))
    assert all({start[i] for start in starts} == {0, 1, 2} for i in range(7, 14))


def test_a_position_takes_one_word():
    from pharos.rules import layout_of

    assert layout_of(pharos.make("pocket_cube").components).num_words == 1


def test_quarter_turns_may_be_scrambled_by_half_turns():
    assert pharos.make("pocket_cube", metric="quarter", scramble="U2,R").scramble == "U2 R"
