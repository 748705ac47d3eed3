"""Policies of one MDP that are evaluated as one policy of its copies: what each of them is worth alone, to the bit."""

from dataclasses import replace

import numpy as np
import pytest
from test_reach import CHANCES

from pharos import solvers
from pharos.agents import agent_called
from pharos.mdp import TabularMDP, lazy_actions, sticky_actions
from pharos.policies import Evaluation, TableAnswers, is_small_table, table_values
from pharos.training import ChanceSetting, RunConfig, TaskCache, evaluate_agent
from pharos.training.curve import joint_values
from pharos.training.schedule import PreparedRun

SETTING = {"steps": 300, "horizon": 16, "evaluation_interval": 100, "engine": "batched"}


def mdp_of(horizon, starts=1, seed=0, states=9, actions=3):
    """Random next states, some of which are ends; rewards of both signs."""
    rng = np.random.default_rng(seed)
    following, rewards = rng.integers(-1, states, (states, actions)), rng.normal(size=(states, actions))
    following[-1], rewards[-1] = -1, 0.0
    initial = rng.dirichlet(np.ones(starts)) if starts > 1 else np.ones(1)
    initial = np.concatenate([initial, np.zeros(states - starts)])
    return TabularMDP.from_arrays(following, rewards, gamma=0.97, initial=initial, horizon=horizon)


def policies_of(mdp, number, seed=1):
    """Some that draw, some that do not, some whose rows do not sum to 1 to the last bit."""
    rng = np.random.default_rng(seed)
    shape = mdp.num_states, mdp.num_actions
    policies = [rng.dirichlet(np.ones(shape[1]), shape[0]) for _ in range(number)]
    policies[0] = np.eye(shape[1])[rng.integers(shape[1], size=shape[0])]
    policies[1] = policies[1] * (1 + 3e-16)
    return policies


def alone(mdp, policy):
    answers = TableAnswers(policy, mdp)
    answers.reach(None, mdp.horizon)
    solution = solvers.evaluate_policy(*answers.reached_mdp())
    return Evaluation(solution.value_at_start, True, solution.error_bound, len(answers.rows))


@pytest.mark.parametrize("starts", [1, 3])
@pytest.mark.parametrize("chance", CHANCES)
def test_policies_are_worth_among_copies_what_they_are_worth_alone(chance, starts):
    for horizon in (1, 17):
        mdp = chance(mdp_of(horizon, starts))
        policies = policies_of(mdp, 6)
        together = table_values(mdp, policies)
        assert together == [alone(mdp, policy) for policy in policies]
        assert len({each.value for each in together}) == 6
    assert len({each.error_bound for each in together}) > 1


@pytest.mark.parametrize("chance", [CHANCES[0], CHANCES[3]])
def test_tables_are_worth_together_what_they_are_worth_alone(chance, monkeypatch):
    mdp = chance(mdp_of(17, 3))
    tables = list(np.random.default_rng(2).integers(mdp.num_actions, size=(5, mdp.num_states)))
    solutions = [solvers.evaluate_policy(mdp, table) for table in tables]
    wanted = [Evaluation(each.value_at_start, True, each.error_bound, mdp.num_states) for each in solutions]
    assert table_values(mdp, tables) == wanted
    monkeypatch.setattr("pharos.policies.value.MOST_TOGETHER", 2 * 9 * mdp.width)
    assert table_values(mdp, tables) == wanted
    assert len({each.value for each in wanted}) == 5


@pytest.mark.parametrize("kind", ["outcomes", "matrices"])
def test_a_table_of_outcomes_with_one_each_is_a_table_of_next_states(kind):
    """The value and the bound alike: 1 times a number is exact, in whatever arrays the 1 stands."""
    plain = mdp_of(17)
    table, setting = np.asarray(plain.next_states), {"gamma": plain.gamma, "horizon": plain.horizon}
    if kind == "outcomes":
        mdp = TabularMDP.from_outcomes(table[..., None], np.ones((*table.shape, 1)), plain.rewards, **setting)
    else:
        P = np.eye(len(table) + 1)[table][..., :-1]
        mdp = TabularMDP.from_matrices(P, plain.rewards, ends=True, **setting)
    tables = list(np.random.default_rng(2).integers(mdp.num_actions, size=(5, mdp.num_states)))
    alone = [solvers.evaluate_policy(mdp, table) for table in tables]
    wanted = [Evaluation(each.value_at_start, True, each.error_bound, mdp.num_states) for each in alone]
    assert table_values(mdp, tables) == wanted == table_values(plain, tables)


def test_many_copies_are_taken_in_groups(monkeypatch):
    mdp = sticky_actions(mdp_of(5), 0.25)
    policies = policies_of(mdp, 7)
    whole = table_values(mdp, policies)
    monkeypatch.setattr("pharos.policies.value.MOST_TOGETHER", 3 * 9 * 4)
    assert table_values(mdp, policies) == whole


def test_which_mdps_have_copies():
    mdp = mdp_of(5)
    assert is_small_table(mdp) and is_small_table(sticky_actions(mdp, 0.25))
    assert not is_small_table(replace(mdp, horizon=None))
    assert not is_small_table(lazy_actions(mdp, 0.1))
    large = TabularMDP.from_arrays(np.zeros((2**16 + 1, 1), int), np.zeros((2**16 + 1, 1)), horizon=3)
    assert not is_small_table(large)


@pytest.mark.long
@pytest.mark.parametrize("agent", ["dqn", "ppo"])
def test_the_runs_of_a_batch_have_the_values_that_each_has_alone(agent):
    tasks = TaskCache()

    def config(sticky, seed):
        chance = ChanceSetting(sticky=sticky)
        return RunConfig(environment="simple_grid", chance=chance, agent=agent, seed=seed, **SETTING)

    cells = [(sticky, seed) for sticky in (0.25, 0.1) for seed in range(3)]
    group = [PreparedRun(seed, config(sticky, seed), None, tasks) for sticky, seed in cells]
    batch = agent_called(agent).learner(group, "cpu")
    batch.learn([150], lambda point: None)
    values = joint_values(batch, group)
    assert values == {i: evaluate_agent(batch.policy(i), run.task) for i, run in enumerate(group)}
    assert len({each.value for each in values.values()}) > 1
