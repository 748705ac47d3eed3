"""What one would naturally write first works, or says in one line what to write."""

import numpy as np
import pytest

import pharos
from pharos import exporters, hardness, solvers
from pharos.errors import ParameterError
from refusals import refusal

ENV = pharos.make("frozen_lake/4x4")


@pytest.fixture(scope="module")
def space():
    return pharos.build("frozen_lake/4x4")


FUNCTIONS = [
    pharos.value_iteration,
    solvers.uniform_value,
    solvers.worst_value,
    lambda mdp: pharos.evaluate_policy(mdp, np.zeros(16, int)),
    lambda mdp: solvers.evaluate_policy(mdp, np.zeros(16, int)),
    lambda mdp: pharos.sticky_actions(mdp, 0.25),
    lambda mdp: pharos.random_actions(mdp, 0.25),
    lambda mdp: hardness.effective_horizon(mdp, horizon=5),
    lambda mdp: hardness.sum_of_reciprocal_gaps(mdp=mdp),
    lambda mdp: exporters.drn(mdp, "lake.drn"),
    *(hardness.diameter, hardness.start_eccentricity, hardness.report, hardness.gaps, hardness.minimal_gap),
    *(hardness.covering, hardness.environmental_value_norm, hardness.distribution_mismatch, hardness.occupancy),
]


@pytest.mark.parametrize("function", FUNCTIONS)
def test_what_is_no_mdp_is_answered_with_what_to_write(function, space):
    for value, remedy in (
        ("frozen_lake/4x4", "write pharos.build('frozen_lake/4x4').mdp(gamma=0.99)"),
        (ENV, "write pharos.build(env).mdp(gamma=0.99)"),
        (space, "write space.mdp(gamma=0.99)"),
        (3, "write pharos.build(env).mdp(gamma=0.99), or TabularMDP.from_arrays"),
    ):
        assert remedy in refusal(ParameterError, function, value)


def test_names_stand_for_environments(space):
    assert pharos.build(ENV).num_states == space.num_states == 16
    assert pharos.observe("breakout/12x8x1", "vector").env == pharos.make("breakout/12x8x1")
    with pytest.raises(ParameterError, match="unknown environment 'frozen_lak/4x4'; did you mean"):
        pharos.build("frozen_lak/4x4")
    assert "expected an Environment: write pharos.make" in refusal(ParameterError, pharos.build, 3)
    with pytest.raises(ParameterError, match=r"expected a name, such as 'frozen_lake/4x4': write FrozenLake\(\)"):
        pharos.make(type(ENV))
    assert "expected a name, such as" in refusal(ParameterError, pharos.make, ENV)
