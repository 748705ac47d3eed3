"""Q-learning in a kernel from drawn transitions: against a plain twin, to the bit, and against its expected form."""

import math
from dataclasses import replace

import numpy as np
import pytest
from test_kernel_measures import chain, kernel_of, plain_curve, random_mdp

import pharos
from naive import learning as naive_learning
from pharos import hardness
from pharos.errors import ParameterError, UndefinedMeasure
from pharos.hardness import Network, Representation, Sampling, Schedule, huber_regret, sampled_regret, tangent_kernel
from pharos.hardness.representation.learning import Exact, Identity, Landmarks
from pharos.hardness.representation.sampled_regret import HuberLearner, SampledLearner
from pharos.mdp import TabularMDP, lazy_actions, paid_outcomes, random_actions, sticky_actions

SHORT = Schedule(steps=700, period=50, gradient_steps=13, learning_starts=60, gamma=0.9)
ONCE = Sampling(walks=1, batch_size=8, buffer_size=150)


def plain_walk(
    mdp, kernel, classes, schedule, sampling, episode, steps, start=0.0, largest_error=math.inf, network=None
):
    """Q (C, A) after so many steps of the first walk: the definition in plain Python, with the same random numbers.

    network: an idealised one in the place of the kernel, as of `naive.networks`.
    """
    words = np.random.SeedSequence(sampling.seed, spawn_key=(2,)).generate_state(2, np.uint64)
    rng, noises = naive_learning.SplitMix64(words[0]), naive_learning.SplitMix64(words[1])
    A, C, course = mdp.num_actions, max(classes) + 1, naive_learning.Episodes(mdp, rng, episode)
    sets = {classes[s]: choices for s, choices in enumerate(course.choices)}
    Q, visits, memory = np.zeros((C, A)) + start, np.zeros((C, A)), []
    target, largest_step = Q.copy(), 0.0
    ends = schedule.exploration_fraction * schedule.steps
    for t in range(steps):
        if t % schedule.period == 0 and t + schedule.period > schedule.learning_starts:
            if network is not None:
                network.settle()
            target = Q.copy()
            share = visits.max(axis=1) / max(t, 1)
            root = np.sqrt(share)
            largest = np.linalg.eigvalsh(root[:, None] * np.asarray(kernel, np.float64) * root)[-1]
            if (kernel == np.eye(C)).all():
                largest = share.max()  # to the last bit
            largest_step = 1 / (1.05 * largest) if t else math.inf
        course.begin()
        c, share = classes[course.state], min(1.0, t / ends)
        epsilon = schedule.exploration_initial_eps
        epsilon = epsilon + share * (schedule.exploration_final_eps - epsilon)
        if rng.random() < (epsilon if t >= schedule.learning_starts else 1.0):
            action = course.uniform()
        else:
            (action, *others), ties = sets[c], 1
            for a in others:
                if Q[c, a] > Q[c, action]:
                    action, ties = a, 1
                elif Q[c, a] == Q[c, action]:
                    ties += 1
                    action = a if rng.random() * ties < 1 else action
        reward, new, ended, _ = course.step(action)
        noise = sampling.reward_noise * naive_learning.normal(noises) if sampling.reward_noise else 0.0
        entry = (c, action, None if ended else classes[new], reward / sampling.reward_scale + noise)
        if len(memory) < sampling.buffer_size:
            memory.append(entry)
        else:
            memory[t % sampling.buffer_size] = entry
        visits[c, action] += 1
        late = t - schedule.learning_starts
        if late < 0:
            continue
        grown = [(late + i) * schedule.gradient_steps // schedule.period for i in (0, 1)]
        for _ in range(grown[1] - grown[0]):
            batch = [memory[rng.below(len(memory))] for _ in range(sampling.batch_size)]
            errors = [
                r + (0.0 if d is None else schedule.gamma * max(target[d, sets[d]])) - Q[x, a] for x, a, d, r in batch
            ]
            cut = [error if abs(error) <= largest_error else math.copysign(largest_error, error) for error in errors]
            if network is not None:
                network.learn([(x, a) for x, a, *_ in batch], cut)
                Q = network.outputs.T.copy()
                continue
            likeness = [
                sum(abs(float(kernel[x, y])) for y, b, *_ in batch if a == b) / len(batch) for x, a, *_ in batch
            ]
            step = min(largest_step, 1 / max(likeness)) / len(batch)
            for (x, a, *_), error in zip(batch, cut, strict=True):
                Q[:, a] += step * error * np.asarray(kernel[x], np.float64)
    return Q


class Precise(Exact):
    """A kernel whose largest eigenvalue is known to the last bits."""

    def largest_eigenvalue(self, weights, vector):
        root = np.sqrt(weights)
        return float(np.linalg.eigvalsh(root * np.asarray(self.matrix, np.float64) * root.T)[-1])


def both_walks(mdp, kernel, classes, sampling, *, schedule=SHORT, episode=7, operator=None, of=SampledLearner):
    """Q (C, A) of the first walk, compiled and plain; kernel (S, S), classes (S,)."""
    seen = Representation.of_matrix(kernel, classes, covariance=lambda x, y: kernel[np.ix_(x, y)] / 50)
    learner = of(mdp, seen, schedule, episode)
    learner.sampling, observations = sampling, learner.observations
    some, number = observations.representatives, np.full(mdp.num_states, -1)  # unseen: the end, or out of reach
    number[learner.numbers] = observations.groups
    operator = operator or Precise(lambda x, y: kernel[np.ix_(x, y)], some)
    *_, compiled = learner.walk(observations, operator, np.array([0, schedule.steps]), sampling.seed)
    part = kernel[np.ix_(some, some)]
    more = learner.start(observations, sampling.seed).T, learner.largest_error
    return compiled, plain_walk(mdp, part, number.tolist(), schedule, sampling, episode, schedule.steps, *more)


WORLDS = {
    "plain": lambda: random_mdp(7, 3),
    "random": lambda: random_actions(random_mdp(7, 4), 0.3),
    "sticky": lambda: sticky_actions(random_mdp(7, 5), 0.4),
    "both": lambda: random_actions(sticky_actions(random_mdp(7, 6), 0.4), 0.2),
    "lazy": lambda: lazy_actions(random_mdp(7, 7), 0.3),
    "one outcome": lambda: chain(5),
    "sets": lambda: random_actions(sticky_actions(random_mdp(7, 8, lacks=True), 0.4), 0.2),
}


@pytest.mark.parametrize("name", WORLDS)
@pytest.mark.parametrize("noise", [0.0, 0.7])
def test_a_walk_with_the_identity_is_tabular_q_learning_to_the_bit(name, noise):
    mdp = WORLDS[name]()
    identity = np.eye(mdp.num_states, dtype=np.float32)
    sampling = replace(ONCE, reward_noise=noise)
    compiled, plain = both_walks(mdp, identity, np.arange(mdp.num_states), sampling, operator=Identity())
    assert compiled.any()
    np.testing.assert_allclose(compiled, plain, rtol=1e-12 if noise else 0, atol=0)  # logarithms differ in last bits


@pytest.mark.parametrize("name", WORLDS)
@pytest.mark.parametrize("is_aliased", [False, True])
def test_a_walk_with_a_kernel_is_the_definition(name, is_aliased):
    mdp = WORLDS[name]()
    kernel = np.asarray(kernel_of(mdp.num_states), np.float32)
    classes = np.arange(mdp.num_states) // (2 if is_aliased else 1)
    kernel = kernel[np.ix_(classes, classes)]
    compiled, plain = both_walks(mdp, kernel, classes, ONCE)
    np.testing.assert_allclose(compiled, plain, rtol=1e-9, atol=1e-9 * np.abs(plain).max())


def test_landmarks_at_all_observations_walk_as_the_kernel_does():
    mdp = random_mdp(7, 3)
    kernel = np.asarray(kernel_of(7), np.float32)
    learner = SampledLearner(mdp, Representation.of_matrix(kernel), SHORT, 7)
    learner.sampling, observations = ONCE, learner.observations
    some, looks = observations.representatives, np.array([0, 150])
    exact, approximate = (
        list(learner.walk(observations, each, looks, 0))[-1]
        for each in (
            Exact(lambda x, y: kernel[np.ix_(x, y)], some),
            Landmarks(lambda x, y: kernel[np.ix_(x, y)], some, some),
        )
    )
    np.testing.assert_allclose(approximate, exact, atol=5e-3 * np.abs(exact).max())


def test_the_identity_in_the_place_of_the_kernel_is_the_table_in_both_forms():
    found = sampled_regret(random_mdp(7, 1), Representation.of_matrix(np.eye(7)), schedule=SHORT)
    for curve in (found.descent, found.adam):
        np.testing.assert_allclose(curve.greedy, found.tabular.greedy, atol=1e-6)
    assert found.value == pytest.approx(found.tabular.mean, abs=1e-6)


@pytest.mark.parametrize("seed", [0, 2, 3])  # of 1 two actions are so alike that luck decides
def test_long_walks_with_large_minibatches_tend_to_the_expected_learner(seed):
    mdp, kernel = random_mdp(6, seed), Representation.of_matrix(kernel_of(6))
    short = Schedule(steps=1000, period=50, gradient_steps=20, learning_starts=0, gamma=0.9)
    matrix, errors = np.abs(kernel_of(6)), []

    def learn(q, d, y, eta):  # a minibatch bears a step by the sums of its rows
        step = min(eta, 1 / max((matrix @ d)[d > 0].max(), 1e-12))
        for _ in range(short.gradient_steps):
            q = q + step * kernel_of(6) @ (d * (y - q))
        return q

    expected = np.minimum(plain_curve(mdp, kernel_of(6), short, learn)[0], 1.5).mean()
    for times, size in ((1, 4), (10, 64)):
        longer = replace(short, steps=1000 * times, period=50 * times)
        sampling = Sampling(walks=4, batch_size=size)
        errors.append(abs(sampled_regret(mdp, kernel, schedule=longer, sampling=sampling).descent.mean - expected))
    assert errors[1] < 0.03 and errors[1] < errors[0]


def test_the_scale_of_rewards_changes_nothing():
    mdp, kernel = random_mdp(7, 2), Representation.of_matrix(kernel_of(7))
    small, large = (
        sampled_regret(each, kernel, schedule=SHORT).to_dict() for each in (mdp, mdp.with_rewards(mdp.rewards * 2**40))
    )
    assert small["value"] == pytest.approx(large["value"], abs=1e-9)


@pytest.mark.long
def test_noise_of_rewards_makes_it_harder():
    space = pharos.build(pharos.make("catch", rows=6, columns=3))
    mdp = space.mdp(gamma=1.0).with_horizon(8)
    kernel = pharos.observations.representation(space, "one_hot", "mlp64", initialisation="pytorch")
    regrets = [
        sampled_regret(mdp, kernel, schedule=Schedule(steps=8000), sampling=Sampling(reward_noise=noise)).value
        for noise in (0.0, 1.0, 8.0)
    ]
    assert regrets[0] + 0.02 < regrets[1] < regrets[2]


def test_outcomes_pay_what_is_drawn():
    space = pharos.build(pharos.make("cliff_walking", slippery=True))
    mdp = space.mdp(gamma=1.0)
    outcomes = paid_outcomes(mdp)
    assert set(np.unique(outcomes.rewards)) == {-100.0, -1.0, 0.0}
    assert len(np.unique(mdp.rewards)) > 3
    mean = np.bincount(outcomes.which, outcomes.rewards * outcomes.probabilities, mdp.rewards.size)
    np.testing.assert_allclose(mean, mdp.rewards.ravel(), atol=1e-12)
    replaced = paid_outcomes(mdp.with_rewards(np.where(np.asarray(mdp.terminal)[:, None], 0.0, np.full((38, 4), 0.5))))
    assert set(np.unique(replaced.rewards)) <= {0.0, 0.5}


def test_the_same_seed_gives_the_same_number_and_a_report_has_it():
    mdp, kernel = random_mdp(7, 2), Representation.of_matrix(kernel_of(7))
    first, second = (sampled_regret(mdp, kernel, schedule=SHORT) for _ in range(2))
    assert first.to_dict() == second.to_dict()
    reported = hardness.report(mdp, ["sampled_regret"], representation=kernel, schedule=SHORT)["sampled_regret"]
    assert reported.value == first.to_dict() and reported.certificate.kind == "float64"
    assert "a mean over 3 walks" in reported.certificate.note
    other = sampled_regret(mdp, kernel, schedule=SHORT, sampling=Sampling(seed=5))
    assert not np.array_equal(other.descent.greedy, first.descent.greedy)
    single = sampled_regret(mdp, kernel, schedule=SHORT, sampling=Sampling(walks=1))
    assert math.isnan(single.deviation) and "deviation" not in single.to_dict()
    assert first.descent.walks[0] == single.descent.mean


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"walks": 0}, "walks is 0"),
        ({"batch_size": 2.5}, "batch_size is 2.5"),
        ({"buffer_size": True}, "buffer_size is True"),
        ({"reward_noise": -1.0}, "reward_noise is -1.0"),
        ({"reward_noise": math.nan}, "reward_noise is nan"),
        ({"seed": -1}, "seed is -1"),
    ],
)
def test_what_cannot_be_drawn_is_refused(options, message):
    with pytest.raises(ParameterError, match=message):
        Sampling(**options)


