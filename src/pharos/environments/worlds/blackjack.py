"""Blackjack: hit or stick against a dealer. Source: Sutton and Barto (2018), example 5.1; Gymnasium's Blackjack-v1."""

from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np

from pharos.environments.base import Environment, Layer, Look, parameter
from pharos.errors import ParameterError

TOTAL, DEALER, ACE, NATURAL, RESULT = range(5)
STICK, HIT = range(2)
PLAYING, LOST, DRAWN, WON = range(4)

LEAST, MOST = 4, 31  # totals: two twos; a bust from a hard 21
CARDS = np.array([1 / 13] * 9 + [4 / 13])  # of ace, 2, ..., 9, and of ten, jack, queen or king
BUST = 22


@dataclass(frozen=True, kw_only=True)
class Blackjack(Environment):
    """Draw cards to come nearer to 21 than the dealer, who shows one of his two cards, but not beyond it.

    State    total of the player, card that the dealer shows (1: ace), whether an ace counts 11 in the total, whether
             the first two cards are an ace and a ten (only if that matters), result of the hand.
    Actions  stick, hit, numbered as in Gymnasium.
    Chance   cards come from an infinite deck: 2 to 9 and the ace 1/13 each, tens and faces 4/13. Outcome k of a hit is
             the card k + 1. Outcomes of sticking are results. Their probabilities follow from the dealer's rule: he
             draws up to 16 and sticks from 17 on, an ace counting 11 if it can.
    Reward   1 for a hand that is won, -1 for one that is lost, 0 for a draw.
    Ends     with a bust, or when the player sticks.
    Limit    100 steps, which no hand needs.
    Ours     a hand that is over keeps its total and the dealer's card, so that it can be looked at.
    Source   Gymnasium Blackjack-v1; Sutton and Barto (2018), "Reinforcement Learning", examples 5.1 and 5.3.

    Attributes:
        sab: the rules of Sutton and Barto, as `gymnasium.make` has them: a natural, that is an ace and a ten, wins
            unless the dealer has one, too. Else it is a 21 like others.
        natural: whether a hand won with a natural pays 1.5, only without `sab`.
    """

    sab: bool = parameter(True)
    natural: bool = parameter(False)

    name = "blackjack"
    actions = ("stick", "hit")
    version = 1
    outcomes = 10
    max_episode_steps = 100
    layers = {
        "dealer": Layer(tuple("A23456789T"), (200, 80, 70), shape="lettered"),
        "total": Layer(tuple("0123456789"), (80, 110, 190), shape="lettered"),
        "ace": Layer(("a", "n"), ((190, 160, 70), (230, 200, 90)), shape="ball"),
        "result": Layer(("L", "D", "W"), ((150, 60, 60), (150, 150, 150), (70, 160, 90)), shape="lettered"),
    }

    look = Look(color="#17BECF")
    instances = {"sutton-barto": {}, "plain": {"sab": False}, "natural": {"sab": False, "natural": True}}
    hyperparameters = {"q_learning": {"default": {"gamma": 1.0}}, "dqn": {"default": {"gamma": 1.0}}}  # by hand

    def validate(self) -> None:
        if self.sab and self.natural:
            raise ParameterError("Blackjack: natural=True with sab=True has no effect; add sab=false")

    @property
    def naturals(self) -> bool:
        """Whether it matters that the first two cards are an ace and a ten."""
        return self.natural or self.sab

    def variables(self):
        return {
            "total": range(LEAST, MOST + 1),
            "dealer": range(1, 11),
            "ace": range(2),
            "natural": range(2 if self.naturals else 1),
            "result": range(4),
        }

    def initial_states(self):
        starts = []
        for dealer, first, second in np.ndindex(10, 10, 10):
            ace = int(min(first, second) == 0)
            total = first + second + 2 + 10 * ace
            state = (total, dealer + 1, ace, int(self.naturals and total == 21), PLAYING)
            starts.append((state, CARDS[dealer] * CARDS[first] * CARDS[second]))
        return starts

    @cached_property
    def cards(self) -> np.ndarray:
        """(10,) float64: probability of each card."""
        return CARDS

    @cached_property
    def results(self) -> np.ndarray:
        """(2, 22, 11, 4) float64: probability of each result of sticking, by (natural, total, card of the dealer)."""
        table = np.zeros((2, BUST, 11, 4))
        for card in range(1, 11):
            totals = dealer_totals(card, card == 1)
            for total in range(LEAST, BUST):
                table[:, total, card, LOST] = totals[total + 1 : BUST].sum()
                table[:, total, card, DRAWN] = totals[total]
                table[:, total, card, WON] = totals[:total].sum() + totals[BUST]
            if self.sab:
                both = CARDS[9] if card == 1 else CARDS[0] if card == 10 else 0.0
                table[1, 21, card] = (0.0, 0.0, both, 1 - both)
        return table

    def probability(self, state, action, outcome):
        if action == HIT:
            return self.cards[outcome]
        if outcome < LOST or outcome > WON:
            return 0.0
        return self.results[state[NATURAL], state[TOTAL], state[DEALER], outcome]

    def transition(self, state, action, outcome, out):
        if action == STICK:
            out[RESULT] = outcome
            return
        total, ace = state[TOTAL] + outcome + 1, state[ACE]
        if outcome == 0 and total + 10 < BUST:
            total, ace = total + 10, 1
        if total >= BUST and ace == 1:
            total, ace = total - 10, 0
        out[TOTAL], out[ACE], out[NATURAL] = total, ace, 0
        if total >= BUST:
            out[RESULT] = LOST

    def is_terminal(self, state):
        return state[RESULT] != PLAYING

    def reward(self, state, action, next_state):
        if next_state[RESULT] == PLAYING:
            return 0.0
        if next_state[RESULT] == WON and next_state[NATURAL] == 1 and self.natural:
            return 1.5
        return float(next_state[RESULT] - DRAWN)

    def grid(self):
        return 3, 2

    def draw(self, state, planes):
        planes[0, 0, 0] = state[DEALER]
        planes[1, 1, 0] = state[TOTAL] // 10 + 1
        planes[1, 1, 1] = state[TOTAL] % 10 + 1
        planes[2, 2, 0] = state[ACE] + state[NATURAL]
        planes[3, 2, 1] = state[RESULT]


@cache
def dealer_totals(total: int, ace: bool) -> np.ndarray:
    """(23,) float64: probability of each final total of the dealer; BUST stands for all beyond 21.

    Args:
        total: of his cards, aces counting 1. ace: whether there is one among them.
    """
    best = total + 10 if ace and total + 10 < BUST else total
    final = np.zeros(BUST + 1)
    if best >= 17:
        final[min(best, BUST)] = 1.0
        return final
    for card in range(1, 11):
        final += CARDS[card - 1] * dealer_totals(total + card, ace or card == 1)
    return final
