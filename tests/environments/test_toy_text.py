"""Cliff walking, taxi and blackjack: every entry of Gymnasium's tables, its sampled games, published optima."""

from collections import Counter, defaultdict

import gymnasium
import numpy as np
import pytest

import pharos
from pharos.environments import start_distribution
from pharos.environments.worlds.blackjack import HIT, LOST, PLAYING, STICK, WON


def outcomes_of(env, state, action):
    """next state -> (probability, expected reward times it), by the rules in Python."""
    found = defaultdict(lambda: np.zeros(2))
    for outcome in range(env.outcomes):
        probability = env.probability(state, action, outcome)
        if probability > 0:
            following = env.next_state(state, action, outcome)
            found[following] += probability * np.array([1, env.reward_of(state, action, following, outcome)])
    return found


def assert_table_is_gymnasiums(env, table, state_of, states):
    """Every entry: probabilities and rewards of each next state, and which of them end the episode."""
    for number in states:
        state = state_of(number)
        if env.is_terminal(state):
            continue
        for action, entries in table[number].items():
            expected = defaultdict(lambda: np.zeros(2))
            for probability, following, reward, terminated in entries:
                if probability > 0:
                    expected[state_of(following)] += probability * np.array([1, reward])
                    assert env.is_terminal(state_of(following)) == terminated
            found = outcomes_of(env, state, action)
            assert set(found) == set(expected)
            for following, numbers in expected.items():
                assert found[following] == pytest.approx(numbers, abs=1e-12), (state, action, following)


@pytest.mark.parametrize("slippery", [False, True])
def test_cliff_walking_has_gymnasiums_table(slippery):
    table = gymnasium.make("CliffWalking-v1", is_slippery=slippery).unwrapped.P
    env = pharos.make("cliff_walking", slippery=slippery)
    assert env.has_chance == slippery
    assert_table_is_gymnasiums(env, table, lambda number: divmod(int(number), 12), range(37))  # 37 .. 46 are the cliff


@pytest.mark.long
def test_the_exported_table_of_slippery_cliff_walking_is_gymnasiums():
    theirs = gymnasium.make("CliffWalking-v1", is_slippery=True).unwrapped.P
    space = pharos.build("cliff_walking/4x12-slippery", progress=False)
    mine = pharos.exporters.gym_p(space.mdp(gamma=1.0))
    assert_table_is_gymnasiums(
        space.environment,
        {int(np.ravel_multi_index(space.state(s), (4, 12))): rows for s, rows in numbered(mine, space).items()},
        lambda number: divmod(int(number), 12),
        range(37),
    )
    for s in np.flatnonzero(~space.terminal):
        number = np.ravel_multi_index(space.state(s), (4, 12))
        for action in range(4):
            found, expected = numbered(mine, space)[s][action], theirs[number][action]
            assert law_of(found) == pytest.approx(law_of(expected), abs=1e-12)  # of next state and reward together


def test_rewards_that_are_not_the_environments_are_exported_as_they_are():
    space = pharos.build("cliff_walking/4x12-slippery", progress=False)
    table = pharos.exporters.gym_p(space.mdp(rewards=np.full((38, 4), 0.5)))
    assert {reward for rows in table.values() for row in rows.values() for _, _, reward, _ in row} == {0.5, 0.0}


def numbered(table, space):
    """A table of ours with Gymnasium's numbers of next states."""
    number = [int(np.ravel_multi_index(space.state(s), (4, 12))) for s in range(space.num_states)]
    return {s: {a: [(p, number[t], r, end) for p, t, r, end in row] for a, row in table[s].items()} for s in table}


def law_of(row):
    """(next state, reward, terminated) -> probability."""
    law = Counter()
    for probability, following, reward, terminated in row:
        law[int(following), float(reward), bool(terminated)] += probability
    return dict(law)


