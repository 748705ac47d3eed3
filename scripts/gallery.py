"""Makes the pictures of docs/worlds.md: every class, what people and agents see, and an optimal policy at play.

python scripts/gallery.py                      all classes
python scripts/gallery.py sokoban taxi         these alone; the other sections stay as they are
"""

import dataclasses
import re
import sys
from pathlib import Path

import numpy as np

import pharos
from pharos import drawing
from pharos.environments import BUILT_IN, start_distribution
from pharos.observations import render
from pharos.system.wording import pluralize

DOCS = Path(__file__).parents[1] / "docs"
FOLDER = DOCS / "gallery"
INSTANCES = {
    "simple_grid": (("simple_grid/6x6-decoy", 0), ("simple_grid/8x8-plain", 5)),
    "frozen_lake": (("frozen_lake/4x4", 2), ("frozen_lake/8x8", 6), ("frozen_lake/4x4 slippery", 9)),
    "freeway": (("freeway/16x7-speed1", 12), ("freeway/20x11-speed1", 12)),
    "breakout": (("breakout/12x8x1", 60), ("breakout/16x8x3", 60)),
    "sliding_tiles": (("sliding_tiles/3x3", 5), ("sliding_tiles/2x5", 20)),
    "pocket_cube": (("pocket_cube/half", 0), ("pocket_cube/quarter", 8)),
    "sokoban": (("sokoban/pillar", 9), ("sokoban/storehouse", 12)),
    "mini_grid": (("mini_grid/key-corridor-s4r3", 7), ("mini_grid/lava-crossing-s9n2", 3)),
    "mini_grid_empty": (("mini_grid_empty/8x8", 4),),
    "mini_grid_rooms": (("mini_grid_rooms/9x4", 12),),
    "cliff_walking": (("cliff_walking/4x12", 5), ("cliff_walking/4x12-slippery", 9)),
    "taxi": (("taxi/5x5", 6), ("taxi/5x5-rainy", 6)),
    "blackjack": (("blackjack/sutton-barto", 1),),
    "game_2048": (("game_2048/2x3", 40), ("game_2048/3x3-to-64", 25)),
    "corner_grid": (("corner_grid/8x8", 3),),
    "river_swim": (("river_swim/strehl-littman", 2),),
    "deep_sea": (("deep_sea/10x10", 4),),
    "endless_sea": (("endless_sea/10x10", 5),),
    "catch": (("catch/10x5", 4),),
    "memory_chain": (("memory_chain/bits-4", 1),),
    "umbrella_chain": (("umbrella_chain/length-10", 3),),
    "discounting_chain": (("discounting_chain/delays-10", 4),),
}
PLAYED = {  # names of instances
    "simple_grid": "simple_grid/6x6-decoy",
    "frozen_lake": "frozen_lake/8x8, frozen_lake/4x4 slippery",
    "freeway": "freeway/16x7-speed1",
    "breakout": "breakout/12x8x3",
    "mini_grid": "mini_grid/unlock-pickup",
    "mini_grid_empty": "mini_grid_empty/8x8",
    "mini_grid_rooms": "mini_grid_rooms/9x4",
    "sliding_tiles": "sliding_tiles/3x3-hardest",
    "pocket_cube": "pocket_cube/quarter",
    "sokoban": "sokoban/storehouse",
    "cliff_walking": "cliff_walking/4x12-slippery",
    "taxi": "taxi/5x5-rainy",
    "blackjack": "blackjack/sutton-barto",
    "game_2048": "game_2048/3x3-to-64",
    "corner_grid": "corner_grid/8x8-random",
    "river_swim": "river_swim/strehl-littman",
    "deep_sea": "deep_sea/10x10-stochastic",
    "endless_sea": "endless_sea/20x20-random",
    "catch": "catch/10x5",
    "memory_chain": "memory_chain/bits-4",
    "umbrella_chain": "umbrella_chain/length-10",
    "discounting_chain": "discounting_chain/delays-10",
}
for _entry in BUILT_IN:  # a class without an entry above shows its first instance
    _name = "/".join((_entry.name, *_entry.instance_names[:1]))
    INSTANCES.setdefault(_entry.name, ((_name, 3),))
    PLAYED.setdefault(_entry.name, _name)
SEVERAL = ("taxi", "blackjack", "catch", "memory_chain", "umbrella_chain")  # games, from drawn starts: one is soon over
FRAMES_PER_SECOND = {  # others: 12
    **{"sliding_tiles": 4, "pocket_cube": 3, "sokoban": 6, "game_2048": 3, "taxi": 4, "blackjack": 2},
    **{"river_swim": 4, "catch": 6, "memory_chain": 2, "umbrella_chain": 6, "discounting_chain": 6},
}
FRAMES = 90
GAMMA = 0.99


def made(name):
    """An environment by the name of an instance, and of a parameter that is to be true."""
    instance, *switched_on = name.split()
    return pharos.make(instance, **dict.fromkeys(switched_on, True))


