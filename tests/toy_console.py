"""A console of a few bytes, for the search by layers: a runner on a ring who picks up coins and ends in a pit."""

import numpy as np

RING = 7


class ToyConsole:
    """State: place, coins that are left (bits), a clock that nothing reads, padding that deflates."""

    actions = ("left", "stay", "right")

    def __init__(self, bonus=0.0):
        self.bonus = bonus
        self.start()

    def start(self):
        self.place, self.coins, self.clock = 0, 0b0010110, 0
        return self.save()

    def load(self, saved):
        return saved

    def step(self, state, action):
        self.place, self.coins, self.clock = state[0], state[1], state[2] + 1
        self.place = (self.place + action - 1) % RING
        reward = float(self.coins >> self.place & 1)
        self.coins &= ~(1 << self.place)
        return reward, self.place == 4

    def save(self):
        return bytes([self.place, self.coins, self.clock]) + bytes(50)

    def screen(self):
        picture = np.zeros((3, RING, 3), np.uint8)
        picture[0, self.place] = 255
        picture[2, [i for i in range(RING) if self.coins >> i & 1], 1] = 99
        return picture

    def last_reward(self):
        return self.bonus


def naive_layers(horizon):
    """(next states, rewards, screens) of the toy in plain Python; states of a depth as they are met."""
    console = ToyConsole()
    layers, rows, pay = [[console.start()]], [], []
    first = 0
    for depth in range(horizon):
        met = {}
        for state in layers[depth]:
            row = []
            for action in range(3):
                reward, ends = console.step(state, action)
                after = console.save()
                row.append(-1 if ends or depth == horizon - 1 else met.setdefault(after, len(met)))
                pay.append(reward)
            rows.append([n if n < 0 else first + len(layers[depth]) + n for n in row])
        first += len(layers[depth])
        layers.append(list(met))
    screens = []
    for layer in layers[:horizon]:
        for state in layer:
            console.place, console.coins = state[0], state[1]
            screens.append(console.screen())
    return np.array(rows), np.array(pay).reshape(-1, 3), np.array(screens)
