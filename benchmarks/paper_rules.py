"""Which rules did the paper play? Exact best, uniform and worst returns of variants, beside the returns it prints.

    python benchmarks/paper_rules.py breakout returns.csv --rows 1
    python benchmarks/paper_rules.py breakout returns.csv --rows 2 --instances 12x8x3 16x8x3 20x8x3 24x8x3
    python benchmarks/paper_rules.py constants returns.csv
    python benchmarks/paper_rules.py freeway returns.csv
    python benchmarks/paper_rules.py dqn returns.csv --rows 2 --limits 1500 --variants ours "3 walls"

`returns.csv` has the tables of its appendix C, a row for each mean (environment, instance, randomization, agent,
observation, mean). Under random or sticky actions, however likely, what is executed is a policy of the rules without
chance; so every mean lies between the worst and the best return without chance, or the rules are not the paper's.

For each variant and limit of steps:

    impossible   printed means, of those of the instances, that lie outside
    below        those below the return of random play, where a trained agent is hardly found
    share        DQN with images, without chance, of the best return: least and most over the instances
    rank         Spearman's correlation of that with the best return, over the instances

`constants`: returns of always left, always stay and always right on 16x8x1, 16x8x3 and 20x8x3, where the paper prints
2.00 ± 0.00, 2.00 ± 0.00 and 4.00 ± 0.00 for PPO.

`dqn`: DQN with vectors as the paper trains it (the table's hyperparameters, 600 thousand steps), on its instances of 8
columns under each variant; mean return of the last tenth of training, exploration included, beside the printed mean.

Means are rounded to cents. Breakout: the time-invariant MDP is built and swept, with all limits in one pass. Freeway:
the cars are a clock, so the few states of each step are searched from the start.
"""

import argparse
import csv
import itertools
import tempfile
import time
from dataclasses import dataclass

import numba
import numpy as np
from scipy.stats import spearmanr

import pharos
from pharos.agents import hyperparameters
from pharos.agents.batched import BatchRun, ObservationSource, make_batch
from pharos.environments import make
from pharos.environments.base import parameter
from pharos.environments.worlds import breakout as rules
from pharos.environments.worlds.breakout import Breakout, no_brick_is_left
from pharos.environments.worlds.freeway import Freeway
from pharos.training import Task

ROUNDING = 0.005
EDGE, MINATAR, MIRROR = range(3)
PADDLES = ("ours", "MinAtar's", "mirror")
ONE, BY_ROW, ATARI = range(3)
CONSTANT = {"16x8x1": 2.0, "16x8x3": 2.0, "20x8x3": 4.0}


