"""Rewards that look at the outcome: the mean in tables, the drawn one in episodes, the same by every engine."""

import importlib
from dataclasses import dataclass

import numpy as np
import pytest

import pharos
from pharos.errors import ParameterError, RuleError
from pharos.mdp import rewards_of_outcomes, rewards_of_staying
from worlds import Row

rules = importlib.import_module("pharos.rules.rules")


@dataclass(frozen=True, kw_only=True)
class Toll(Row):
    """A road of four places: on by outcomes 1 and 3, of which the latter meets a toll; outcome 2 stays, 0 is
    impossible."""

    length: int = 4
    chancy: bool = True

    name, variable = "toll", "place"
    actions = ("walk", "run")
    layers = {}

    @property
    def outcomes(self):
        return 4 if self.chancy else 1

    def probability(self, state, action, outcome):
        if not self.chancy:
            return 1.0
        return 0.0 if outcome == 0 else (0.5 if outcome == 1 else 0.25)

    def transition(self, state, action, outcome, out):
        out[0] = min(state[0] + (outcome != 2) * (1 + action), 3)

    def is_terminal(self, state):
        return state[0] == 3

    def reward(self, state, action, next_state, outcome):
        if outcome < 0:
            return 0.125
        return -8.0 if outcome == 3 else 10.0 * outcome + action


@pytest.fixture(params=["compiled", "interpreted"])
def engine(request, monkeypatch):
    if request.param == "interpreted":
        monkeypatch.setattr(rules, "compiled_or_none", lambda *_: None)
    return request.param


@pytest.mark.long
def test_the_mdp_pays_the_mean_and_an_episode_what_is_drawn(engine, tmp_path):
    space = pharos.build(Toll(), tmp_path / engine, progress=False)
    going = ~np.asarray(space.terminal)
    expected = np.array([[0.5 * (10 + a) + 0.25 * (20 + a) + 0.25 * -8.0 for a in (0, 1)]] * going.sum())
    np.testing.assert_allclose(space.mdp().rewards[going], expected, rtol=0, atol=1e-14)
    drawn = rewards_of_outcomes(space)[:18].reshape(-1, 2, 3)  # the last state is terminal
    assert (drawn == [[10.0, 20.0, -8.0], [11.0, 21.0, -8.0]]).all()
    assert (rewards_of_staying(space).array[going] == 0.125).all()
    for options in ({}, {"space": space}):
        envs = pharos.make_vec(Toll(), 400, seed=3, **options)
        envs.reset(seed=3)
        _, rewards, _, _, info = envs.step(np.zeros(400, np.int64))
        places = info["index"] if options else info["state"][:, 0]  # numbered alike
        assert set(rewards[places == 1]) == {10.0, -8.0} and set(rewards[places == 0]) == {20.0}
    one = pharos.GymEnv(Toll(), lazy=0.5)
    paid = set()
    for seed in range(20):
        one.reset(seed=seed)
        paid.add(one.step(0)[1])
    assert paid == {10.0, 20.0, -8.0, 0.125}


@pytest.mark.long
def test_an_instance_without_chance_pays_outcome_0(engine, tmp_path):
    space = pharos.build(Toll(chancy=False), tmp_path / engine, progress=False)
    assert not space.has_chance and space.mdp().rewards[0].tolist() == [0.0, 1.0]
    env = pharos.GymEnv(Toll(chancy=False))
    env.reset()
    assert env.step(1)[1] == 1.0


@pytest.mark.long
def test_the_contract_is_checked_with_the_outcome():
    pharos.check_environment(Toll())

    @dataclass(frozen=True, kw_only=True)
    class Broken(Toll):
        def reward(self, state, action, next_state, outcome):
            return float("nan") if outcome == 3 else 0.0

    with pytest.raises(RuleError, match="reward of outcome 3 of action 'walk' in state"):
        pharos.check_environment(Broken())


@pytest.mark.long
def test_a_reward_function_in_place_of_the_rules_may_look_at_the_outcome(tmp_path):
    space = pharos.build(Toll(), tmp_path / "space", progress=False)

    def outcome_itself(self, state, action, next_state, outcome):
        return float(outcome)

    assert space.mdp(rewards=outcome_itself).rewards[0, 0] == 0.5 * 1 + 0.25 * 2 + 0.25 * 3
    with pytest.raises(ParameterError, match="may be a fifth argument"):
        space.mdp(rewards=lambda state: 0.0)


@pytest.mark.long
def test_the_exported_table_of_a_class_that_nobody_registered_pays_each_outcome(tmp_path):
    """And so it does where only the MDP knows whose states these are."""
    mdp = pharos.build(Toll(), tmp_path / "toll", progress=False).mdp()
    assert "toll" not in pharos.list_environments()
    law = [(round(p, 12), t, r) for p, t, r, _ in pharos.exporters.gym_p(mdp)[0][1]]
    assert sorted(law) == [(0.25, 0, 21.0), (0.25, 2, -8.0), (0.5, 2, 11.0)]
    stays = pharos.evaluate_policy(mdp, lambda seen: np.zeros(len(seen), int), observation="vector")
    walks = pharos.evaluate_policy(mdp, np.zeros(mdp.num_states, int))
    assert stays.value_at_start == pytest.approx(walks.value_at_start, abs=1e-9)
