"""The library of faults: its networks against numerical gradients, its switches, and what small runs of it show."""

import numpy as np
import pytest

from pharos.benchmark import faults
from pharos.benchmark.doctor import readings
from pharos.benchmark.examination import NAMES, Witness, examine, learner_of, solved
from pharos.errors import ParameterError, UnknownName


def test_an_update_follows_the_numerical_gradient():
    rng = np.random.default_rng(0)
    network = faults.SmallNetwork(3, 5, 2, rng)
    x, aims = rng.normal(size=(7, 3)).astype(np.float32), rng.normal(size=(7, 2)).astype(np.float32)
    before = [each.astype(np.float64) for each in network.parameters]

    def loss(parameters):
        w1, b1, w2, b2, w3, b3 = parameters
        y = np.maximum(np.maximum(x @ w1 + b1, 0) @ w2 + b2, 0) @ w3 + b3
        return 0.5 * ((y - aims) ** 2).sum()

    numerical = []
    for place, parameter in enumerate(before):
        gradient = np.zeros_like(parameter)
        for index in np.ndindex(*parameter.shape):
            ends = []
            for sign in (1, -1):
                moved = [each.copy() for each in before]
                moved[place][index] += sign * 1e-5
                ends.append(loss(moved))
            gradient[index] = (ends[0] - ends[1]) / 2e-5
        numerical.append(gradient)
    network.update(network(x) - aims, 0.01, limit=1e9)
    for gradient, expected in zip(network.gradients, numerical, strict=True):
        assert np.allclose(gradient, expected, atol=1e-2)
    # the first step of Adam has the size of the rate, against the gradient
    for old, new, gradient in zip(before, network.parameters, numerical, strict=True):
        clear = np.abs(gradient) > 1e-2
        assert np.allclose((new - old)[clear], -0.01 * np.sign(gradient[clear]), atol=1e-4)


def test_there_are_two_dozen_faults_and_others_are_refused():
    assert 24 <= sum(map(len, faults.FAULTS.values())) <= 30
    with pytest.raises(UnknownName, match="target_never_copied"):
        faults.faulty_agent("dqn", "target_never_copyed")
    with pytest.raises(UnknownName, match="dqn"):
        faults.faulty_agent("dqm")
    with pytest.raises(UnknownName, match="gamma_half"):
        next(faults.ppo(None, 10, 0, fault="gamma_haf"))
    # `--set fault=none` arrives as None
    assert faults.faulty_agent("dqn", None).keywords == faults.faulty_agent("dqn").keywords == {"fault": faults.HEALTHY}
    with pytest.raises(AttributeError, match="reset"):
        next(faults.dqn(None, 10, 0, fault=None))


@pytest.mark.long
@pytest.mark.parametrize("agent", faults.FAULTS)
def test_each_fault_runs_and_leaves_what_it_says(agent):
    def seen(fault, worlds=("still",), seeds=(0, 1)):
        return examine(faults.faulty_agent(agent, fault), worlds=worlds, seeds=seeds, steps=400)

    for fault in faults.FAULTS[agent]:
        numbers = readings(seen(fault))
        assert {"gamma", "consistency", "overlap", "regret_still"} <= numbers.keys()
        assert numbers["equal_seeds"] == (fault == "seeds_ignored")
        assert (numbers.get("deaf_last", 0) == 1) == (fault == "last_feature_lost")


def test_actions_are_shifted_and_drawn_when_it_is_judged():
    network = faults.SmallNetwork(2, 4, 3, np.random.default_rng(0))
    x = np.random.default_rng(1).normal(size=(6, 2)).astype(np.float32)
    healthy = faults.Greedy(network, "none")
    assert (faults.Greedy(network, "action_off_by_one")(x).argmax(axis=1) == (healthy(x).argmax(axis=1) + 1) % 3).all()
    drawn = faults.Greedy(network, "plays_at_random")(x)
    assert np.allclose(drawn.max(axis=1), 0.8 + 0.2 / 3) and np.allclose(drawn.sum(axis=1), 1)
    assert np.allclose(faults.Greedy(network, "plays_at_random", 0.1)(x).max(axis=1), 0.9 + 0.1 / 3)
    other = x.copy()
    other[:, -1] = 9
    lost = faults.Greedy(network, "last_feature_lost")
    assert (lost.q_values(x) == lost.q_values(other)).all()
    assert (healthy.q_values(x) != healthy.q_values(other)).any()
    assert faults.encoded(np.full((1, 2), 255, np.uint8), "none").max() == 1
    assert faults.encoded(np.full((1, 2), 255, np.uint8), "bytes_not_divided").max() == 255


