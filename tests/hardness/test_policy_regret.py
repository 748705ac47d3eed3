"""The expected actor-critic in a kernel: against closed forms, explicit loops, and a wide network of PyTorch."""

from dataclasses import replace

import numpy as np
import pytest
from test_kernel_measures import chain, kernel_of, random_mdp, walk

import pharos
from naive.mdp import executed, matrix_of
from pharos import hardness
from pharos.errors import ParameterError, UndefinedMeasure
from pharos.hardness import (
    Network,
    Representation,
    Rollouts,
    Schedule,
    kernel_policy_regret,
    kernel_regret,
    tangent_kernel,
)
from pharos.hardness.representation import learning
from pharos.mdp import TabularMDP, lazy_actions

ROLLOUTS = Rollouts(steps=100, gradient_steps=5, gae_lambda=0.8)
NAME = "kernel_policy_regret"
SHORT = Schedule(steps=700, gamma=0.9)


def plain_actor_critic(mdp, kernel, schedule, rollouts, ascend=None, descend=None):
    """The definition, node by node (state, previous action; A: none): (greedy, played, episodes) of each rollout."""
    S, A, P, live = mdp.num_states, mdp.num_actions, matrix_of(mdp), ~np.asarray(mdp.terminal)

    def softmax(z):
        return np.exp(z) / np.exp(z).sum(axis=1, keepdims=True)

    optimal = pharos.value_iteration(mdp).value_at_start
    uniform = walk(mdp, np.full((S, A), 1 / A))[1]
    z, v, rows = np.zeros((S, A)), np.zeros(S), []
    for _ in range(0, schedule.steps, rollouts.steps):
        pi = softmax(z)
        best = (z >= z.max(axis=1, keepdims=True) - 1e-6 * np.abs(z).max(axis=1, keepdims=True)).astype(float)
        visits, value = walk(mdp, pi)
        visits = visits.sum(axis=2)
        of_greedy = walk(mdp, best / best.sum(axis=1, keepdims=True))[1]
        regrets = [(optimal - each) / (optimal - uniform) for each in (of_greedy, value)]
        rows.append((*regrets, rollouts.steps / visits.sum()))
        # returns: a linear system in G, of which a state's previous actions are averaged by visits
        d = visits.sum(axis=1)
        joint = np.zeros((S, A, A))
        for s in np.flatnonzero(live):
            share = visits[s] / d[s] if d[s] > 0 else np.eye(A + 1)[A]
            joint[s] = sum(share[b] * executed(mdp, b) for b in range(A + 1))
        gamma, mix = schedule.gamma, rollouts.gae_lambda
        reward = np.einsum("sax,sx->sa", joint, mdp.rewards)
        to = np.einsum("sax,sxt->sat", joint, P * live)
        following = mix * gamma * np.einsum("sat,tb->satb", to, pi).reshape(S * A, S * A)
        base = reward + gamma * (1 - mix) * to @ v
        G = np.linalg.solve(np.eye(S * A) - following, base.ravel()).reshape(S, A)
        d = d / d.sum()
        weight = d[:, None] * pi
        advantage = G - v[:, None]
        advantage = advantage - (weight * advantage).sum()
        advantage = advantage / np.sqrt((weight * advantage**2).sum())
        eta = 1 / (1.05 * np.abs(np.linalg.eigvals(kernel * d)).max())
        target = np.where(d > 0, (pi * G).sum(axis=1), v)
        if descend is not None:
            v, z = descend(d, target, eta), ascend(weight, advantage, pi, eta)
            continue
        for _ in range(rollouts.gradient_steps):
            v = v + eta * kernel @ (d * (target - v))
        for _ in range(rollouts.gradient_steps):
            p = softmax(z)
            counted = advantage.copy()
            for s, a in np.ndindex(S, A):
                far = rollouts.clip_range is not None and abs(p[s, a] / pi[s, a] - 1) > rollouts.clip_range
                if far and (p[s, a] > pi[s, a]) == (advantage[s, a] > 0):
                    counted[s, a] = 0.0
            z = z + eta * kernel @ (d[:, None] * p * (counted - (p * counted).sum(axis=1, keepdims=True)))
    return (np.array(column) for column in zip(*rows, strict=True))


