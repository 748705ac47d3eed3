"""What the runs of a batch meet: outcomes as likely as the MDP says, several instances in one batch, any size."""

import numpy as np
import pytest
from scipy.stats import kstest

from batched_runs import learned, outcome, runs_of
from pharos.agents.batched import BatchRun, ObservationSource, inputs
from pharos.agents.batched.lane import BatchedEpisodes
from pharos.environments import make
from pharos.interaction.simulator import RewardChannel
from pharos.kernels import batched as kernels
from pharos.mdp import ChanceSetting, TabularMDP, random_actions, sticky_actions
from pharos.training.task import Task

DQN = {"learning_rate": 0.01, "buffer_size": 50, "learning_starts": 20, "batch_size": 8, "net_arch": [8], "n_envs": 2}
SIGMAS = 5.0


@pytest.fixture(scope="module")
def slippery():
    """Five states; each action has three outcomes, one of which is the end in the last state but one."""
    rng = np.random.default_rng(1)
    successors = rng.integers(0, 4, (5, 2, 3))
    successors[3, :, 2], successors[4] = 4, 4
    probabilities = rng.dirichlet(np.ones(3), (5, 2))
    rewards = np.where(np.arange(5)[:, None, None] == 4, 0.0, rng.normal(size=(5, 2, 3)))
    initial = np.array([0.5, 0.3, 0.2, 0.0, 0.0])
    mdp = TabularMDP.from_outcomes(successors, probabilities, rewards, initial=initial, terminal=np.arange(5) == 4)
    return mdp, successors, probabilities, rewards


def runs_on(mdp, number, **options):
    return [BatchRun(mdp, None, 7, {}, 1, i, 91 * i, **options) for i in range(number)]


def within(counts, probabilities):
    """Whether all counts (K,) are what probabilities (K,) make likely."""
    total = counts.sum()
    spread = np.sqrt(total * probabilities * (1 - probabilities))
    return (np.abs(counts - total * probabilities) <= SIGMAS * spread + 1e-9).all()


@pytest.mark.long
@pytest.mark.parametrize("chance", ("plain", "sticky and random"))
def test_episodes_are_as_likely_as_the_mdp_says(slippery, chance):
    mdp, successors, probabilities, rewards = slippery
    if chance != "plain":
        mdp = random_actions(sticky_actions(mdp, 0.3), 0.2)
    rng = np.random.default_rng(2)
    runs = runs_on(mdp, 40, outcome_rewards=rewards.ravel())
    worlds = BatchedEpisodes(runs, np.array([run.key for run in runs], np.uint64), 5)
    met, executed_after, starts = np.zeros((5, 2, 5)), np.zeros((3, 2, 2)), np.zeros(5)
    np.add.at(starts, worlds.state, 1)
    paid = {(s, a, t): rewards[s, a, successors[s, a] == t] for s in range(5) for a in range(2) for t in range(5)}
    for step in range(400):
        state, previous = worlds.state.copy(), worlds.previous.copy()
        chosen = rng.integers(0, 2, state.shape)
        worlds.step(step, chosen, counts=True)
        ended = worlds.flags & kernels.ENDED > 0
        np.add.at(starts, worlds.state[ended], 1)
        executed = worlds.previous[~ended]
        np.add.at(met, (state[~ended], executed, worlds.next_state[~ended]), 1)
        np.add.at(executed_after, (previous[~ended], chosen[~ended], executed), 1)
        for s, a, t, r in zip(state[~ended], executed, worlds.next_state[~ended], worlds.reward[~ended], strict=True):
            assert r in paid[s, a, t]
        assert (worlds.elapsed <= 6).all()
    assert within(starts, mdp.initial)
    for s in range(3):  # from where no outcome ends
        for a in range(2):
            assert within(met[s, a], np.bincount(successors[s, a], probabilities[s, a], 5))
    if chance == "plain":
        assert (executed_after == executed_after * np.eye(2)).all()
        return
    c = mdp.chance
    for previous, chosen in np.ndindex(2, 2):
        likely = c.chosen * np.eye(2)[chosen] + c.previous * np.eye(2)[previous] + c.uniform / 2
        assert within(executed_after[previous, chosen], likely)