def file_of(name, suffix):
    """Where the picture of an instance is."""
    return FOLDER / f"{name.replace('/', '-').replace(' ', '-')}{suffix}"


def optimal(name):
    """(environment, policy): of the discounted problem, so that it does not loiter."""
    env = made(name)
    space = pharos.build(env)
    policy = pharos.value_iteration(space.mdp(gamma=GAMMA)).policy
    return env, lambda state: int(policy[space.index(state)])


def unturned(name):
    """The same for 2048 on boards that do not turn over, whose states are too many: a step ahead to those that do."""
    env = pharos.make(name)
    space = pharos.build(env)
    v = pharos.value_iteration(space.mdp(gamma=GAMMA)).v

    def q(state, action):
        value = 0.0
        for outcome in range(env.outcomes):
            if (likely := env.probability(state, action, outcome)) > 0:
                following = env.next_state(state, action, outcome)
                value += likely * (env.reward(state, action, following) + GAMMA * v[space.index(following)])
        return value

    return dataclasses.replace(env, canonical=False), lambda state: max(range(4), key=lambda a: q(state, a))


def enlarged(picture, height):
    """A small picture enlarged by a whole factor to about `height` pixels, but not beyond a width of 800."""
    factor = max(1, min(round(height / len(picture)), 800 // picture.shape[1]))
    return picture.repeat(factor, axis=0).repeat(factor, axis=1)


def beside(panels, gap=12, height=260):
    """Pictures beside each other, tops aligned, each with its label below; nothing between them, on any ground."""
    pictures = [np.asarray(drawing.image(enlarged(picture, height), label)) for label, picture in panels.items()]
    rows = max(map(len, pictures))
    parts = []
    for picture in pictures:
        framed = np.zeros((rows, picture.shape[1] + gap, 4), np.uint8)  # the fourth: how opaque
        framed[: len(picture), : picture.shape[1]] = np.dstack([picture, np.full(picture.shape[:2], 255, np.uint8)])
        parts.append(framed)
    return np.concatenate(parts, axis=1)[:, :-gap]


def shown(env, state):
    """Human drawing, complex image at its natural size and at 84 x 84, simple image with a plane for each layer."""
    return beside(
        {
            "for people": render(env, state),
            "natural size": render(env, state, "complex_image", size="natural"),
            "84 x 84": render(env, state, "complex_image"),
            "planes: " + ", ".join(env.layers): render(env, state, "simple_image"),
        }
    )


HEAD = """## Pictures

Made by `python scripts/gallery.py`. *What agents see*, from the left: the drawing for people, the complex image at its
natural size and at 84 x 84 pixels, and the planes of the simple image, one for each layer, after some steps of the
optimal policy.

| class | what agents see | the optimal policy |
|---|---|---|
"""


def row(cls):
    """The row of a class, its pictures written."""
    seen, moving = [], []
    for name, steps in INSTANCES[cls]:
        env, policy = optimal(name)
        state = drawing.episode(env, policy, env.initial_states()[0][0], steps=steps)[-1][0]
        file = file_of(name, ".png")
        drawing.save_png(file, shown(env, state))
        states = pharos.build(env).num_states
        seen.append(f"`{name}`, {states:,} states, after {pluralize(steps, 'step')}: ![{name}](gallery/{file.name})")
    for name in PLAYED[cls].split(", "):
        env, policy = (unturned if cls == "game_2048" else optimal)(name)
        pictures = [render(env, state, "complex_image", size="natural") for state in played(env, policy, cls)]
        file = file_of(name, ".gif")
        drawing.save_gif(file, pictures, frames_per_second=FRAMES_PER_SECOND.get(cls, 12), at_least=160)
        moving.append(f"`{name}`: ![{name}](gallery/{file.name})")
    return f"| **{cls}** | {'<br>'.join(seen)} | {'<br>'.join(moving)} |"


def played(env, policy, cls):
    """The states of an episode of at most FRAMES steps, or of several games where they are short."""
    starts, probabilities = start_distribution(env)
    if cls not in SEVERAL:
        return [state for state, _, _ in drawing.episode(env, policy, starts[0], steps=FRAMES)]
    chosen = np.random.default_rng(0).choice(len(starts), 8, p=probabilities)
    games = [drawing.episode(env, policy, starts[k], steps=FRAMES, seed=seed) for seed, k in enumerate(chosen)]
    return [state for game in games for state, _, _ in game][:FRAMES]


def main(chosen) -> None:
    """Write the rows of the chosen classes anew; of all of them where none is named."""
    FOLDER.mkdir(exist_ok=True)
    page = DOCS / "worlds.md"
    before, _, after = page.read_text().partition("## Pictures\n")
    texts = re.findall(r"^(\| \*\*(\w+)\*\* .*)$", after, re.MULTILINE) if chosen else []
    rows = {cls: text for text, cls in texts} | {cls: row(cls) for cls in chosen or INSTANCES}
    page.write_text(before + HEAD + "".join(f"{rows[cls]}\n" for cls in INSTANCES if cls in rows))


if __name__ == "__main__":
    main(sys.argv[1:])
