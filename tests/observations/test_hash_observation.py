"""The observation `hash`: a random binary code that tells the state, and nothing of which states are alike."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import pharos
from pharos.errors import ParameterError
from pharos.observations import observe

GRID = pharos.make("simple_grid", height=16, width=16)
CELLS = np.array(list(itertools.product(range(16), range(16))), np.int64)
WORDS = ["1011111101001001", "1010000111000001", "0111111110100111"]


@settings(deadline=None)
@given(bits=st.integers(8, 200), seed=st.integers(0, 2**70))
def test_different_states_have_different_words(bits, seed):
    words = observe(GRID, "hash", bits=bits, seed=seed)(CELLS)
    assert words.shape == (256, bits)
    assert set(np.unique(words)) <= {0, 1}
    assert len(np.unique(words, axis=0)) == 256


def test_words_do_not_change_from_one_release_to_the_next():
    words = observe(GRID, "hash")(CELLS[[0, 1, 255]])
    assert ["".join(map(str, word)) for word in words] == WORDS
    assert (observe(GRID, "hash", seed=1)(CELLS) != observe(GRID, "hash")(CELLS)).any(axis=1).all()


def test_neighbours_are_as_different_as_any_two_states():
    """Of 256 states with 200 bits each: half of the bits, give or take five standard deviations of a mean of 120."""
    observation = observe(GRID, "hash", bits=200)
    words = observation(CELLS).astype(int)
    beside = np.abs(words[:-1] - words[1:]).mean()
    assert abs(beside - 0.5) < 5 * 0.5 / np.sqrt(255 * 200)
    assert abs(words.mean() - 0.5) < 5 * 0.5 / np.sqrt(256 * 200)
    assert (observation.one(CELLS[7]) == words[7]).all()
    assert observation.space.contains(observation.one(CELLS[7]))


@pytest.mark.parametrize("options", [{"bits": 7}, {"bits": True}, {"bits": 10**6}, {"seed": -1}, {"seed": 0.5}])
def test_wrong_options_are_a_line(options):
    with pytest.raises(ParameterError, match=f"hash of simple_grid: {next(iter(options))} is") as error:
        observe(GRID, "hash", **options)
    assert "\n" not in str(error.value)
