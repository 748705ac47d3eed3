"""The observations `hash` and `mixed`: random codes that tell the state, and nothing of which states are alike."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import pharos
from pharos.errors import ParameterError
from pharos.observations import observe
from refusals import refusal
from strategies import examples

GRID = pharos.make("simple_grid", height=16, width=16)
CELLS = np.array(list(itertools.product(range(16), range(16))), np.int64)
WORDS = ["1011111101001001", "1010000111000001", "0111111110100111"]


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
    assert f"hash of simple_grid: {next(iter(options))} is" in refusal(ParameterError, observe, GRID, "hash", **options)


def test_mixed_is_one_hot_and_words_at_its_ends():
    one_hot, mixed = observe(GRID, "one_hot")(CELLS), observe(GRID, "mixed", share=0)(CELLS)
    assert (mixed == one_hot).all()
    signs = 2 * observe(GRID, "hash", bits=32, seed=3)(CELLS) - 1
    words = observe(GRID, "mixed", share=1, seed=3)(CELLS)
    np.testing.assert_allclose(words, signs * np.sqrt(2 / 32), rtol=1e-6)
    assert "share is 1.5" in refusal(ParameterError, observe, GRID, "mixed", share=1.5)
    assert "mixed of simple_grid: seed is -1" in refusal(ParameterError, observe, GRID, "mixed", seed=-1)


@examples(20, share=st.floats(0, 1), more=st.floats(0, 1), seed=st.integers(0, 2**70))
def test_mixed_tells_all_states_keeps_the_length_of_codes_and_grows_by_states(share, more, seed):
    less, larger = sorted((share, more))
    first, second = (observe(GRID, "mixed", share=each, seed=seed)(CELLS) for each in (less, larger))
    assert len(np.unique(first, axis=0)) == len(CELLS)
    np.testing.assert_allclose((first**2).sum(axis=1), 2, rtol=1e-5)
    is_word, is_word_later = (codes.min(axis=1) < 0 for codes in (first, second))
    assert (is_word <= is_word_later).all()
    assert (first[is_word] == second[is_word]).all()
    deviation = np.sqrt(less * (1 - less) / len(CELLS))
    assert abs(is_word.mean() - less) <= 6 * deviation + 1 / len(CELLS)


@pytest.mark.long
def test_a_vector_environment_and_a_kernel_take_mixed():
    grid = pharos.make("simple_grid", height=3, width=3)
    vec = pharos.make_vec(grid, 2, observation="mixed", observation_options={"share": 0.5}, seed=0)
    seen, _ = vec.reset(seed=0)
    space = pharos.build(grid, progress=False)
    mixed = observe(grid, "mixed", share=0.5)
    assert (seen == mixed(np.zeros((2, 2), np.int64))).all()
    every = np.arange(space.num_states)
    kernels = [
        pharos.observations.representation(space, *seen, **options).kernel(every, every)
        for seen, options in ((["one_hot"], {}), (["mixed"], {"share": 0.0}), (["mixed"], {"share": 1.0}))
    ]
    assert (kernels[0] == kernels[1]).all()
    np.testing.assert_allclose(np.diag(kernels[2]), np.diag(kernels[0]), rtol=1e-5)
    likeness = [kernel[~np.eye(len(every), dtype=bool)] / kernel[0, 0] for kernel in kernels]
    assert likeness[2].mean() < likeness[0].mean()