@pytest.mark.long
def test_what_is_executed_is_in_the_sets_and_as_likely_as_it_should_be():
    sets = np.array([[1, 1, 0], [0, 1, 1], [1, 1, 1]], np.bool_)
    free = TabularMDP.from_arrays([[1, 2, 0], [2, 0, 1], [0, 1, 2]], np.zeros((3, 3)), gamma=0.9)
    some = TabularMDP.from_arrays(free.next_states, np.zeros((3, 3)), gamma=0.9, available=sets)
    both = [random_actions(sticky_actions(mdp, 0.3), 0.2) for mdp in (some, free)]
    runs = [run for mdp in both for run in runs_on(mdp, 20)]
    keys = np.array([run.key for run in runs], np.uint64)
    worlds, alone = BatchedEpisodes(runs, keys, 4, 1, inputs.ActionSets.of(runs, "cpu")), BatchedEpisodes(runs, keys, 4)
    rng, counts = np.random.default_rng(2), {}
    for step in range(300):
        state, previous = worlds.state.copy(), worlds.previous.copy()
        chosen = (rng.random((20, 4, 3)) * sets[state[:20]]).argmax(axis=2)
        worlds.step(step, np.concatenate([chosen, chosen]), counts=True)
        alone.step(step, np.concatenate([chosen, chosen]), counts=True)
        # runs without sets are what they are without a neighbour that has some
        assert (worlds.state[20:] == alone.state[20:]).all() and (worlds.previous[20:] == alone.previous[20:]).all()
        goes_on = worlds.flags[:20] & kernels.ENDED == 0
        each = zip(state[:20][goes_on], chosen[goes_on], previous[:20][goes_on], strict=True)
        for key, executed in zip(each, worlds.previous[:20][goes_on], strict=True):
            counts.setdefault(key, np.zeros(3))[executed] += 1
    for (s, a, b), seen in counts.items():
        uniform = sets[s] / sets[s].sum()
        choice = 0.8 * np.eye(3)[a] + 0.2 * uniform
        sticks = b >= 0 and sets[s, b]
        assert within(seen, 0.7 * choice + 0.3 * np.eye(3)[b] if sticks else choice)


@pytest.mark.long
def test_lazy_actions_stay_as_often_as_they_should_and_pay_what_staying_pays(slippery):
    mdp, successors, probabilities, rewards = slippery
    staying = 100.0 + np.arange(10.0).reshape(5, 2)
    runs = runs_on(mdp, 40, outcome_rewards=rewards.ravel(), chance=ChanceSetting(lazy=0.3), staying=staying)
    worlds = BatchedEpisodes(runs, np.array([run.key for run in runs], np.uint64), 5)
    rng, counts, met = np.random.default_rng(3), np.zeros(2), np.zeros(5)
    for step in range(300):
        state, chosen = worlds.state.copy(), rng.integers(0, 2, worlds.state.shape)
        worlds.step(step, chosen, counts=True)
        lazy = worlds.reward >= 100.0
        assert (worlds.reward[lazy] == staying[state, chosen][lazy]).all()
        assert (worlds.next_state[lazy] == state[lazy]).all()
        counts += lazy.sum(), (~lazy).sum()
        here = ~lazy & (state == 1) & (chosen == 0)
        np.add.at(met, worlds.next_state[here], 1)
    assert within(counts, np.array([0.3, 0.7]))
    assert within(met, np.bincount(successors[1, 0], probabilities[1, 0], 5))


