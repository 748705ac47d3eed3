"""Control with chance of one's own: a reservoir, a junction, a battery, a sailing boat."""

from dataclasses import dataclass

from pharos import Environment, Layer
from pharos.environments import parameter

# A reservoir --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Reservoir(Environment):
    """Sell the water of a reservoir: it comes in the first half of the year and is dear in the second.

    State    level, season. Actions: release 0 to 3. Chance: inflow 1 to 3 in wet seasons, 0 or 1 in dry ones.
    Reward   2 a unit in wet seasons, 7 in dry ones; -8 for each unit that spills over.
    """

    level: int = parameter(6, low=3, high=60)
    seasons: int = parameter(4, low=2, high=24)

    name = "reservoir"
    actions = tuple(f"release {i}" for i in range(4))
    outcomes = 3
    layers = {"water": Layer("w", (60, 120, 200)), "season": Layer("s", (120, 120, 120))}

    @property
    def max_episode_steps(self):
        return 4 * self.seasons

    def variables(self):
        return {"level": range(self.level + 1), "season": range(self.seasons)}

    def initial_state(self):
        return (self.level // 2, 0)

    def probability(self, state, action, outcome):
        if 2 * state[1] < self.seasons:
            return 0.4 if outcome == 1 else 0.3
        return 0.6 if outcome == 0 else 0.4 if outcome == 1 else 0.0

    def transition(self, state, action, outcome, out):
        inflow = outcome + 1 if 2 * state[1] < self.seasons else outcome
        out[0] = min(max(state[0] - action, 0) + inflow, self.level)
        out[1] = (state[1] + 1) % self.seasons

    def reward(self, state, action, next_state, outcome):
        released = min(action, state[0])
        wet = 2 * state[1] < self.seasons
        inflow = max(outcome, 0) + 1 if wet else max(outcome, 0)
        spilt = max(state[0] - released + inflow - self.level, 0)
        return (2.0 if wet else 7.0) * released - 8.0 * spilt

    def grid(self):
        return 2, max(self.level + 1, self.seasons)

    def draw(self, state, planes):
        planes[0, 0, state[0]] = 1
        planes[1, 1, state[1]] = 1


# A junction ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Junction(Environment):
    """Set the light where two roads cross. While it changes nobody drives. All costs.

    State    cars waiting on each road, light (0, 1: green for that road; 2, 3: red for all before 0, before 1).
    Chance   a car comes on the first road with probability 0.4, on the second with 0.2. One leaves at green.
    Reward   -0.05 for each car that waits, -0.5 for each road that is full, where further cars are turned away.
    """

    room: int = parameter(2, low=1, high=20)

    name = "junction"
    actions = ("keep", "change")
    outcomes = 4
    max_episode_steps = 60
    layers = {"cars": Layer("c", (66, 72, 200)), "light": Layer("l", (90, 170, 90))}

    def variables(self):
        return {"cars": [range(self.room + 1)] * 2, "light": range(4)}

    def initial_state(self):
        return (0, 0, 0)

    def probability(self, state, action, outcome):
        first = 0.4 if outcome % 2 == 1 else 0.6
        second = 0.2 if outcome // 2 == 1 else 0.8
        return first * second

    def transition(self, state, action, outcome, out):
        light = state[2]
        for i in range(2):
            left = max(state[i] - 1, 0) if light == i else state[i]
            came = outcome % 2 if i == 0 else outcome // 2
            out[i] = min(left + came, self.room)
        if light >= 2:
            out[2] = light - 2
        elif action == 1:
            out[2] = 3 - light

    def reward(self, state, action, next_state):
        full = float(next_state[0] == self.room) + float(next_state[1] == self.room)
        return -0.05 * (next_state[0] + next_state[1]) - 0.5 * full

    def grid(self):
        return 3, max(self.room + 1, 4)

    def draw(self, state, planes):
        planes[0, 0, state[0]] = 1
        planes[0, 1, state[1]] = 1
        planes[1, 2, state[2]] = 1


# A battery ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Battery(Environment):
    """Buy electricity when it is cheap and sell it when it is dear; a tenth is lost. Small money.

    State    charge, price. Chance: the price moves by one, more often towards the middle.
    Reward   0.002 for each unit of the price, times 0.9 at a sale; what is left in the end is worth nothing.
    """

    charge: int = parameter(3, low=1, high=60)
    prices: int = parameter(6, low=3, high=40)

    name = "battery"
    actions = ("sell", "hold", "buy")
    outcomes = 3
    layers = {"charge": Layer("c", (90, 170, 90)), "price": Layer("p", (214, 186, 92))}

    @property
    def max_episode_steps(self):
        return 20 + 4 * self.charge

    def variables(self):
        return {"charge": range(self.charge + 1), "price": range(self.prices)}

    def initial_state(self):
        return (0, self.prices // 2)

    def probability(self, state, action, outcome):
        up = 0.7 - 0.4 * state[1] / (self.prices - 1)
        return 0.2 if outcome == 0 else 0.8 * up if outcome == 1 else 0.8 * (1.0 - up)

    def transition(self, state, action, outcome, out):
        out[0] = min(max(state[0] + action - 1, 0), self.charge)
        move = 0 if outcome == 0 else 1 if outcome == 1 else -1
        out[1] = min(max(state[1] + move, 0), self.prices - 1)

    def reward(self, state, action, next_state):
        price = 0.002 * (state[1] + 1)
        if action == 0 and state[0] > 0:
            return 0.9 * price
        return -price if action == 2 and state[0] < self.charge else 0.0

    def grid(self):
        return 2, max(self.charge + 1, self.prices)

    def draw(self, state, planes):
        planes[0, 0, state[0]] = 1
        planes[1, 1, state[1]] = 1


# Sailing ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Sailing(Environment):
    """Sail over a lake from one corner to the opposite one. The wind turns; against it a boat is slow or stands.

    State    row, column, where the wind blows to (eighths of a turn). Actions: eight headings, one cell.
    Reward   -1 before the wind, -2, -3 and -4 for each eighth off it; straight against it or onto the shore the boat
             stays where it is, which costs 5.
    """

    size: int = parameter(3, low=2, high=12)

    name = "sailing"
    actions = ("north", "north-east", "east", "south-east", "south", "south-west", "west", "north-west")
    outcomes = 3
    layers = {"boat": Layer("B", (66, 72, 200)), "wind": Layer("w", (120, 120, 120))}

    @property
    def max_episode_steps(self):
        return 15 * self.size

    def variables(self):
        return {"row": range(self.size), "column": range(self.size), "wind": range(8)}

    def initial_states(self):
        return [((0, 0, k), 1 / 8) for k in range(8)]

    def probability(self, state, action, outcome):
        return 0.4 if outcome == 0 else 0.3

    def transition(self, state, action, outcome, out):
        row, column = state[0] + south(action), state[1] + south((action + 6) % 8)
        inside = 0 <= row < self.size and 0 <= column < self.size
        if inside and off_wind(action, state[2]) < 4:
            out[0], out[1] = row, column
        turn = 0 if outcome == 0 else 1 if outcome == 1 else 7
        out[2] = (state[2] + turn) % 8

    def is_terminal(self, state):
        return state[0] == self.size - 1 and state[1] == self.size - 1

    def reward(self, state, action, next_state):
        if next_state[0] == state[0] and next_state[1] == state[1]:
            return -5.0
        return -1.0 - off_wind(action, state[2])

    def grid(self):
        return self.size + 1, max(self.size, 8)

    def draw(self, state, planes):
        planes[0, state[0], state[1]] = 1
        planes[1, self.size, state[2]] = 1


def south(heading):
    """Rows to the south that one cell in a heading makes."""
    return -1 if heading <= 1 or heading == 7 else 1 if 3 <= heading <= 5 else 0


def off_wind(heading, wind):
    """Eighths of a turn between a heading and where the wind blows to, 0 to 4."""
    turn = (heading - wind + 8) % 8
    return min(turn, 8 - turn)
