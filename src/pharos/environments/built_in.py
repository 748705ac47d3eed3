"""The built-in environments, by name: enough to list them and to register them with Gymnasium without loading them.

BUILT_IN is the only list of environments. Everything else about a class stands in its own file. A test compares what is
said of it here with the class, and prints the entry that it expects.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from pharos.environments.base import Environment


class BuiltIn(NamedTuple):
    """A class of environments that comes with pharos.

    Attributes:
        name: of the class, as users type it, and of its file in `worlds/`, or in `mini_grid/`.
        class_name: as Python has it.
        instances: the names of its named instances, separated by spaces.
        version: of its Gymnasium ids.
    """

    name: str
    class_name: str
    instances: str = ""
    version: int = 0

    @property
    def file(self) -> str:
        """Module of the class, below `pharos.environments`."""
        return f"{'mini_grid' if self.name.startswith('mini_grid') else 'worlds'}.{self.name}"

    @property
    def instance_names(self) -> tuple[str, ...]:
        """Names of the instances."""
        return tuple(self.instances.split())


BUILT_IN = (  # in the order in which they are listed
    BuiltIn("simple_grid", "SimpleGrid", "4x4-decoy 4x4-plain 6x6-decoy 6x6-plain 8x8-decoy 8x8-plain"),
    BuiltIn("frozen_lake", "FrozenLake", "4x4 8x8"),
    BuiltIn(
        "freeway",
        "Freeway",
        "20x11-speed1 20x11-speed2 25x13-speed1 25x13-speed2 20x5-speed1 20x5-speed2 16x7-speed1 16x7-speed2 "
        "25x9-speed1 25x9-speed2 5x5-speed1",
    ),
    BuiltIn(
        "breakout",
        "Breakout",
        "12x10x1 12x8x1 16x8x1 20x8x1 24x8x1 12x10x3 12x8x3 16x8x3 20x8x3 24x8x3 14x8x1 14x10x3 20x10x1 20x10x3 "
        "24x10x3 20x10x1-3rows 30x10x1-3rows 6x4x1",
    ),
    BuiltIn("sliding_tiles", "SlidingTiles", "2x2 2x3 3x3 3x3-hardest 2x4 2x5 3x4"),
    BuiltIn("pocket_cube", "PocketCube", "half quarter half-4 quarter-4"),
    BuiltIn(
        "sokoban",
        "Sokoban",
        "corridor corner two-rooms pillar three-in-a-row storehouse random-1 random-2 random-3",
    ),
    BuiltIn(
        "mini_grid",
        "MiniGrid",
        "empty-5x5 empty-6x6 empty-8x8 empty-16x16 empty-random-5x5 empty-random-6x6 four-rooms door-key-5x5 "
        "door-key-6x6 door-key-8x8 door-key-16x16 unlock unlock-pickup key-corridor-s3r1 key-corridor-s3r2 "
        "key-corridor-s3r3 key-corridor-s4r3 key-corridor-s5r3 key-corridor-s6r3 lava-gap-s5 lava-gap-s6 lava-gap-s7 "
        "lava-crossing-s9n1 lava-crossing-s9n2 lava-crossing-s9n3 lava-crossing-s11n5 simple-crossing-s9n1 "
        "simple-crossing-s9n2 simple-crossing-s9n3 simple-crossing-s11n5 multi-room-n2-s4 multi-room-n4-s5 "
        "multi-room-n6-s5 multi-room-n6-s10 dist-shift1 dist-shift2",
    ),
    BuiltIn("mini_grid_empty", "MiniGridEmpty", "8x8 8x8-lazy"),
    BuiltIn("mini_grid_rooms", "MiniGridRooms", "4x3 9x4"),
    BuiltIn("cliff_walking", "CliffWalking", "4x12 4x12-slippery 8x24 8x24-slippery"),
    BuiltIn("taxi", "Taxi", "5x5 5x5-rainy 5x5-fickle 5x5-rainy-fickle 10x10"),
    BuiltIn("blackjack", "Blackjack", "sutton-barto plain natural"),
    BuiltIn("corner_grid", "CornerGrid", "8x8 8x8-random"),
    BuiltIn("river_swim", "RiverSwim", "strehl-littman osband colosseum"),
    BuiltIn("deep_sea", "DeepSea", "10x10 50x50 10x10-stochastic"),
    BuiltIn("endless_sea", "EndlessSea", "10x10 20x20-random"),
    BuiltIn("catch", "Catch", "10x5"),
    BuiltIn("memory_chain", "MemoryChain", "length-10 bits-4"),
    BuiltIn("umbrella_chain", "UmbrellaChain", "length-10 length-100"),
    BuiltIn("discounting_chain", "DiscountingChain", "bonus-1 bonus-100 delays-10"),
    BuiltIn("delayed_choice", "DelayedChoice", "length-8 copies-16 noisy"),
    BuiltIn("game_2048", "Game2048", "2x2 2x3 3x3 2x2-to-32 3x3-to-64 3x3-to-256 3x3-to-512 3x3-to-1024"),
)

_CALLBACKS: list[Callable[[type["Environment"]], None]] = []


def on_registration(callback: Callable[[type["Environment"]], None]) -> None:
    """Call `callback` with every user class that is registered from now on."""
    _CALLBACKS.append(callback)


def notify(cls: type["Environment"]) -> None:
    """Call the functions of `on_registration` with a class that has just been registered."""
    for callback in _CALLBACKS:
        callback(cls)
