"""Environments of other libraries, stepped into exact MDPs: states, outcomes, seconds, or the line that refuses.

    python benchmarks/any_environment.py [--max-states 5000] [--only TEXT] [--markdown FILE]

Tries what is installed of gymnasium, minigrid, minatar, gym-classics, mo-gymnasium, popgym and pettingzoo. Processor
time of one thread. Merged: states that bisimulation.minimize leaves.
"""

import argparse
import importlib
import time
from functools import partial
from pathlib import Path

import gymnasium
import numpy as np

from pharos import bisimulation, importers
from pharos.errors import PharosError


def made(name, module=None, **options):
    """An environment of Gymnasium, after a module was imported that registers it."""
    if module is not None:
        package = importlib.import_module(module)
        if module == "gym_classics" and "ClassicGridworld-v0" not in gymnasium.registry:
            package.register("gymnasium")
        if module == "minatar.gym" and "MinAtar/Breakout-v1" not in gymnasium.registry:
            package.register_envs()
    return gymnasium.make(name, disable_env_checker=True, **options)


def tic_tac_toe():
    from pettingzoo.classic import tictactoe_v3

    return importers.OnePlayer(tictactoe_v3.env())


def minatar(game, sticky=0.0):
    return partial(made, f"MinAtar/{game}-v1", "minatar.gym", sticky_action_prob=sticky)


def classic(name):
    return partial(made, f"{name}-v0", "gym_classics")


def several_rewards(name):
    return partial(made, f"{name}-v0", "mo_gymnasium")


MINIGRID = {"seed": 0, "ignore": ["step_count"], "reward": lambda payment: float(payment > 0), "check": False}
MEMORY = {"seed": 0}
CASES = {
    "FrozenLake 8x8, slippery": (partial(made, "FrozenLake-v1", map_name="8x8"), {}),
    "CliffWalking, slippery": (partial(made, "CliffWalking-v1", is_slippery=True), {}),
    "Taxi": (partial(made, "Taxi-v4"), {}),
    "Taxi, fickle passenger": (partial(made, "Taxi-v4", fickle_passenger=True), {}),
    "Blackjack": (partial(made, "Blackjack-v1"), {}),
    "CartPole": (partial(made, "CartPole-v1"), {}),
    "MiniGrid DoorKey 5x5": (partial(made, "MiniGrid-DoorKey-5x5-v0", "minigrid"), MINIGRID),
    "MiniGrid Dynamic-Obstacles 5x5": (partial(made, "MiniGrid-Dynamic-Obstacles-5x5-v0", "minigrid"), {"seed": 0}),
    "MinAtar Breakout, 12 steps": (minatar("Breakout"), {"horizon": 12}),
    "MinAtar Breakout, 8 steps, sticky": (minatar("Breakout", 0.1), {"horizon": 8}),
    "MinAtar Asterix, 8 steps": (minatar("Asterix"), {"horizon": 8}),
    "MinAtar Space Invaders, 5 steps": (minatar("SpaceInvaders"), {"horizon": 5}),
    "MinAtar Freeway, 5 steps": (minatar("Freeway"), {"horizon": 5}),
    "gym-classics ClassicGridworld": (classic("ClassicGridworld"), {}),
    "gym-classics WindyGridworld": (classic("WindyGridworld"), {}),
    "gym-classics FourRooms": (classic("FourRooms"), {}),
    "gym-classics CliffWalk": (classic("CliffWalk"), {}),
    "gym-classics DynaMaze": (classic("DynaMaze"), {}),
    "gym-classics JacksCarRental": (classic("JacksCarRental"), {}),
    "mo-gymnasium deep-sea-treasure": (several_rewards("deep-sea-treasure"), {"reward": (1.0, 0.1)}),
    "mo-gymnasium resource-gathering": (several_rewards("resource-gathering"), {"reward": (1.0, 1.0, 1.0)}),
    "mo-gymnasium fruit-tree": (several_rewards("fruit-tree"), {"reward": (1.0,) * 6}),
    "popgym CountRecallEasy, one deck": (partial(made, "popgym-CountRecallEasy-v0", "popgym"), MEMORY),
    "popgym RepeatFirstEasy, one deck": (partial(made, "popgym-RepeatFirstEasy-v0", "popgym"), MEMORY),
    "PettingZoo tic-tac-toe, uniform opponent": (tic_tac_toe, {}),
}


def row_of(name, factory, options):
    """Cells of a table on one environment; None where its library is not installed."""
    began = time.process_time()
    try:
        mdp, recording = importers.stepping(factory, **options)
    except PharosError as error:
        text = str(error)
        if "ModuleNotFoundError" in text or "NameNotFound" in text or "NamespaceNotFound" in text:
            return None
        return name, "refused", "", "", f"{time.process_time() - began:.1f}", text
    seconds = time.process_time() - began
    merged = bisimulation.minimize(mdp).num_classes
    matrix = mdp.dynamics.matrix()
    most = int(np.diff(matrix.indptr).max())
    return name, f"{mdp.num_states:,}", f"{merged:,}", str(most), f"{seconds:.1f}", "; ".join(recording.notes)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--max-states", type=int, default=5_000)
    parser.add_argument("--only", default="")
    parser.add_argument("--markdown", type=Path)
    arguments = parser.parse_args()
    head = ("environment", "states", "merged", "successors, at most", "seconds", "notes, or what refused it")
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    print(lines[0], flush=True)
    for name, (factory, options) in CASES.items():
        if arguments.only in name:
            cells = row_of(name, factory, {"max_states": arguments.max_states, **options})
            line = f"| {name}: not installed |" if cells is None else "| " + " | ".join(cells) + " |"
            lines += [] if cells is None else [line]
            print(line, flush=True)
    if arguments.markdown:
        arguments.markdown.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