def test_what_it_is_not_defined_for_is_said():
    kernel = Representation.of_matrix(np.eye(4))
    with pytest.raises(UndefinedMeasure, match="sampled_regret is defined for episodes"):
        sampled_regret(chain(horizon=None, gamma=0.9), kernel)
    idle = TabularMDP.from_arrays([[1, 1], [-1, -1]], [[0.0, 0.0], [1.0, 1.0]], gamma=1.0, horizon=3)
    with pytest.raises(UndefinedMeasure, match="uniform play is optimal"):
        sampled_regret(idle, Representation.of_matrix(np.eye(2)))


# With the Huber loss, from a random network ---------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["plain", "both"])
def test_a_walk_with_the_huber_loss_from_a_drawn_start_is_the_definition(name):
    mdp = WORLDS[name]().with_rewards(8 * WORLDS[name]().rewards)  # so that many errors are cut
    kernel = np.asarray(kernel_of(mdp.num_states), np.float32)
    compiled, plain = both_walks(mdp, kernel, np.arange(mdp.num_states), ONCE, of=HuberLearner)
    squared, _ = both_walks(mdp, kernel, np.arange(mdp.num_states), ONCE)
    np.testing.assert_allclose(compiled, plain, rtol=1e-9, atol=1e-9 * np.abs(plain).max())
    assert not np.allclose(compiled, squared, rtol=0.01)


