"""bsuite's tabular experiments as plain games, written after its descriptions: reset and step, nothing shared.

Each has `state()` as pharos counts it, and `step(action)` -> (reward without noise, whether the episode ended).
"""

import numpy as np


class DeepSea:
    def __init__(self, size, mapping_seed, fails=None):
        """`fails`: function() -> whether going right fails this time; None: it never does."""
        self.size, self.fails = size, fails or (lambda: False)
        mapping = np.random.RandomState(mapping_seed)
        self.right = mapping.binomial(1, 0.5, [size, size])
        self.row = self.column = 0

    def state(self):
        return (self.row, self.column) if self.row < self.size else (self.size, 0)

    def step(self, action):
        goes_right = action == self.right[self.row][self.column]
        reward = 0.0
        if goes_right:
            if self.column == self.size - 1:
                reward += 1
            reward -= 0.01 / self.size
            if not self.fails():
                self.column = min(self.column + 1, self.size - 1)
        else:
            self.column = max(self.column - 1, 0)
        self.row += 1
        return reward, self.row == self.size


class Catch:
    def __init__(self, rows, columns, ball):
        self.rows, self.columns = rows, columns
        self.ball, self.height, self.paddle = ball, 0, columns // 2

    def state(self):
        return (self.height, self.ball, self.paddle)

    def step(self, action):
        self.paddle = int(np.clip(self.paddle + (-1, 0, 1)[action], 0, self.columns - 1))
        self.height += 1
        if self.height < self.rows - 1:
            return 0.0, False
        return (1.0 if self.paddle == self.ball else -1.0), True


class MemoryChain:
    def __init__(self, memory_length, bits, query):
        self.memory_length, self.bits, self.query, self.time = memory_length, bits, query, 0

    def state(self):
        return (self.time, self.query, *self.bits)

    def step(self, action):
        self.time += 1
        if self.time <= self.memory_length:
            return 0.0, False
        return (1.0 if self.bits[self.query] == action else -1.0), True


class UmbrellaChain:
    def __init__(self, chain_length, need, have):
        self.chain_length, self.need, self.have, self.time = chain_length, need, have, 0

    def state(self):
        return (self.time, self.need, self.have)

    def step(self, action):
        self.have = action if self.time == 0 else self.have
        self.time += 1
        if self.time < self.chain_length:
            return 0.0, False
        return (1.0 if self.have == self.need else -1.0), True


class DiscountingChain:
    def __init__(self, mapping_seed):
        self.bonus, self.chain, self.time = mapping_seed % 5, -1, 0

    def state(self):
        return (self.time, self.chain)

    def step(self, action):
        self.chain = action if self.time == 0 else self.chain
        self.time += 1
        paid = (1.1 if self.chain == self.bonus else 1.0) if self.time == (1, 3, 10, 30, 100)[self.chain] else 0.0
        return paid, self.time == 100
