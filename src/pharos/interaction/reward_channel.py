"""Reward channel: rewards are paid late, or with noise. Values and regret are of what is earned.

Source: the reward delay and reward noise of MDP Playground (Rajan et al. 2023).
"""

import numpy as np

from pharos.interaction.simulator import stream_of
from pharos.kernels import stepping
from pharos.mdp import ChanceSetting


class RewardChannel:
    """Pay of N environments: the reward of `delay` steps before, and noise.

    At step t of an episode of n steps, t = 1 .. n, r_t being what is earned:

        paid_t = r_(t - delay) + noise z_t for t < n, with r_0 = r_-1 = ... = 0
        paid_n = r_(n - delay) + ... + r_n + noise z_n

    z are independent standard normal numbers. So the sum of what is paid in an episode has the mean of what was earned,
    however the episode ended. Where it is broken off by a reset, what was not paid yet is lost.

    Noise is drawn from streams of its own, seeded as those of the steps are, so that steps stay what they are without.

    Attributes:
        earned: (N,) of the last step.
    """

    def __init__(self, chance: ChanceSetting, num_envs: int):
        self.noise, self.delay = float(chance.reward_noise), int(chance.reward_delay)
        self.earned = np.zeros(num_envs)
        self._pending = np.zeros((num_envs, self.delay))
        self._steps = np.zeros(num_envs, np.int64)
        self._rng = np.random.SeedSequence().generate_state(num_envs, np.uint64)

    def seed(self, seeds: "list[int | None]") -> None:
        """Seed the noise of each environment; None leaves a stream as it is."""
        for i, seed in enumerate(seeds):
            if seed is not None:
                self._rng[i] = stream_of(seed, 1)[0]

    def restart(self, mask: np.ndarray) -> None:
        """Forget what is due in some environments (N,) bool, whose episodes begin."""
        self._pending[mask] = 0.0
        self._steps[mask] = 0

    def pay(self, earned: np.ndarray, is_step: np.ndarray, ended: np.ndarray) -> np.ndarray:
        """Return the pay (N,) of a step.

        Args:
            earned: (N,), 0 where nothing is played.
            is_step: (N,) bool, whether an environment was stepped, not reset.
            ended: (N,) bool, whether its episode is over, so that everything is due.
        """
        self.earned = earned
        amounts = earned.copy()
        stepping.pay(self._rng, self.noise, self._pending, self._steps, is_step, ended, amounts)
        return amounts
