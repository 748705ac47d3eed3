"""What chance costs when a state space is built: Breakout, and the same with a paddle that slips.

    python benchmarks/slipping.py [--repeats 5]

The states are the same, the transitions K times as many. Processor time of one thread, files written, runs of the three
classes in turn; medians, and ratios to the class without chance, of which at most K + 1 is wanted.
"""

import argparse
import statistics
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import pharos
from pharos.environments import Breakout

STAY = 1
move = Breakout.transition


@dataclass(frozen=True, kw_only=True)
class StickyPaddle(Breakout):
    """The paddle stays where it is one time in ten."""

    slip: float = 0.1

    name = "sticky_paddle"
    instances = {}
    paper_instances = ()
    outcomes = 2

    def probability(self, state, action, outcome):
        return self.slip if outcome == 1 else 1.0 - self.slip

    def transition(self, state, action, outcome, out):
        move(self, state, STAY if outcome == 1 else action, out)


@dataclass(frozen=True, kw_only=True)
class SlippingPaddle(Breakout):
    """Each of the two other actions is executed one time in ten."""

    slip: float = 0.1

    name = "slipping_paddle"
    instances = {}
    paper_instances = ()
    outcomes = 3

    def probability(self, state, action, outcome):
        return self.slip if outcome > 0 else 1.0 - 2.0 * self.slip

    def transition(self, state, action, outcome, out):
        move(self, state, (action + outcome) % 3, out)


def seconds(env: pharos.Environment) -> tuple[int, int, float, float]:
    """(states, bytes of files, seconds of building, of the rewards of all transitions)."""
    with tempfile.TemporaryDirectory() as folder:
        began = time.process_time()
        space = pharos.build(env, Path(folder) / "space", progress=False, workers=1)
        built = time.process_time()
        _ = space.packed_states, space.dynamics  # looks at the arrays
        looked = time.process_time()
        space.mdp()
        paid = time.process_time() - looked
        size = sum(entry["bytes"] for entry in space.manifest["arrays"].values())
        return space.num_states, size, built - began, paid


def main(repeats: int) -> None:
    classes = (Breakout, StickyPaddle, SlippingPaddle)
    runs = [[seconds(cls(height=12, columns=8)) for cls in classes] for _ in range(repeats + 1)][1:]
    first = None
    for number, cls in enumerate(classes):
        states, size = runs[0][number][:2]
        built, paid = (1e9 / states * statistics.median(run[number][i] for run in runs) for i in (2, 3))
        first = first or built
        times = statistics.median(run[number][2] / run[0][2] for run in runs)
        print(
            f"{cls.__name__:16} K = {cls.outcomes}: {states:,} states, building {built:.0f} ns a state ({times:.2f} "
            f"times), {size / states:.0f} bytes a state, rewards {paid:.0f} ns a state"
        )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=5)
    main(parser.parse_args().repeats)
