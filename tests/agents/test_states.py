"""States of several learners in one dictionary, under names that checkpoints have had from the first."""

import numpy as np

from pharos.agents import joined_states, learner_state


def test_names_begin_with_the_number_of_the_learner():
    states = [{"q": np.full(2, i), "rng/key": np.full(1, -i)} for i in range(12)]
    joined = joined_states(states)
    assert list(joined)[:3] == ["0/q", "0/rng/key", "1/q"]
    assert len(joined) == 24
    for i, state in enumerate(states):
        assert list(learner_state(joined, i)) == ["q", "rng/key"]
        assert all((learner_state(joined, i)[name] == array).all() for name, array in state.items())
