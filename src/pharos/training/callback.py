"""A callback of Stable-Baselines3 that stops at chosen steps, and counts the returns of finished episodes.

Algorithms that learn from whole rollouts, such as PPO, take the steps of their last rollout although fewer are left;
episodes that end after the last point are not counted.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback


class AtPoints(BaseCallback):
    """Calls at_point(steps, episodes, sum of returns) whenever `points` are passed, and logs what it returns.

    Args:
        gamma: discount of returns.
        finished: episodes and sum of returns before.
        earned: gives what the last step earned, (N,), of which returns are; agents may be paid otherwise.
    """

    def __init__(
        self,
        points: list[int],
        at_point: Any,
        gamma: float,
        finished: tuple[int, float],
        earned: Callable[[], np.ndarray],
    ):
        super().__init__()
        self._earned = earned
        self.points, self.at_point, self.gamma, self.last = list(points), at_point, gamma, points[-1]
        self.episodes, self.returns = finished
        self._owner: Any = None

    def counted_by(self, owner: Any) -> None:
        """Keep owner.finished at (episodes, sum of returns)."""
        self._owner = owner

    def _on_training_start(self) -> None:
        self._running = np.zeros(self.training_env.num_envs)
        self._discount = np.ones(self.training_env.num_envs)

    def _on_step(self) -> bool:
        if self.num_timesteps > self.last:
            return True
        dones = self.locals["dones"]
        self._running += self._discount * self._earned()
        self._discount *= self.gamma
        for i in np.flatnonzero(dones):
            self.episodes += 1
            self.returns += float(self._running[i])
            self._running[i], self._discount[i] = 0.0, 1.0
        self._owner.finished = (self.episodes, self.returns)
        if len(self.points) > 1 and self.num_timesteps >= self.points[0]:
            self._call(self.points[:-1])  # the last one comes after the last update, whatever passed it
        return True

    def at_the_end(self) -> None:
        """The last point, after the last update."""
        if self.points:
            self._call(self.points)

    def _call(self, due: list[int]) -> None:
        steps = max(point for point in due if point <= self.num_timesteps)
        self.points = [point for point in self.points if point > steps]
        row = self.at_point(steps, self.episodes, self.returns)
        for name in ("value", "expected_regret", "mean_return"):
            self.logger.record(f"pharos/{name}", row[name])
        if steps == self.last:
            self.logger.dump(self.num_timesteps)