def seen_with(kernel, covariance):
    return Representation.of_matrix(kernel, covariance=lambda rows, columns: covariance[np.ix_(rows, columns)])


def test_a_walk_starts_from_the_gaussian_process_each_action_for_itself():
    covariance = np.asarray(kernel_of(7), np.float64)
    learner = HuberLearner(random_mdp(7, 3), seen_with(kernel_of(7), covariance), SHORT, 7)
    part = covariance[np.ix_(learner.observations.representatives, learner.observations.representatives)]
    starts = np.array([learner.start(learner.observations, seed) for seed in range(4000)])
    scale = np.sqrt(np.outer(np.diag(part), np.diag(part)))
    for a in range(starts.shape[1]):
        np.testing.assert_allclose(starts[:, a].T @ starts[:, a] / 4000 / scale, part / scale, atol=0.07)
    assert np.abs(starts[:, 0].T @ starts[:, 1] / 4000 / scale).max() < 0.07
    assert not learner.start(learner.table, 0).any()


def test_the_covariance_of_outputs_is_that_of_random_networks():
    rng, x = np.random.default_rng(0), np.random.default_rng(1).random((4, 3))
    outputs = []
    for _ in range(3000):  # PyTorch's layers: uniform within 1 / sqrt(inputs)
        values = x
        for inputs, units in ((3, 64), (64, 48), (48, 1)):
            weight, bias = (rng.uniform(-1, 1, shape) / math.sqrt(inputs) for shape in ((inputs, units), units))
            values = values @ weight + bias
            values = np.maximum(values, 0) if units > 1 else values
        outputs.append(values[:, 0])
    found = tangent_kernel(Network.of("mlp64-48"), x, of_outputs=True)
    np.testing.assert_allclose(found, np.cov(np.transpose(outputs)), rtol=0.1)


