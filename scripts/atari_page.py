"""Makes the table and the pictures of docs/atari.md: games of Atari enumerated over their first steps, and solved.

python scripts/atari_page.py                 all games
python scripts/atari_page.py pong freeway    these alone; the other rows stay as they are

Needs ale-py. Pictures are screens of an optimal play; the tables stay in a temporary folder.
"""

import re
import sys
import tempfile
from pathlib import Path

import numpy as np

import pharos
from pharos import drawing, hardness, importers

PAGE = Path(__file__).parents[1] / "docs" / "atari.md"
GAMES = {  # horizon, and other options of the import
    "freeway": (12, {}),
    "pong": (20, {}),
    "breakout": (14, {}),
    "boxing": (3, {}),
    "seaquest": (7, {}),
    "tennis": (3, {}),
    "space_invaders": (5, {"noops": 120}),
}
COLUMNS = "game, T, states, merged to, screens, actions, optimum, random, diameter, effective horizon, play"
HEAD = f"| {COLUMNS.replace(', ', ' | ')} |"


def table_and_screens(game: str, horizon: int, options: dict) -> tuple[pharos.TabularMDP, importers.Recording]:
    """The MDP of a game, and what it shows."""
    with tempfile.TemporaryDirectory() as place:
        return importers.atari(game, horizon=horizon, folder=Path(place) / "layers", max_states=20_000, **options)


def optimal_play(mdp: pharos.TabularMDP, v: np.ndarray) -> list[int]:
    """States of an episode that is worth V*, the first best action in each."""
    table, state, states = np.asarray(mdp.dynamics.deterministic_table()), 0, [0]
    while len(states) < mdp.horizon:
        following = table[state]
        q = mdp.rewards[state] + np.where(following >= 0, v[following], 0.0)
        state = int(following[int(q.argmax())])
        if state < 0:
            break
        states.append(state)
    return states


def row(game: str) -> str:
    """The row of a game, its picture written."""
    horizon, options = GAMES[game]
    mdp, recording = table_and_screens(game, horizon, options)
    solution, uniform = pharos.value_iteration(mdp), pharos.solvers.uniform_value(mdp)
    file = PAGE.parent / "gallery" / f"atari-{game.replace('_', '-')}.gif"
    pictures = list(recording.observations[optimal_play(mdp, solution.v)])
    drawing.save_gif(file, pictures, frames_per_second=2, at_least=160)
    words = " ".join(f"{key}={value}" for key, value in options.items())
    numbers = f"{recording.num_raw_states:,} | {mdp.num_states:,} | {recording.observations.num_distinct:,}"
    values = f"{mdp.num_actions} | {solution.value_at_start:g} | {uniform.value_at_start:.3g}"
    effective, diameter = hardness.effective_horizon(mdp).value, hardness.diameter(mdp)
    far = f"{diameter.lower:g}" if diameter.exact else f"{diameter.lower:g} to {diameter.upper:g}"
    return (
        f"| {f'`{game}` {words}'.strip()} | {horizon} | {numbers} | {values} | {far} | {effective:g} | "
        f"![{game}](gallery/{file.name}) |"
    )


def main() -> None:
    for name in sys.argv[1:] or GAMES:
        line = row(name)
        print(line, flush=True)
        put(name, line)


def put(name: str, line: str) -> None:
    """Write the row of a game into the page."""
    before, _, rest = PAGE.read_text().partition(HEAD)
    lines, _, after = rest.partition("\n\n")
    rows = {match[1]: match[0] for match in re.finditer(r"^\| `(\w+)`.*$", lines, re.MULTILINE)} | {name: line}
    ordered = "\n".join(rows[game] for game in GAMES if game in rows)
    PAGE.write_text(f"{before}{HEAD}\n{'|---' * HEAD.count(' | ')}|---|\n{ordered}\n\n{after}")


if __name__ == "__main__":
    main()