@pytest.mark.long
def test_pay_is_late_and_noisy_as_elsewhere_and_returns_are_of_what_is_earned(slippery):
    mdp, *_, rewards = slippery
    late, noisy = {"reward_delay": 3}, {"reward_noise": 2.0}
    ways = [ChanceSetting(**way) for way in ({}, {"reward_delay": 1}, late, noisy, late | noisy)]
    runs = [run for way in ways for run in runs_on(mdp, 8, outcome_rewards=rewards.ravel(), chance=way)]
    worlds = BatchedEpisodes(runs, np.array([run.key for run in runs], np.uint64), 5)
    payments = [RewardChannel(ChanceSetting(reward_delay=delay), 40) for delay in (1, 3)]
    rng, noise = np.random.default_rng(4), []
    for step in range(500):
        actions = np.tile(rng.integers(0, 2, (8, 5)), (5, 1))
        worlds.step(step, actions, counts=True)
        earned, once, thrice, noisy, both = worlds.reward.reshape(5, 40)
        ended = (worlds.flags[:8].ravel() & kernels.ENDED) > 0
        for payment, paid in zip(payments, (once, thrice), strict=True):
            assert np.allclose(payment.pay(earned, np.ones(40, np.bool_), ended), paid, rtol=0, atol=1e-12)
        assert np.allclose(noisy - earned, both - thrice, rtol=0, atol=1e-12)  # named by run and step
        noise.append((noisy - earned) / 2.0)
    noise = np.concatenate(noise)
    assert kstest(noise, "norm").pvalue > 1e-3
    assert abs(np.corrcoef(noise[:-40], noise[40:])[0, 1]) <= SIGMAS / np.sqrt(len(noise))
    assert len({tuple(part) for part in worlds.returns.reshape(5, 8)}) == 1


@pytest.mark.long
def test_returns_are_counted_until_the_end_of_the_training_alone(slippery):
    mdp, *_ = slippery
    runs = runs_on(mdp, 3, gamma=0.5)
    worlds = BatchedEpisodes(runs, np.array([run.key for run in runs], np.uint64), 4)
    episodes, sums = np.zeros(3, np.int64), np.zeros(3)
    running, discount = np.zeros((3, 4)), np.ones((3, 4))
    for step in range(60):
        counts = step < 50
        worlds.step(step, np.full((3, 4), step % 2), counts=counts)
        running += discount * worlds.reward
        discount *= 0.5
        ended = worlds.flags & kernels.ENDED > 0
        if counts:
            episodes += ended.sum(axis=1)
            sums += (running * ended).sum(axis=1)
        running[ended], discount[ended] = 0.0, 1.0
    assert (worlds.episodes == episodes).all()
    assert np.abs(worlds.returns - sums).max() <= 1e-12


def outcomes(runs):
    batch = learned("dqn", runs, [60])
    return [outcome(batch, i) for i in range(len(runs))]


@pytest.fixture(scope="module")
def mixed():
    """Runs of two instances and three kinds of chance with equal observations."""
    tasks = [
        Task.of(make("simple_grid"), sticky=0.25),
        Task.of(make("simple_grid"), random=0.25),
        Task.of(make("simple_grid", height=5, width=3, goal=(4, 2))),
    ]
    sources = [ObservationSource.of(task.space, task.observer.observe) for task in tasks]
    return [
        BatchRun(task.mdp, source, 9 + k, {**DQN, "gamma": 0.9 + 0.01 * k}, 60, k, 5 * k)
        for k, (task, source) in enumerate(zip(tasks, sources, strict=True))
    ]


def test_runs_of_several_instances_learn_as_they_do_alone(mixed):
    assert outcomes(mixed) == [outcomes([run])[0] for run in mixed]


@pytest.mark.long
@pytest.mark.parametrize("observation", ("vector", "simple_image"))
def test_observations_that_fit_no_table_change_nothing(monkeypatch, observation):
    task = Task.of(make("frozen_lake/4x4"), observation=observation)
    runs = runs_of(task, DQN, 2, 60)
    in_table = outcomes(runs)
    monkeypatch.setattr(inputs, "OBSERVED_BYTES", 0)
    assert in_table == outcomes(runs)