def test_in_a_small_unit_from_zeros_it_is_the_sampled_learner_and_in_a_large_one_it_is_slower():
    kernel, mdp = np.asarray(kernel_of(7), np.float64), random_mdp(7, 2)
    tiny, huge = (
        huber_regret(mdp.with_rewards(unit * mdp.rewards), seen_with(kernel, 0 * kernel), schedule=SHORT)
        for unit in (2.0**-20, 2.0**20)
    )
    plain = sampled_regret(mdp, Representation.of_matrix(kernel), schedule=SHORT)
    for of_tiny, of_plain in ((tiny.descent, plain.descent), (tiny.adam, plain.adam), (tiny.tabular, plain.tabular)):
        np.testing.assert_allclose(of_tiny.greedy, of_plain.greedy, atol=1e-6)
    assert huge.tabular.mean > tiny.tabular.mean + 0.02


def test_regret_of_a_random_network_is_not_cut_and_a_report_has_it():
    kernel, mdp = np.asarray(kernel_of(5), np.float64), chain(5)
    found = huber_regret(mdp, seen_with(kernel, kernel), schedule=SHORT)
    assert found.value == pytest.approx((found.descent.greedy.mean() + found.adam.greedy.mean()) / 2, abs=1e-12)
    reported = hardness.report(mdp, ["huber_regret"], representation=seen_with(kernel, kernel), schedule=SHORT)
    assert reported["huber_regret"].value == found.to_dict()
    assert reported["huber_regret"].certificate.note.startswith("huber_regret: a mean over 3 walks")
    assert found.to_dict()["conventions"]["clipped"] == {}