@pytest.mark.long
@pytest.mark.parametrize("walk", ["rules", "table"])
def test_slipping_into_the_cliff_from_the_start_pays_another_reward_than_bumping_into_the_wall(walk):
    """Of 30 thousand steps right and left from the start, those that stay there: within five standard errors."""
    space = pharos.build("cliff_walking/4x12-slippery", progress=False)
    paid = {}
    for action, name in ((1, "right"), (3, "left")):
        options = {"space": space, "observation": "index"} if walk == "table" else {}
        envs = pharos.make_vec(space.environment, 30_000, seed=0, **options)
        envs.reset(seed=5)
        _, rewards, _, _, info = envs.step(np.full(30_000, action))
        stays = info["index"] == space.index((3, 0)) if options else (info["state"] == [3, 0]).all(axis=1)
        stayed = rewards[stays]
        assert set(stayed) <= {-100.0, -1.0}
        paid[name] = np.mean(stayed == -100)
    assert paid["right"] == pytest.approx(1 / 2, abs=0.02)  # right falls, down bumps, up walks
    assert paid["left"] == 0


@pytest.mark.slow
def test_cliff_walking_takes_thirteen_steps_along_the_edge():
    """Sutton and Barto (2018), example 6.6: the optimal path is worth -13 without discount."""
    space = pharos.build("cliff_walking", progress=False)
    assert space.num_states == 38  # 48 cells without the 10 of the cliff
    assert pharos.value_iteration(space.mdp(gamma=1.0), horizon=300).value_at_start == -13


@pytest.mark.parametrize("rain", [None, 0.8, 0.55])
def test_taxi_has_gymnasiums_table(rain):
    options = {} if rain is None else {"is_rainy": True, "rainy_probability": rain}
    theirs = gymnasium.make("Taxi-v4", **options).unwrapped
    env = pharos.make("taxi", **({} if rain is None else {"rainy": True, "rainy_probability": rain}))
    assert_table_is_gymnasiums(env, theirs.P, lambda number: (*theirs.decode(number), 0), range(500))
    states, probabilities = start_distribution(env)
    assert set(probabilities) == {1 / 300}
    assert {theirs.encode(*state[:4]) for state in states} == set(np.flatnonzero(theirs.initial_state_distrib))


@pytest.mark.long
def test_404_of_500_states_of_the_taxi_can_be_reached():
    space = pharos.build("taxi", progress=False)
    assert (space.num_states, space.num_terminal_states) == (404, 4)


@pytest.mark.slow
def test_fickle_passengers_are_those_of_gymnasium():
    """30 thousand of Gymnasium's games in the rain: after the first move with the passenger, the destinations."""
    theirs = gymnasium.make("Taxi-v4", is_rainy=True, fickle_passenger=True, fickle_probability=0.4).unwrapped
    env = pharos.make("taxi", rainy=True, fickle=True, fickle_probability=0.4)
    start, games, seen = theirs.encode(2, 2, 4, 1), 20_000, Counter()
    theirs.reset(seed=1)
    for _ in range(games):
        theirs.reset()
        theirs.s = start
        seen[theirs.decode(theirs.step(3)[0])] += 1
    found = outcomes_of(env, (2, 2, 4, 1, 1), 3)
    assert sum(p for p, _ in found.values()) == pytest.approx(1)
    law = defaultdict(float)
    for following, (probability, _) in found.items():
        law[following[:4]] += probability
        assert following[4] == 0  # no wall stops a taxi there: it has moved
    assert set(seen) == set(law)
    for following, probability in law.items():
        assert abs(seen[following] - games * probability) < 5 * np.sqrt(games * probability * (1 - probability))
    settled = outcomes_of(env, (2, 2, 4, 1, 0), 3)
    assert {following[3] for following in settled} == {1}  # he changes his mind at most once


def test_a_larger_town_has_landmarks_in_its_corners():
    env = pharos.make("taxi", size=3, walls="0,0", landmarks="0,0; 2,2; 0,2")
    assert (env.outcomes, env.max_episode_steps) == (1, 72)
    assert env.next_state((0, 0, 3, 1, 0), 2) == (0, 0, 3, 1, 0)  # a wall
    assert env.next_state((1, 0, 3, 1, 0), 2) == (1, 1, 3, 1, 0)
    assert pharos.make("taxi", size=7).landmarks == ((0, 0), (0, 6), (6, 0), (6, 6))


def naive_value(total, dealer, ace):
    """The optimal value of a hand and what to do, by a recursion over cards drawn one by one."""
    key = (total, dealer, ace)
    if key not in _values:
        stick = sum(p * np.sign(total - (0 if t > 21 else t)) for t, p in dealer_law(dealer).items())
        hit = 0.0
        for card in (1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 10, 10, 10):
            hard = total - 10 * ace + card
            soft = (ace or card == 1) and hard + 10 <= 21
            hit += (-1.0 if hard > 21 else naive_value(hard + 10 * soft, dealer, int(soft))[0]) / 13
        _values[key] = (max(stick, hit), STICK if stick >= hit else HIT)
    return _values[key]