# What is seen of a run ------------------------------------------------------------------------------------------------


def test_a_world_is_the_one_that_is_stepped():
    task, world, seen = solved("decoy")
    witness = Witness("decoy", 0, 300)
    env, rng = witness.env, np.random.default_rng(0)
    observation, _ = env.reset(seed=0)
    s = int(world.start.argmax())
    for _ in range(300):
        assert (seen[s] == observation).all()
        action = int(rng.integers(4))
        observation, reward, terminated, truncated, _ = env.step(action)
        assert reward == pytest.approx(world.rewards[s, action])
        after = int(world.transitions[s, action].argmax())
        assert terminated == world.terminal[after]
        s = after
        if terminated or truncated:
            observation, _ = env.reset()
            s = int(world.start.argmax())
    assert task.mdp.num_states == len(seen) == len(world.terminal)


def test_visits_and_cuts_are_those_of_all_copies():
    def learn(env, steps, seed):
        twins = [env.copy(), env.copy()]
        for twin in twins:
            twin.reset()
        for _ in range(steps // 2):
            for twin in twins:
                *_, terminated, truncated, _ = twin.step(2)
                if terminated or truncated:
                    twin.reset()
        yield lambda seen: np.full(len(seen), 2)

    (each,) = examine(learn, worlds=["still"], seeds=[0], steps=180)
    assert each.visits.sum() == 180 and each.visits[:, [0, 1]].sum() == 0
    assert each.cuts.sum() == 180 // 9  # its time limit is 9
    assert each.q is None and each.v is None and each.late.sum() == 36
    assert (each.policy[:, 2] == 1).all()


@pytest.mark.long
def test_values_are_asked_in_another_order_and_with_other_numbers():
    class Table:
        def q_values(self, observations):
            return observations[:, :2] + np.arange(len(observations))[:, None]  # as if rows were mixed up

        def __call__(self, observations):
            return np.zeros(len(observations), int)

    def learn(env, steps, seed):
        env.reset()
        for _ in range(steps):
            env.step(0)
        yield Table()

    (each,) = examine(learn, worlds=["catch"], seeds=[0], steps=50)
    assert each.wavering > 0.1
    assert each.reaction[:2].min() > 0.0 and each.q.shape == (*each.visits.shape[:1], 2)


@pytest.mark.long
def test_a_class_that_is_stepped_is_asked_as_the_object_that_it_is():
    class Stepped:
        def __init__(self, observation_space, action_space, num_envs, seed):
            self.num_actions = action_space.n

        def act(self, observations):
            return np.zeros(len(observations), int)

        def observe(self, *transition):
            pass

        def policy(self, observations):
            return self.q_values(observations).argmax(axis=1)

        def q_values(self, observations):
            return np.tile(observations.sum(axis=1, keepdims=True), self.num_actions)

    (each,) = examine(Stepped, worlds=["memory"], seeds=[0], steps=60)
    assert each.q is not None and each.v is None and (each.policy[:, 0] == 1).all()
    assert np.allclose(each.q[:, 0], solved("memory")[2].sum(axis=1)) and each.visits[:, 1:].sum() == 0


def test_what_is_no_agent_is_refused_in_one_line():
    with pytest.raises(ParameterError, match="yield policy"):
        examine(lambda env, steps, seed: iter(()), worlds=["still"], steps=20)
    with pytest.raises(UnknownName, match="still"):
        examine(faults.faulty_agent("dqn"), worlds=["stil"], steps=20)
    with pytest.raises(ParameterError, match="is a table"):
        learner_of("q_learning")
    with pytest.raises(ParameterError, match="JAX"):
        learner_of(lambda env, params, steps, key: None)
    with pytest.raises(ParameterError, match="found rate; name them behind"):
        learner_of(lambda env, steps, seed: None, {"rate": 1})
    with pytest.raises(UnknownName, match="did you mean 'learning_rate'"):
        learner_of("dqn", {"learning_rat": 1})
    assert len(NAMES) == 12


@pytest.mark.long
@pytest.mark.parametrize("agent", ["stable_baselines3:DQN", "ppo"])
def test_models_of_stable_baselines3_are_asked_for_values(agent):
    pytest.importorskip("stable_baselines3")
    setting = {"learning_starts": 50} if agent != "ppo" else {}
    (each,) = examine(agent, hyperparameters=setting, worlds=["umbrella"], seeds=[0], steps=300)
    assert (each.q is None) == (agent == "ppo") and each.visits.sum() == 300
    values = each.v if each.q is None else each.q
    assert values.std() > 0 and np.isfinite(values).all() and each.wavering < 1e-4