@pytest.mark.parametrize("of", [huber_regret, sampled_regret])
def test_a_scale_of_rewards_is_another_unit_of_them_and_noise_is_not_divided(of):
    kernel, mdp = np.asarray(kernel_of(7), np.float64), random_mdp(7, 2)
    seen = seen_with(kernel, kernel / 50)
    for noise in (0.0, 0.5):
        options = {"schedule": SHORT, "sampling": Sampling(walks=1, reward_noise=noise)}
        smaller = of(mdp.with_rewards(mdp.rewards / 8), seen, **options)
        options["sampling"] = replace(options["sampling"], reward_scale=8.0)
        scaled = of(mdp, seen, **options)
        assert scaled.descent.greedy == pytest.approx(smaller.descent.greedy, abs=1e-9)
        assert scaled.conventions["sampling"]["reward_scale"] == 8 and "reward_scale" not in str(smaller.conventions)
    for scale in (0.0, -1.0, math.inf, math.nan):
        with pytest.raises(ParameterError, match=r"reward_scale is .*; expected a number above 0"):
            Sampling(reward_scale=scale)


@pytest.mark.parametrize("spoilt", [lambda k: k * np.nan, lambda k: k * np.inf, lambda k: -k, lambda k: k[:, :-1]])
def test_a_covariance_that_is_none_is_refused(spoilt):
    kernel = np.asarray(kernel_of(7), np.float64)
    seen = Representation.of_matrix(kernel, covariance=lambda rows, columns: spoilt(kernel[np.ix_(rows, columns)]))
    with pytest.raises(ParameterError, match=r"covariance has shape .*; expected finite numbers of shape"):
        huber_regret(random_mdp(7, 1), seen, schedule=SHORT)


def test_without_the_covariance_of_outputs_it_is_undefined():
    with pytest.raises(UndefinedMeasure, match="huber_regret needs the covariance of the network's outputs"):
        huber_regret(random_mdp(7, 1), Representation.of_matrix(np.eye(7)), schedule=SHORT)
