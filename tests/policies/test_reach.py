"""What every policy reaches that gives each action a chance: asked about at once, it is what levels give."""

from dataclasses import replace

import numpy as np
import pytest

from pharos.errors import ParameterError
from pharos.mdp import TabularMDP, random_actions, sticky_actions
from pharos.policies import TableAnswers, reachable_rows
from pharos.training import Task, evaluate_agent

CHANCES = [
    lambda mdp: mdp,
    lambda mdp: random_actions(mdp, 0.1),
    lambda mdp: sticky_actions(mdp, 0.25),
    lambda mdp: random_actions(sticky_actions(mdp, 0.25), 0.1),
]


def mdp_of(horizon=6, states=40, actions=3):
    rng = np.random.default_rng(3)
    following = rng.integers(-1, states, (states, actions))
    return TabularMDP.from_arrays(following, rng.normal(size=(states, actions)), initial=[2, 5], horizon=horizon)


def drawing(mdp):
    return np.random.default_rng(4).dirichlet(np.ones(mdp.num_actions), mdp.num_states)


def greedy(mdp):
    return np.eye(mdp.num_actions)[np.random.default_rng(5).integers(mdp.num_actions, size=mdp.num_states)]


@pytest.mark.parametrize("most", [7, 1000])
@pytest.mark.parametrize("chance", CHANCES)
def test_rows_that_are_asked_about_at_once_are_those_that_are_met_level_by_level(chance, most):
    mdp = chance(mdp_of())
    policies = [drawing(mdp)] + ([greedy(mdp)] if mdp.chance.uniform > 0 else [])
    for policy in policies:
        slow, quick = TableAnswers(policy, mdp), TableAnswers(policy, mdp)
        is_whole = slow.reach(most, mdp.horizon)
        assert quick.query_all(lambda: reachable_rows(mdp, most, mdp.horizon)) is is_whole
        assert is_whole == (most == 1000)
        if not is_whole:  # which an estimate needs not be asked about
            assert len(quick.rows) == 0 < len(slow.rows)
            continue
        assert quick.rows.tolist() == slow.rows.tolist()
        assert quick.probabilities.tobytes() == slow.probabilities.tobytes()
        assert (quick.index(slow.rows) == np.arange(len(slow.rows))).all()


@pytest.mark.parametrize("chance", [CHANCES[0], CHANCES[2]])
def test_a_policy_that_gives_an_action_no_chance_is_not_asked_so(chance):
    mdp = chance(mdp_of())
    partly = drawing(mdp)
    partly[17] = [1.0, 0.0, 0.0]  # not where episodes start
    for policy, is_asked in ((greedy(mdp), False), (partly, True)):
        answers, calls = TableAnswers(policy, mdp), []
        assert answers.query_all(lambda calls=calls: calls.append(1) or reachable_rows(mdp, 1000, 6)) is None
        assert len(answers.rows) == 0 and bool(calls) == is_asked


@pytest.mark.long
@pytest.mark.parametrize("most", [3, 100_000])
def test_an_agent_is_worth_the_same_again(most):
    task = Task.of("simple_grid", sticky=0.2)

    def policy(observations):
        scores = np.stack([observations[:, 0] * k + observations[:, 1] / (k + 1) for k in range(4)], 1)
        return np.exp(scores) / np.exp(scores).sum(1, keepdims=True)

    whole = evaluate_agent(policy, task, max_states=most)
    for _ in range(2):
        found = evaluate_agent(policy, task, max_states=most, again=True)
        assert replace(found, states=whole.states) == whole
        assert found.states == whole.states or not found.exact
    assert whole.exact == (most > 3)
    with pytest.raises(ParameterError):
        evaluate_agent(lambda observations: np.full((len(observations), 4), np.nan), task, again=True)


@pytest.mark.parametrize(
    "slippery, chance", [(False, {"sticky": 0.2}), (False, {"sticky": 0.2, "random": 0.1}), (True, {})]
)
def test_a_greedy_policy_under_chance_is_asked_in_blocks_and_once_about_each_state(slippery, chance):
    lake, asked = {"size": 8, "slippery": slippery}, []
    task = Task.of("frozen_lake", lake, **chance)

    def policy(observations):
        asked.append(observations)
        return 1 + (observations[:, :2].sum(axis=1) * 97).astype(int) % 2  # down or right

    level_by_level = evaluate_agent(policy, task)
    levels, states = len(asked), sum(map(len, asked))
    assert len(np.unique(np.concatenate(asked), axis=0)) == states > levels > 3
    asked.clear()
    assert evaluate_agent(policy, task, again=True) == level_by_level
    assert len(asked) <= 2  # where episodes start, and the rest
    assert len(np.unique(np.concatenate(asked), axis=0)) == sum(map(len, asked))
    # a policy that sees the previous action has an answer for each
    asked.clear()
    seeing = Task.of("frozen_lake", lake, previous_action=True, **chance)
    evaluate_agent(policy, seeing)
    rows = sum(map(len, asked))
    assert len(np.unique(np.concatenate(asked), axis=0)) == rows > states
