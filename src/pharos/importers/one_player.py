"""Games of PettingZoo as environments of one player, the others playing by policies that are given."""

from collections.abc import Callable, Mapping
from typing import Any, TypeAlias

import numpy as np

from pharos.errors import ParameterError

OtherPolicy: TypeAlias = Callable[[Any, np.ndarray, Any], Any]
"""(observation, legal actions (A,) bool, generator) -> action."""
MOST_TURNS = 10_000


class OnePlayer:
    """A turn-based game of PettingZoo with Gymnasium's interface, as one of its players sees it.

    A step is the player's move and the others' moves until it is the player's turn again. Its reward is the sum of
    the player's rewards meanwhile. The others may draw from the generator that they get, `np_random`, whose chance
    `stepping` enumerates.

    Args:
        game: of the AEC interface, such as `pettingzoo.classic.tictactoe_v3.env()`.
        player: a name among `possible_agents`; None: the first.
        policies: of the other players, by name; None, and players that are not named: uniform over legal actions.
    Raises:
        ParameterError: there is no such player.
    """

    def __init__(self, game: Any, player: str | None = None, policies: Mapping[str, OtherPolicy] | None = None):
        players = list(game.possible_agents)
        self.game, self.player, self.policies = game, player or players[0], dict(policies or {})
        strangers = sorted({self.player, *self.policies} - set(players))
        if strangers:
            raise ParameterError(f"{strangers[0]!r}: is no player; expected one of {', '.join(players)}")
        self.action_space = game.action_space(self.player)
        space = game.observation_space(self.player)
        self.observation_space = getattr(space, "spaces", {}).get("observation", space)
        self.np_random = np.random.default_rng(0)

    @property
    def unwrapped(self) -> "OnePlayer":
        """This environment: nothing is wrapped around it."""
        return self

    def reset(self, *, seed: int | None = None, options: object = None) -> tuple[Any, dict[str, Any]]:
        """Begin a game; the others move until it is the player's turn."""
        if seed is not None:
            self.np_random = np.random.default_rng(seed)
        self.game.reset(seed=seed, options=options)
        self._others_move()
        return self._shown(self.player)[0], {}

    def step(self, action: object) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Move, and let the others move."""
        self.game.step(action)
        payment = self._payment() + self._others_move()
        ended = self._is_out("terminations")
        return self._shown(self.player)[0], payment, ended, not ended and self._is_out("truncations"), {}

    def _others_move(self) -> float:
        """The player's rewards while the others move."""
        payment = 0.0
        for _ in range(MOST_TURNS):
            if self._is_over():
                return payment
            name = self.game.agent_selection
            if name == self.player:
                return payment
            is_out = self.game.terminations[name] or self.game.truncations[name]
            self.game.step(None if is_out else self._move(name))
            payment += self._payment()
        raise ParameterError(f"{self.player}: had no turn in {MOST_TURNS:,} moves of the others")

    def _move(self, name: str) -> object:
        observation, legal = self._shown(name)
        policy = self.policies.get(name)
        if policy is not None:
            return policy(observation, legal, self.np_random)
        first = int(getattr(self.game.action_space(name), "start", 0))
        return first + int(self.np_random.choice(np.flatnonzero(legal)))

    def _shown(self, name: str) -> tuple[Any, np.ndarray]:
        """(what a player sees, its legal actions)."""
        observation = self.game.observe(name)
        count = int(self.game.action_space(name).n)
        if isinstance(observation, dict) and "action_mask" in observation:
            return observation["observation"], np.asarray(observation["action_mask"], np.bool_)
        return observation, np.ones(count, np.bool_)

    def _payment(self) -> float:
        return float(self.game.rewards.get(self.player, 0.0))

    def _is_over(self) -> bool:
        return self._is_out("terminations") or self._is_out("truncations")

    def _is_out(self, how: str) -> bool:
        return self.player not in self.game.agents or bool(getattr(self.game, how).get(self.player, False))