_values: dict = {}


def dealer_law(*cards):
    """Final total -> probability, for a dealer who holds these cards and draws as the rules say."""
    if cards not in _laws:
        total = sum(cards)
        total += 10 * (1 in cards and total + 10 <= 21)
        law = defaultdict(float)
        if total >= 17 and len(cards) > 1:
            law[total] = 1.0
        else:
            for card in (1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 10, 10, 10):
                for final, probability in dealer_law(*sorted((*cards, card))).items():
                    law[final] += probability / 13
        _laws[cards] = dict(law)
    return _laws[cards]


_laws: dict = {}


@pytest.fixture(scope="module")
def blackjack():
    space = pharos.build("blackjack/plain", progress=False)
    return space, pharos.value_iteration(space.mdp(gamma=1.0), horizon=100)


@pytest.mark.long
def test_the_optimal_policy_of_blackjack_is_that_of_the_book(blackjack):
    """Sutton and Barto (2018), figure 5.2, without and with a usable ace; it is drawn from a total of 11 on."""
    space, solution = blackjack
    for dealer in range(1, 11):
        hard = 13 if dealer in (2, 3) else 12 if dealer in (4, 5, 6) else 17
        soft = 19 if dealer in (1, 9, 10) else 18
        for total in range(11, 22):
            for ace, threshold in ((0, hard), (1, soft)):
                if ace and total < 12:
                    continue
                action = int(solution.policy[space.index((total, dealer, ace, 0, PLAYING))])
                expected = STICK if total >= threshold else HIT
                assert action == expected == naive_value(total, dealer, ace)[1], (total, dealer, ace)


@pytest.mark.long
def test_values_of_blackjack_are_those_of_a_recursion_over_cards(blackjack):
    space, solution = blackjack
    for index in range(space.num_states):
        total, dealer, ace, _, result = space.state(index)
        if result == PLAYING:
            assert solution.v[index] == pytest.approx(naive_value(total, dealer, ace)[0], abs=1e-12)
    starts, probabilities = start_distribution(space.environment)
    expected = sum(p * naive_value(*state[:3])[0] for state, p in zip(starts, probabilities, strict=True))
    assert solution.value_at_start == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("rules", [{"sab": False}, {"sab": False, "natural": True}, {"sab": True}])
def test_sticking_is_worth_what_gymnasiums_games_pay(rules):
    """4,000 of Gymnasium's hands for each of four, naturals among them."""
    theirs = gymnasium.make("Blackjack-v1", **rules).unwrapped
    env = pharos.make("blackjack", **rules)
    theirs.reset(seed=3)
    for cards, dealer in (([1, 10], 10), ([1, 10], 1), ([10, 9], 6), ([5, 10, 6], 10)):
        paid = Counter()
        for _ in range(4000):
            theirs.player, theirs.dealer = list(cards), [dealer, int(theirs.np_random.choice(DECK))]
            paid[float(theirs.step(0)[1])] += 1
        total, natural = sum(cards) + 10 * (1 in cards), len(cards) == 2 and 1 in cards
        state = (total, dealer, int(1 in cards), int(natural and env.naturals), PLAYING)
        law = Counter()
        for outcome in range(LOST, WON + 1):
            following = env.next_state(state, STICK, outcome)
            law[env.reward(state, STICK, following)] += env.probability(state, STICK, outcome)
        for reward, probability in law.items():
            assert abs(paid[reward] - 4000 * probability) <= 5 * np.sqrt(4000 * probability * (1 - probability)) + 1e-6


DECK = [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 10, 10, 10]


def test_starts_of_blackjack_are_two_cards_and_the_dealers():
    states, probabilities = start_distribution(pharos.make("blackjack/natural"))
    law = dict(zip(states, probabilities, strict=True))
    assert sum(p for state, p in law.items() if state[3]) == pytest.approx(2 * 4 / 13**2)
    assert sum(p for state, p in law.items() if state[0] == 4) == pytest.approx(1 / 13**2)
    assert sum(p for state, p in law.items() if state[1] == 10) == pytest.approx(4 / 13)