@pytest.mark.long
@pytest.mark.parametrize("sticky", [0.0, 0.3])
@pytest.mark.parametrize("random", [0.0, 0.2])
def test_the_measure_is_what_its_definition_says(sticky, random):
    """With outcomes in the rules, two start states, sticky, random and lazy actions."""
    mdp = lazy_actions(pharos.random_actions(pharos.sticky_actions(random_mdp(), sticky), random), random)
    for kernel in (kernel_of(7), np.eye(7)):
        found = kernel_policy_regret(mdp, Representation.of_matrix(kernel), schedule=SHORT, rollouts=ROLLOUTS)
        greedy, played, episodes = plain_actor_critic(mdp, np.asarray(kernel, float), SHORT, ROLLOUTS)
        assert np.ptp(played) > 0.3
        np.testing.assert_allclose(found.curve.greedy, greedy, atol=1e-3)
        np.testing.assert_allclose(found.curve.played, played, atol=1e-3)
        np.testing.assert_allclose(found.curve.episodes, episodes, rtol=1e-3)
    np.testing.assert_allclose(found.tabular.played, played, atol=1e-3)


@pytest.mark.long
@pytest.mark.parametrize("sticky", [0.0, 0.3])
@pytest.mark.parametrize("clip_range", [0.05, 0.2])
def test_clipping_is_what_its_definition_says(sticky, clip_range):
    """State by state, also where states that look alike are pushed apart."""
    mdp, rollouts = pharos.sticky_actions(random_mdp(), sticky), replace(ROLLOUTS, clip_range=clip_range)
    alike = np.array([0, 1, 1, 3, 3, 5, 6])
    aliased = kernel_of(7)[np.ix_(alike, alike)]
    for kernel, classes in ((kernel_of(7), None), (np.eye(7), None), (aliased, alike)):
        seen = Representation.of_matrix(kernel, classes)
        found = kernel_policy_regret(mdp, seen, schedule=SHORT, rollouts=rollouts)
        greedy, played, _ = plain_actor_critic(mdp, np.asarray(kernel, float), SHORT, rollouts)
        np.testing.assert_allclose(found.curve.greedy, greedy, atol=1e-3)
        np.testing.assert_allclose(found.curve.played, played, atol=1e-3)
        without = kernel_policy_regret(mdp, seen, schedule=SHORT, rollouts=ROLLOUTS)
        assert np.abs(found.curve.played - without.curve.played).max() > 0.01
        assert found.to_dict()["evaluated"] == pytest.approx(np.minimum(played, learning.WORST_GREEDY).mean(), abs=1e-3)
        assert found.conventions["rollouts"]["clip_range"] == clip_range


def test_clipping_stops_a_probability_that_has_moved_far_enough():
    """One state, two actions, one pays: each is pushed until its own probability has left the range."""
    mdp = TabularMDP.from_arrays([[-1, -1]], [[0.0, 1.0]], gamma=1.0, horizon=1)
    rollouts = Rollouts(steps=1, gradient_steps=7, clip_range=0.2)
    seen = Representation.of_matrix(3 * np.eye(1))
    found = kernel_policy_regret(mdp, seen, schedule=Schedule(steps=6), rollouts=rollouts).curve
    logit, expected, ways = 0.0, [], set()
    for _ in range(6):
        first = p = 1 / (1 + np.exp(-logit))
        expected.append((1 - p) / 0.5)
        for _ in range(7):
            up = 0.0 if p / first > 1.2 else np.sqrt((1 - first) / first)
            down = 0.0 if (1 - p) / (1 - first) < 0.8 else np.sqrt(first / (1 - first))
            ways.add((up > 0, down > 0))
            logit += 2 * p * (1 - p) * (up + down) / 1.05
            p = 1 / (1 + np.exp(-logit))
    assert ways == {(True, True), (True, False), (False, False)}
    assert found.played == pytest.approx(expected, abs=1e-6)
    free = kernel_policy_regret(mdp, seen, schedule=Schedule(steps=6), rollouts=replace(rollouts, clip_range=1e9)).curve
    without = kernel_policy_regret(mdp, seen, schedule=Schedule(steps=6), rollouts=replace(rollouts, clip_range=None))
    assert free.played.tolist() == without.curve.played.tolist()


def test_the_identity_is_the_softmax_policy_gradient_of_a_table():
    """One state, two actions, one pays: the difference of logits grows by a step of 2 p (1 - p) in closed form."""
    mdp = TabularMDP.from_arrays([[-1, -1]], [[0.0, 1.0]], gamma=1.0, horizon=1)
    schedule, rollouts = Schedule(steps=5), Rollouts(steps=1, gradient_steps=1)
    found = kernel_policy_regret(mdp, Representation.of_matrix(3 * np.eye(1)), schedule=schedule, rollouts=rollouts)
    logit, expected = 0.0, []
    for _ in range(5):
        p = 1 / (1 + np.exp(-logit))
        expected.append((1 - p) / 0.5)
        # standardised advantages differ by 1 / sqrt(p (1 - p)): z(a) grows by p(a) (A(a) - mean) / 1.05
        logit += 2 * np.sqrt(p * (1 - p)) / 1.05
    for curve in (found.curve, found.tabular):
        assert curve.played == pytest.approx(expected, abs=1e-6)
        assert curve.greedy == pytest.approx([1.0, 0.0, 0.0, 0.0, 0.0], abs=1e-6)
    assert found.conventions["rollouts"] == {"steps": 1, "gradient_steps": 1, "gae_lambda": 0.95}


