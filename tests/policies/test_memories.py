"""Policies with a memory: exact over the histories that they reach, as a twin that goes through all of them says."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import strategies as st

import pharos
from naive.memory import value_of_memory
from pharos.errors import ParameterError
from pharos.policies import policy_value
from pharos.training import Task, evaluate_agent, load_agent, train
from strategies import examples, small_mdps

CHANCE = [{}, {"random": 0.2}, {"sticky": 0.25}, {"sticky": 0.25, "random": 0.2}]


class Cell:
    """h' = tanh(W o + U h), and probabilities softmax(V h'), or their maximum; the state is a nested tuple."""

    def __init__(self, seed, size, num_actions, sharp, hidden=3):
        rng = np.random.default_rng(seed)
        self.w, self.u = rng.normal(size=(size, hidden)), rng.normal(size=(hidden, hidden))
        self.v, self.sharp = 3 * rng.normal(size=(hidden, num_actions)), sharp

    def initial_state(self, n):
        return np.zeros((n, len(self.u))), (np.zeros(n, np.int32),)

    def __call__(self, observations, state, starts):
        hidden, (count,) = state
        assert (starts == (count == 0)).all()
        hidden = np.tanh(observations.reshape(len(observations), -1) @ self.w + hidden @ self.u)
        scores = hidden @ self.v
        if self.sharp:
            return scores.argmax(axis=1), (hidden, (count + 1,))
        scores = np.exp(scores - scores.max(axis=1, keepdims=True))
        return scores / scores.sum(axis=1, keepdims=True), (hidden, (count + 1,))


class Forgetful:
    """A policy of observations that keeps one constant."""

    def __init__(self, policy):
        self.policy = policy

    def initial_state(self, n):
        return np.zeros(n)

    def __call__(self, observations, state, starts):
        return self.policy(observations), state


class Pendulum:
    """Action 0 at even steps, 1 at odd ones, whatever is seen."""

    def initial_state(self, n):
        return np.zeros(n, np.int64)

    def __call__(self, observations, state, starts):
        return state % 2, state + 1


class Rememberer:
    """Plays the bit of the first observation to the end."""

    def __init__(self, column):
        self.column = column

    def initial_state(self, n):
        return np.zeros(n, np.int64)

    def __call__(self, observations, state, starts):
        state = np.where(starts, np.round(observations[:, self.column]).astype(np.int64), state)
        return state, state


def sight_of(classes, num_actions, previous_action=False):
    """What a policy sees of an MDP alone: the class of the state, the previous action, whether it is the first step."""

    def observe(states, previous, elapsed):
        executed = np.where(previous < 0, num_actions, previous) if previous_action else 0 * previous
        return np.stack([classes[states[:, 0]], executed, elapsed == 0], axis=1).astype(np.float32)

    observe.observation = SimpleNamespace(frames=1, irrelevant=0)
    observe.space = SimpleNamespace(shape=(3,))
    space = SimpleNamespace(states=lambda states: np.asarray(states)[:, None])
    return SimpleNamespace(
        observe=observe, space=space, frames=1, previous_action=previous_action, observation="classes"
    )


@pytest.mark.long
@examples(
    150, small_mdps(max_states=4, max_actions=2), st.integers(0, 10**6), st.booleans(), st.booleans(), st.integers(1, 4)
)
def test_the_value_is_that_of_all_histories(mdp, seed, sharp, sees_previous, steps):
    """States that look alike, sticky and random actions, several starts, chance in the rules."""
    mdp, rng = mdp.with_horizon(steps), np.random.default_rng(seed)
    classes = rng.integers(0, 2, mdp.num_states)
    policy, sight = Cell(seed, 3, mdp.num_actions, sharp), sight_of(classes, mdp.num_actions, sees_previous)

    def shown(s, b, is_first):
        previous = np.array([-1 if b == mdp.num_actions else b])
        return sight.observe(np.array([[s]]), previous, np.array([0 if is_first else 7]))[0].tolist()

    expected, histories = value_of_memory(policy, mdp, shown, steps)
    found = policy_value(policy, mdp, lambda: sight, lambda: (-9.0, 9.0))
    assert found.exact
    assert found.value == pytest.approx(expected, abs=found.error_bound + 1e-12)
    assert found.states <= histories + mdp.terminal[mdp.start_states].sum()  # which are asked as well


@pytest.mark.parametrize("chance", CHANCE)
@pytest.mark.parametrize("name", ["simple_grid/4x4-decoy", "frozen_lake/4x4"])
def test_a_policy_that_keeps_nothing_has_the_value_of_one_without_a_memory(name, chance):
    task = Task.of(name, **chance)
    weights = np.random.default_rng(0).normal(size=(task.observer.observe.space.shape[0], task.mdp.num_actions))

    def policy(observations):
        scores = np.exp(observations @ weights)
        return scores / scores.sum(axis=1, keepdims=True)

    plain, kept = evaluate_agent(policy, task), evaluate_agent(Forgetful(policy), task)
    assert kept.exact
    assert kept.value == pytest.approx(plain.value, abs=1e-12)
    assert kept.states <= task.mdp.num_states + len(task.mdp.start_states)


def test_a_memory_that_counts_steps_is_worth_what_its_actions_are():
    task = Task.of("simple_grid/4x4-decoy", horizon=9)
    found = evaluate_agent(Pendulum(), task)
    s, value, steps = int(task.mdp.start_states[0]), 0.0, 0
    while steps < 9 and s >= 0 and not task.mdp.terminal[s]:
        value += task.mdp.rewards[s, steps % 2]
        s, steps = int(task.mdp.next_states[s, steps % 2]), steps + 1
    assert found.exact and found.states == steps
    assert found.value == pytest.approx(value, abs=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("chance", CHANCE)
def test_estimates_agree_with_exact_values_within_their_bound(chance):
    task = Task.of("frozen_lake/4x4", horizon=6, **chance)
    for seed in range(5):
        policy = Cell(seed, task.observer.observe.space.shape[0], 4, sharp=False)
        exact = evaluate_agent(policy, task)
        estimate = evaluate_agent(policy, task, max_states=20, episodes=1000, seed=seed)
        assert exact.exact and not estimate.exact and estimate.episodes == 1000
        assert abs(estimate.value - exact.value) <= estimate.error_bound + exact.error_bound


@pytest.mark.parametrize("length", [1, 4, 32])
def test_a_policy_that_remembers_what_is_seen_first_has_no_regret(length):
    env = pharos.make("memory_chain", memory_length=length)
    task = Task(env, observation="one_hot", observation_options={"seen_first": ["bits"]})
    (bit,) = [i for i, name in enumerate(task.observer.observe.names) if "bits" in name and name.endswith("1")]
    found = evaluate_agent(Rememberer(bit), task)
    assert found.exact and found.value == task.optimal.value_at_start == 1.0
    assert found.states == 2 * (length + 1)
    forgetful = evaluate_agent(Forgetful(lambda seen: np.round(seen[:, bit]).astype(int)), task)
    assert forgetful.value == 0.0  # when it is asked for, the bit is no longer seen


def test_the_most_probable_action_of_a_memory_is_that_of_its_maximum():
    task = Task.of("simple_grid/4x4-decoy", random=0.2, horizon=5)
    size = task.observer.observe.space.shape[0]
    sharp, soft = Cell(1, size, 4, sharp=True), Cell(1, size, 4, sharp=False)
    assert evaluate_agent(soft, task, deterministic=True).value == evaluate_agent(sharp, task).value
    assert evaluate_agent(soft, task).value != evaluate_agent(sharp, task).value


class Shapeless(Forgetful):
    def __call__(self, observations, state, starts):
        return np.zeros(len(observations), int), np.zeros(len(observations) + 1)


class Growing(Forgetful):
    def __call__(self, observations, state, starts):
        return np.zeros(len(observations), int), np.zeros((len(observations), 1 + int(starts.any())))


class Silent(Forgetful):
    def __call__(self, observations, state, starts):
        return np.zeros(len(observations), int), None


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        (Shapeless, r"keeps float64 \(2,\); expected arrays whose first axis is 1 episodes"),
        (Growing, "as it kept before"),
        (Silent, r"keeps object \(\); expected arrays"),
    ],
)
def test_what_is_no_memory_is_refused(kind, message):
    with pytest.raises(ParameterError, match=message):
        evaluate_agent(kind(None), Task.of("simple_grid/4x4-decoy"))


def test_a_memory_goes_with_no_values_of_states_and_no_frames():
    task = Task.of("simple_grid/4x4-decoy", gamma=0.9)
    for options in ({}, {"observation": "vector"}):
        with pytest.raises(ParameterError, match=r"Pendulum: its policy has a memory.* use training.evaluate_agent"):
            pharos.evaluate_policy(task.mdp, Pendulum(), **options)
    frames = Task.of("simple_grid/4x4-decoy", observation="simple_image", observation_options={"frames": 2})
    with pytest.raises(ParameterError, match="has a memory and sees several frames"):
        evaluate_agent(Pendulum(), frames)


# sb3-contrib ----------------------------------------------------------------------------------------------------------


@pytest.mark.long
def test_recurrent_ppo_is_worth_what_it_plays_over_all_histories(tmp_path):
    """Trained, against the twin that feeds its LSTM one history after the other; and read back from its folder."""
    pytest.importorskip("sb3_contrib")
    hyperparameters = {"n_steps": 32, "batch_size": 32, "n_epochs": 1, "policy_kwargs": {"lstm_hidden_size": 8}}
    env = pharos.make("memory_chain", memory_length=3)
    task = Task(env, sticky=0.25)
    options = {"steps": 100, "seed": 0, "hyperparameters": hyperparameters, "out": tmp_path / "run"}
    trained = train("sb3_contrib:RecurrentPPO", env, sticky=0.25, **options)
    states = task.space.states()

    def shown(s, b, is_first):
        return task.observer.observe(states[s][None], np.array([-1]), np.array([0]))[0].tolist()

    expected, histories = value_of_memory(trained.agent, task.mdp, shown, task.horizon)
    found = evaluate_agent(trained.agent, task)
    assert found.exact and found.states <= histories
    assert found.value == pytest.approx(expected, abs=1e-6)
    assert trained.result["final_value"] == found.value
    assert evaluate_agent(load_agent(tmp_path / "run")[1], task).value == found.value


@pytest.mark.long
def test_qrdqn_is_worth_what_its_greedy_actions_are():
    pytest.importorskip("sb3_contrib")
    task = Task.of("simple_grid/4x4-decoy", random=0.2)
    options = {"steps": 300, "seed": 0, "hyperparameters": {"learning_starts": 50}}
    trained = train("sb3_contrib:QRDQN", "simple_grid/4x4-decoy", random=0.2, **options)
    seen = pharos.observe(task.env, "vector")(task.space.states())
    actions, _ = trained.agent.model.predict(seen, deterministic=True)
    expected = pharos.evaluate_policy(task.mdp, np.asarray(actions)).value_at_start
    assert trained.result["final_value"] == pytest.approx(expected, abs=1e-6)
