"""The instances of the study `hardness-dev`, by their rule.

python benchmarks/hardness_dev.py [--predictions FILE]

Each class has a ladder: its instances by one size n, everything else as in LADDERS. Three of them are taken: the
smallest with at least LEAST states; the largest with at most MOST states whose picture has at most MOST_CELLS cells, so
that networks for pictures can be trained on two cores in a night; and the one whose number of states is nearest to the
geometric mean of these two. Nothing but these sizes is looked at. Prints them as the preset has them; with
--predictions, of `pharos study predict`, a table of kernel regret in their place, a row a class, the mean over its
instances.
"""

import argparse
import math
from itertools import count

import pharos
from pharos import study
from pharos.observations import observe

LEAST, MOST, MOST_CELLS = 16, 20_480, 1_024
LADDERS = {
    "simple_grid": lambda n: {"height": n, "width": n},
    "frozen_lake": lambda n: {"size": n, "seed": 0},
    "freeway": lambda n: {"num_cars": n, "lane_length": 3},
    "breakout": lambda n: {"height": 5, "columns": n, "brick_rows": 1},
    "cliff_walking": lambda n: {"height": n, "width": 3 * n},
    "taxi": lambda n: {"size": n},
    "deep_sea": lambda n: {"size": n},
    "catch": lambda n: {"rows": n, "columns": n},
    "memory_chain": lambda n: {"memory_length": n, "num_bits": n},
    "umbrella_chain": lambda n: {"chain_length": n},
    "river_swim": lambda n: {"length": n, "left_reward": 0.005, "right_reward": 1.0},
    "mini_grid": lambda n: {"kind": "door_key", "size": n, "seed": 0},
}
FIRST = {"mini_grid": 5, "river_swim": 3, "freeway": 1}


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--predictions")
    file = parser.parse_args().predictions
    if file is not None:
        print(predicted(study.read_predictions(file)[0]))
        return
    for name, rung in LADDERS.items():
        for parameters, states in instances(name, rung):
            given = ", ".join(f"{key}: {value}" for key, value in parameters.items())
            print(f"{{name: {name}, parameters: {{{given}}}}}  # {states:,} states", flush=True)


def predicted(frame):
    """Rows of a Markdown table: kernel regret by class and observation, and that of the tabular learner."""
    columns = list(dict.fromkeys(frame["observation"]))
    lines = ["| class | " + " | ".join(columns) + " | tabular learner |", "|---" * (len(columns) + 2) + "|"]
    for name, part in frame.groupby("environment", sort=False):
        means = part.groupby("observation")["kernel_regret"].mean()
        cells = [f"{means[column]:.2f}" for column in columns]
        lines.append(f"| `{name}` | {' | '.join(cells)} | {part['tabular_regret'].mean():.2f} |")
    return "\n".join(lines)


def instances(name, rung):
    """(parameters, states) of the instances that the rule takes, the smallest first."""
    sizes = []
    for n in count(FIRST.get(name, 2)):
        env = pharos.make(name, **rung(n))
        cells = math.prod(observe(env, "simple_image", motion=True).space.shape[1:])
        if cells > MOST_CELLS:
            break
        try:
            states = pharos.build(env, progress=False, max_states=MOST).num_states
        except pharos.errors.StateSpaceTooLarge:
            break
        if states >= LEAST:
            sizes.append((n, states))
    middle = math.sqrt(sizes[0][1] * sizes[-1][1])
    chosen = (sizes[0], min(sizes[1:-1], key=lambda size: abs(math.log(size[1] / middle))), sizes[-1])
    return [(rung(n), states) for n, states in chosen]


if __name__ == "__main__":
    main()
