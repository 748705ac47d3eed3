"""The interpreted engine of interaction: the functions of interaction.py, which describes the arguments, in Python."""

import numpy as np

from pharos.environments import NO_ACTION, Environment
from pharos.kernels import stepping
from pharos.kernels.stepping import SAME_STEP


class InterpretedStepping:
    """`rules.Stepping`, interpreted: 30 to 100 times slower than compiled, and its witness in tests."""

    is_compiled = False
    parameters: tuple[object, ...] = ()

    def __init__(self, env: Environment):
        self.env = env

    def step_and_draw_one(self, *arguments: object) -> None:
        """None: steps and drawings are two calls."""
        return None

    def outcome_one(self, parameters, state, action, u) -> tuple[int, float]:
        return self._drawn_outcome(tuple(state.tolist()), action, u)

    def _drawn_outcome(self, state: tuple[int, ...], action: int, u: float) -> tuple[int, float]:
        """(outcome, its probability) of an action, drawn by a number u in [0, 1)."""
        if not self.env.has_chance:
            return 0, 1.0
        result, probability, total = 0, 0.0, 0.0
        for outcome in range(self.env.outcomes):
            chance = float(self.env.probability(state, action, outcome))
            if chance > 0 and total <= u:
                result, probability = outcome, chance
                total += chance
        return result, probability

    def step_one(self, parameters, ranges, scale, state, branch, next_state, vector) -> tuple[float, int]:
        before = tuple(state.tolist())
        if branch < 0:
            action, outcome, after = -1 - branch, -1, before
        else:
            action, outcome = divmod(branch, self.env.outcomes)
            after = self.env.next_state(before, action, outcome)
        for i, value in enumerate(after):
            if not ranges[0, i] <= value <= ranges[1, i]:
                return 0.0, 2 + i
        next_state[:] = after
        if len(vector):
            vector[:] = (next_state - ranges[0]) * scale
        reward = float(self.env.reward_of(before, action, after, outcome))
        return reward, int(branch >= 0 and bool(self.env.is_terminal(after)))

    def mark_available(self, states, out) -> None:
        for n, state in enumerate(map(tuple, np.asarray(states).tolist())):
            ended = bool(self.env.is_terminal(state))
            out[n] = [ended or bool(self.env.is_available(state, action)) for action in range(out.shape[1])]

    def is_terminal_one(self, parameters, state) -> bool:
        return bool(self.env.is_terminal(tuple(state.tolist())))

    def step_many(self, parameters, setting, batch, first, last) -> int:
        ranges, scale, chance, limit, mode, first_previous, starts, cumulative = setting
        rng, actions, states, previous, elapsed, ended, rewards, terminated, truncated, executed, final = batch[:11]
        vector, probabilities = batch[11:]
        for i in range(first, last):
            rewards[i], terminated[i], truncated[i], executed[i] = 0.0, False, False, NO_ACTION
            probabilities[i : i + 1] = 1.0  # no entry without chance
            # executed action and its outcome, unless the episode is over
            restart = bool(ended[i])
            if not restart:
                action = self._executed(int(actions[i]), int(previous[i]), chance, rng, i)
                before = tuple(states[i].tolist())
                outcome, after = 0, before
                lazy = chance[4]
                if stays := lazy > 0 and _uniform_number(rng, i) < lazy:
                    probabilities[i : i + 1] = lazy
                elif self.env.has_chance:
                    outcome, p = self._drawn_outcome(before, action, _uniform_number(rng, i))
                    probabilities[i] = p * (1.0 - lazy)
                if not stays:
                    after = self.env.next_state(before, action, outcome)
                executed[i] = action
                for c, value in enumerate(after):
                    if not ranges[0, c] <= value <= ranges[1, c]:
                        return i * len(after) + c
                # the episode after this step; in SAME_STEP an end is left at once
                rewards[i] = self.env.reward_of(before, action, after, -1 if stays else outcome)
                terminated[i] = not stays and self.env.is_terminal(after)
                previous[i] = action
                elapsed[i] += 1
                truncated[i] = elapsed[i] >= limit
                ended[i] = terminated[i] or truncated[i]
                states[i] = after
                restart = mode == SAME_STEP and bool(ended[i])
                if restart:
                    final[i] = after
            # reset to a start state
            if restart:
                several = len(cumulative) > 1
                k = np.searchsorted(cumulative, _uniform_number(rng, i), side="right") if several else 0
                states[i] = starts[k]
                previous[i], elapsed[i], ended[i] = first_previous, 0, False
        if len(vector):
            vector[first:last] = (states[first:last] - ranges[0]) * scale
        return -1

    def _executed(self, choice: int, previous: int, chance, rng: np.ndarray, i: int) -> int:
        """The executed action, as by `kernels.stepping.executed_action`."""
        if chance[0] >= 1.0:
            return choice
        return stepping.executed_by_number.py_func(
            choice, previous, chance, self.env.num_actions, _uniform_number(rng, i)
        )


def _uniform_number(rng: np.ndarray, i: int) -> float:
    """A uniform number in [0, 1) by SplitMix64, as `kernels.stepping.uniform_number`."""
    mask = (1 << 64) - 1
    z = (int(rng[i]) + 0x9E3779B97F4A7C15) & mask
    rng[i] = z
    z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9 & mask
    z = (z ^ (z >> 27)) * 0x94D049BB133111EB & mask
    z ^= z >> 31
    return (z >> 11) * 2.0**-53