@dataclass(frozen=True, kw_only=True)
class Variant(Breakout):
    """Breakout with other paddles, points, walls and lives.

    Attributes:
        paddle: EDGE, ours; MINATAR, as in MinAtar: straight below it reflects, ahead it turns the ball back; MIRROR:
            ahead it reflects, and nothing else.
        points: of a brick: ONE; BY_ROW, counted from below; ATARI, 1 in the lowest row and 3 more in each above.
        walls: after so many the episode ends; 0: never.
        lives: balls; the next one starts as the first, with the bricks that are left.
    """

    paddle: int = parameter(EDGE, low=0)
    points: int = parameter(ONE, low=0)
    walls: int = parameter(0, low=0)
    lives: int = parameter(1, low=1)

    name = "breakout_variant"
    instances = {}
    paper_instances = ()

    def variables(self):
        return {**super().variables(), "wall": range(self.walls + 1), "life": range(self.lives)}

    def initial_state(self):
        return (*super().initial_state(), self.walls, self.lives - 1)

    def transition(self, state, action, out):
        row, column, right, down = state[0], state[1], state[2], state[3]
        wall = rules.BRICKS + self.num_bricks
        life = wall + 1
        if row == self.height - 1:
            if state[life] > 0:
                out[0] = self.brick_rows + 1
                out[1] = (self.columns - 1) // 2
                out[2] = 1
                out[3] = 1
                out[rules.PADDLE] = (self.columns - self.paddle_width) // 2
                out[life] = state[life] - 1
            return
        paddle = state[rules.PADDLE]
        if action == rules.LEFT and paddle > 0:
            paddle -= 1
        elif action == rules.RIGHT and paddle < self.columns - self.paddle_width:
            paddle += 1
        out[rules.PADDLE] = paddle
        if column == 0:
            right = 1
        elif column == self.columns - 1:
            right = 0
        if row == 0:
            down = 1
        ahead_row = row + 2 * down - 1
        ahead_column = column + 2 * right - 1
        if ahead_row == self.height - 1:
            ahead = paddle <= ahead_column < paddle + self.paddle_width
            below = paddle <= column < paddle + self.paddle_width
            if self.paddle == EDGE:
                if ahead:
                    down = 0
                elif below:
                    right = 1 - right
                    down = 0
                    ahead_column = min(max(column + 2 * right - 1, 0), self.columns - 1)
            elif self.paddle == MINATAR:
                if below:
                    down = 0
                elif ahead:
                    right = 1 - right
                    down = 0
            elif ahead:
                down = 0
            if down == 0:
                ahead_row = row
                if no_brick_is_left(self.num_bricks, state):
                    for i in range(self.num_bricks):
                        out[rules.BRICKS + i] = 1
                    if self.walls > 0:
                        out[wall] = state[wall] - 1
        elif 1 <= ahead_row <= self.brick_rows:
            brick = rules.BRICKS + (ahead_row - 1) * self.columns + ahead_column
            if state[brick] == 1:
                out[brick] = 0
                down = 1 - down
                ahead_row, ahead_column = row, column
        out[0] = ahead_row
        out[1] = ahead_column
        out[2] = right
        out[3] = down

    def is_terminal(self, state):
        wall = rules.BRICKS + self.num_bricks
        if state[0] == self.height - 1:
            return state[wall + 1] == 0
        return state[wall] == 1 and no_brick_is_left(self.num_bricks, state)

    def reward(self, state, action, next_state):
        if state[0] != next_state[0] or state[1] != next_state[1] or state[0] >= self.height - 2:
            return 0.0
        brick_row = state[0] + 2 * (1 - next_state[3]) - 1
        if self.points == BY_ROW:
            return float(self.brick_rows + 1 - brick_row)
        if self.points == ATARI:
            return 1.0 + 3.0 * (self.brick_rows - brick_row)
        return 1.0


VARIANTS = {
    "ours": {},
    "MinAtar's paddle": {"paddle": MINATAR},
    "mirror": {"paddle": MIRROR},
    "points by row": {"points": BY_ROW},
    "points 1, 4": {"points": ATARI},
    "one wall": {"walls": 1},
    "2 walls": {"walls": 2},
    "3 walls": {"walls": 3},
    "6 walls": {"walls": 6},
    "3 lives": {"lives": 3},
    "5 lives": {"lives": 5},
}


@numba.njit(nogil=True)
def curves(next_states, rewards, limit):
    """Best, uniform and worst return from state 0, (3, limit + 1), with so many steps to go."""
    num_states, num_actions = next_states.shape
    old = np.zeros((num_states + 1, 3))
    new = np.zeros((num_states + 1, 3))
    found = np.zeros((3, limit + 1))
    for step in range(1, limit + 1):
        for state in range(num_states):
            best, total, worst = -np.inf, 0.0, np.inf
            for action in range(num_actions):
                following, reward = next_states[state, action], rewards[state, action]
                best = max(best, reward + old[following, 0])
                total += reward + old[following, 1]
                worst = min(worst, reward + old[following, 2])
            new[state, 0], new[state, 1], new[state, 2] = best, total / num_actions, worst
        old, new = new, old
        found[:, step] = old[0]
    return found


def variant_of(name, **parameters):
    """The paper's instance under other rules."""
    return Variant(**Breakout.instances[name], **parameters)


def breakout_curves(env, limit):
    """Best, uniform and worst return, (3, limit + 1)."""
    with tempfile.TemporaryDirectory() as folder:
        mdp = pharos.build(env, folder).mdp(gamma=1.0)
        next_states, rewards = np.asarray(mdp.next_states), np.asarray(mdp.rewards)
        return curves(next_states, rewards, limit)


