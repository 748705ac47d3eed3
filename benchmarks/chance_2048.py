"""What chance costs where there is much of it: 2048, and the same game in which the player chooses the new tile, too.

    python benchmarks/chance_2048.py [--quick] [--repeats 3]

Both have the same states. The game without chance has A K actions, so its cost divided by K is what A actions of one
outcome cost; the game with chance is to cost at most K + 1 times that. Processor time of one thread, files written;
medians of runs in turn.
"""

import argparse
import statistics
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import pharos
from pharos.environments import Game2048
from pharos.environments.base import Environment
from pharos.environments.worlds.game_2048 import executed
from pharos.mdp import BEST
from pharos.solvers.fixed_point import Backup

move = Game2048.transition


@dataclass(frozen=True, kw_only=True)
class ChosenTiles(Game2048):
    """Action a K + k does what action a of 2048 does with outcome k; with a possible one where k is not."""

    name = "chosen_tiles"
    instances = {}
    outcomes = 1
    probability = Environment.probability

    @property
    def most(self) -> int:
        """K."""
        return 2 * (self.cells - 1)

    @property
    def actions(self) -> tuple[str, ...]:  # type: ignore[override]
        """A K of them."""
        return tuple(f"{action} {k}" for action in Game2048.actions for k in range(self.most))

    def transition(self, state, action, out):
        way, empty = executed(self, state, action // self.most)
        move(self, state, way, action % self.most % (2 * empty), out)


def nanoseconds(env: Environment) -> tuple[int, float, float, float]:
    """(states; for each of them nanoseconds of building, bytes of files, nanoseconds of a sweep)."""
    with tempfile.TemporaryDirectory() as folder:
        began = time.process_time()
        space = pharos.build(env, Path(folder) / "space", progress=False, workers=1)
        built = time.process_time() - began
        size = sum(entry["bytes"] for entry in space.manifest["arrays"].values())
        backup = Backup(space.mdp(gamma=0.99), BEST)
        x = backup.zeros()
        backup.sweep(x)
        seconds = []
        for _ in range(5):
            began = time.process_time()
            backup.sweep(x)
            seconds.append(time.process_time() - began)
        states = space.num_states
        return states, 1e9 * built / states, size / states, 1e9 * min(seconds) / states


def main(target: int, repeats: int) -> None:
    games = (Game2048, ChosenTiles)
    runs = [[nanoseconds(game(target=target)) for game in games] for _ in range(repeats + 1)][1:]
    K = Game2048().outcomes
    chance, chosen = ([statistics.median(run[i][what] for run in runs) for what in range(4)] for i in (0, 1))
    assert chance[0] == chosen[0]
    print(f"2048 on 3 x 3 to {target}: {chance[0]:,} states, 4 actions, K = {K}")
    for name, what in (("building", 1), ("a sweep", 3)):
        one = chosen[what] / K
        print(
            f"  {name:9} {chance[what]:6.0f} ns a state; by one outcome of each action {one:5.0f}; "
            f"{chance[what] / one:.1f} times (at most {K + 1})"
        )
    print(f"  files     {chance[2]:6.0f} bytes a state; by one outcome of each action {chosen[2] / K:5.0f}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="to 16 in place of 32, once")
    parser.add_argument("--repeats", type=int, default=3)
    arguments = parser.parse_args()
    main(*(16, 1) if arguments.quick else (32, arguments.repeats))