def test_it_is_part_of_a_report_and_says_what_it_needs():
    mdp, seen = chain(5), Representation.of_matrix(kernel_of(5))
    for rollouts in (None, Rollouts(steps=64)):
        report = hardness.report(mdp, [NAME], representation=seen, schedule=SHORT, rollouts=rollouts)
        direct = kernel_policy_regret(mdp, seen, schedule=SHORT, rollouts=rollouts)
        assert report[NAME].value["value"] == direct.value
    with pytest.raises(UndefinedMeasure, match="kernel_policy_regret is defined for episodes"):
        kernel_policy_regret(chain(horizon=None, gamma=0.9), Representation.of_matrix(np.eye(4)))
    for wrong, words in (
        ({"steps": 0}, "steps is 0"),
        ({"gae_lambda": 1.5}, "gae_lambda is 1.5"),
        ({"clip_range": 0}, "clip_range is 0"),
    ):
        with pytest.raises(ParameterError, match=words):
            Rollouts(**wrong)


@pytest.mark.long
def test_landmarks_say_that_they_are_an_approximation():
    mdp, seen = chain(12, horizon=40), [Representation.of_matrix(kernel_of(12), landmarks=n) for n in (0, 11)]
    exact, approximate = (kernel_policy_regret(mdp, each, schedule=SHORT) for each in seen)
    assert exact.note == ""
    assert "kernel_policy_regret: by 11 landmarks" in approximate.note
    assert approximate.value == pytest.approx(exact.value, abs=0.05)


@pytest.mark.long
def test_wide_networks_trained_by_exact_gradients_have_the_curve():
    """An actor and a critic of 16,384 units each, by gradient descent of PPO's unclipped objective in expectation."""
    torch = pytest.importorskip("torch")
    torch.manual_seed(0)
    mdp = random_mdp()
    x = np.random.default_rng(3).random((7, 3)).astype(np.float32)
    kernel, inputs = tangent_kernel(Network.of("mlp16384"), x), torch.as_tensor(x)

    def net(outputs):
        return torch.nn.Sequential(torch.nn.Linear(3, 16384), torch.nn.ReLU(), torch.nn.Linear(16384, outputs))

    actor, critic = net(3), net(1)
    with torch.no_grad():
        offsets = {each: each(inputs) for each in (actor, critic)}

    def said(each):
        return each(inputs) - offsets[each]

    def trained(each, loss, eta):
        optimizer = torch.optim.SGD(each.parameters(), lr=float(eta))
        for _ in range(ROLLOUTS.gradient_steps):
            optimizer.zero_grad()
            loss().backward()
            optimizer.step()
        with torch.no_grad():
            return said(each).numpy().astype(float)

    def tensors(*arrays):
        return (torch.as_tensor(each, dtype=torch.float32) for each in arrays)

    def descend(d, target, eta):
        weights, goal = tensors(d, target)
        return trained(critic, lambda: (weights * (goal - said(critic)[:, 0]) ** 2).sum() / 2, eta)[:, 0]

    def ascend(weight, advantage, pi, eta):
        weights, gain, before = tensors(weight, advantage, pi)
        return trained(actor, lambda: -(weights * gain * torch.softmax(said(actor), 1) / before).sum(), eta)

    expected = plain_actor_critic(mdp, kernel.astype(float), SHORT, ROLLOUTS, ascend, descend)
    greedy, played, _ = expected
    found = kernel_policy_regret(mdp, Representation.of_matrix(kernel), schedule=SHORT, rollouts=ROLLOUTS).curve
    assert np.ptp(played) > 0.3
    np.testing.assert_allclose(found.greedy, greedy, atol=5e-3)
    np.testing.assert_allclose(found.played, played, atol=5e-3)


def test_a_learner_walks_once_for_a_policy_that_has_settled(monkeypatch):
    asked, visits_of = [], learning.visits_of
    monkeypatch.setattr(
        learning, "visits_of", lambda mdp, policy, *of: asked.append(policy) or visits_of(mdp, policy, *of)
    )
    long = Schedule(steps=20_000, learning_starts=0, exploration_fraction=0.1)
    found = kernel_regret(chain(4), Representation.of_matrix(np.eye(4)), schedule=long).curve
    assert len(found.steps) == 80
    assert 2 * 8 <= len(asked) < 80, "two learners, whose exploration falls for 8 phases, then policies that settle"