def freeway_layers(env, limit):
    """For each step: (n, 3) places in the next one, -1 an end; (n, 3) crossings; (n, 3) hits."""
    states, layers = {tuple(env.initial_state()): 0}, []
    for _ in range(limit):
        places, following = np.full((len(states), 3), -1), {}
        crossings, hits = np.zeros(places.shape), np.zeros(places.shape)
        for state, place in states.items():
            for action in range(3):
                after = env.next_state(state, action)
                reward = env.reward(state, action, after)
                crossings[place, action], hits[place, action] = reward > 0, reward < 0
                if not env.is_terminal(after):
                    places[place, action] = following.setdefault(tuple(after), len(following))
        layers.append((places, crossings, hits))
        states = following
    return layers


def freeway_values(layers, limit, penalty):
    """Best, uniform and worst return of the first `limit` steps."""
    values = np.zeros((3, 1))
    for places, crossings, hits in reversed(layers[:limit]):
        if values.shape[1] == 1:
            values = np.zeros((3, places.max() + 2))
        q = crossings - penalty * hits + values[:, places]
        values = np.column_stack((np.array([q[0].max(1), q[1].mean(1), q[2].min(1)]), np.zeros(3)))
    return values[:, 0]


def printed(file, environment):
    """Instance (from 0) -> (randomization, agent, observation) -> mean."""
    means = {}
    with open(file, newline="") as lines:
        for row in csv.DictReader(lines):
            if row["environment"] == environment:
                key = row["randomization"], row["agent"], row["observation"]
                means.setdefault(int(row["instance"]) - 1, {})[key] = float(row["mean"])
    return means


def comparison(means, values):
    """The columns of the table but the last: `values` is instance -> (best, uniform, worst)."""
    outside = {
        (i, key): mean
        for i, (best, _, worst) in values.items()
        for key, mean in means[i].items()
        if not worst - ROUNDING <= mean <= best + ROUNDING
    }
    low = sum(mean < values[i][1] - ROUNDING for i in values for mean in means[i].values())
    dqn = [means[i]["none", "DQN", "image"] for i in values]
    best = [value[0] for value in values.values()]
    share = [mean / max(value, 1e-9) for mean, value in zip(dqn, best, strict=True)]
    rank = spearmanr(dqn, best)[0] if len(set(best)) > 1 else float("nan")
    count = sum(len(means[i]) for i in values)
    return (
        f"{len(outside)} of {count} | {low} | {min(share):.2f} to {max(share):.2f} | {rank:.2f} | "
        f"{min(best):.1f} to {max(best):.1f}"
    )


def breakout(arguments):
    means, names = printed(arguments.returns, "breakout"), Breakout.paper_instances
    wanted = arguments.instances or names
    print("| variant | rows | limit | impossible | below | share | rank | best |\n" + "|---" * 8 + "|")
    for variant in arguments.variants or VARIANTS:
        found = {}
        for i, name in enumerate(names):
            if name in wanted:
                env = variant_of(name, brick_rows=arguments.rows, **VARIANTS[variant])
                found[i] = breakout_curves(env, max(arguments.limits))
        for limit in arguments.limits:
            text = comparison(means, {i: values[:, limit] for i, values in found.items()})
            print(f"| {variant} | {arguments.rows} | {limit} | {text} |", flush=True)


def constants(arguments):
    """How many of the three constants a policy of one action returns, under each variant."""
    limit = max(arguments.limits)
    print("| rows | paddle | lives | " + " | ".join(CONSTANT) + " | met |\n" + "|---" * 7 + "|")
    for rows, (label, paddle), lives in itertools.product(range(1, 7), enumerate(PADDLES), (1, 3)):
        found = {}
        for name in CONSTANT:
            env = variant_of(name, brick_rows=rows, paddle=label, lives=lives)
            found[name] = [return_of_constant(env, action, limit) for action in range(3)]
        met = sum(mean in found[name] for name, mean in CONSTANT.items())
        cells = " | ".join(", ".join(f"{value:g}" for value in values) for values in found.values())
        print(f"| {rows} | {paddle} | {lives} | {cells} | {met} of 3 |")


def return_of_constant(env, action, limit):
    state, total = tuple(env.initial_state()), 0.0
    for _ in range(limit):
        after = tuple(env.next_state(state, action))
        total += env.reward(state, action, after)
        state = after
        if env.is_terminal(state):
            break
    return total


def dqn(arguments):
    """Returns of DQN with vectors under each variant: a program of all instances and seeds."""
    means, limit = printed(arguments.returns, "breakout"), max(arguments.limits)
    wanted = {i: name for i, name in enumerate(Breakout.paper_instances) if Breakout.instances[name]["columns"] == 8}
    wanted = {i: name for i, name in wanted.items() if name in (arguments.instances or wanted.values())}
    paper, table = [means[i]["none", "DQN", "vector"] for i in wanted], hyperparameters("dqn", "breakout", "vector")
    columns = {"printed": paper}
    for variant in arguments.variants or VARIANTS:
        runs, began = [], time.process_time()
        for name in wanted.values():
            env = variant_of(name, brick_rows=arguments.rows, **VARIANTS[variant])
            task = Task.of(env, observation="vector", horizon=limit)
            source = ObservationSource.of(task.space, task.observer.observe)
            runs += [BatchRun(task.mdp, source, limit, table, arguments.steps, seed, seed) for seed in arguments.seeds]
        batch, late = make_batch("dqn", runs), []
        batch.learn(
            [arguments.steps * 9 // 10, arguments.steps],
            lambda point, batch=batch, late=late: late.append((batch.returns.copy(), batch.episodes.copy())),
        )
        (returns, episodes), (all_returns, all_episodes) = late
        found = (all_returns - returns) / np.maximum(all_episodes - episodes, 1)
        columns[variant] = found.reshape(len(wanted), -1).mean(axis=1)
        print(f"{variant}: {(time.process_time() - began) / len(runs):.0f} processor s a run", flush=True)
        for name, seeds in zip(wanted.values(), found.reshape(len(wanted), -1), strict=True):
            print("   ", name, " ".join(f"{mean:.2f}" for mean in seeds), flush=True)
    print("| instance | " + " | ".join(columns) + " |\n" + "|---" * (len(columns) + 1) + "|")
    for row, name in enumerate(wanted.values()):
        print(f"| `{name}` | " + " | ".join(f"{column[row]:.2f}" for column in columns.values()) + " |")
    for variant, column in list(columns.items())[1:]:
        ratios = np.array(column) / np.array(paper)
        rank = spearmanr(paper, column)[0]
        print(f"{variant}: {ratios.min():.2f} to {ratios.max():.2f} of the printed; rank {rank:.2f}")


def freeway(arguments):
    means, names = printed(arguments.returns, "freeway"), Freeway.paper_instances
    print("| restart | penalty | limit | impossible | below | share | rank | best | worst |\n" + "|---" * 9 + "|")
    for restart in (True, False):
        found = {}
        for i, name in enumerate(names):
            if not arguments.instances or name in arguments.instances:
                env = make(f"freeway/{name}", restart_on_hit=restart)
                found[i] = freeway_layers(env, max(arguments.limits))
        for limit in arguments.limits:
            for penalty in arguments.penalties:
                values = {i: freeway_values(layers, limit, penalty) for i, layers in found.items()}
                worst = [value[2] for value in values.values()]
                text = comparison(means, values)
                print(
                    f"| {restart} | {penalty:g} | {limit} | {text} | {min(worst):.1f} to {max(worst):.1f} |", flush=True
                )
                for i, (best, uniform, least) in values.items():
                    print("   ", names[i], f"{best:.2f} {uniform:.2f} {least:.2f}", min(means[i].values()))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("environment", choices=("breakout", "constants", "freeway", "dqn"))
    parser.add_argument("returns")
    parser.add_argument("--rows", type=int, default=1)
    parser.add_argument("--limits", type=int, nargs="+", default=[250, 500, 1000, 2000])
    parser.add_argument("--instances", nargs="+")
    parser.add_argument("--variants", nargs="+", choices=VARIANTS)
    parser.add_argument("--steps", type=int, default=600_000, help="of dqn")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1], help="of dqn")
    parser.add_argument("--penalties", type=float, nargs="+", default=[0.1, 0.5, 1.0, 2.0])
    arguments = parser.parse_args()
    commands = {"breakout": breakout, "constants": constants, "freeway": freeway, "dqn": dqn}
    commands[arguments.environment](arguments)


if __name__ == "__main__":
    main()
