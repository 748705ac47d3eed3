"""Makes the table and the pictures of docs/atari.md: games of Atari enumerated over their first steps, and solved.

python scripts/atari_page.py                 all games
python scripts/atari_page.py pong freeway    these alone; the other rows stay as they are
python scripts/atari_page.py --runs FOLDER   the table of runs beside their predictions, from finished runs in FOLDER
python scripts/atari_page.py --predict       what `pharos predict` says of the same games now, beside their runs

Needs ale-py for games. Pictures are screens of an optimal play; the tables stay in a temporary folder.
"""

import csv
import json
import re
import sys
import tempfile
from pathlib import Path

import numpy as np

import pharos
from pharos import drawing, hardness, importers
from pharos.statistics import spearman

PAGE = Path(__file__).parents[1] / "docs" / "atari.md"
GAMES = {  # horizon, and other options of the import
    "freeway": (12, {}),
    "pong": (20, {}),
    "breakout": (14, {}),
    "boxing": (3, {}),
    "seaquest": (7, {}),
    "tennis": (3, {}),
    "space_invaders": (5, {"noops": 120}),
    "ms_pacman": (6, {"noops": 240}),
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
    if sys.argv[1:2] == ["--runs"]:
        return write_runs(Path(sys.argv[2]))
    if sys.argv[1:2] == ["--predict"]:
        return predict_again()
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


STUDY = PAGE.parent / "studies" / "atari"
RESULTS = ("normalized_regret", "final_regret", "final_value", "value_optimal", "value_uniform")
RUNS = "| game | agent | seeds | predicted, and its interval | observed: mean, least and most | last policy |"


def write_runs(folder: Path) -> None:
    """runs.csv of the study, one row a finished run, and its table on the page."""
    rows = []
    for file in sorted(folder.rglob("run.json")):
        record = json.loads(file.read_text())
        if record["status"] == "finished":
            config, result = record["config"], record["result"]
            game = Path(config["parameters"]["folder"]).name
            numbers = [f"{result[name]:.6f}" for name in RESULTS]
            rows.append([game, config["agent"], config["seed"], *numbers, f"{record['seconds']:.0f}"])
    with (STUDY / "runs.csv").open("w", newline="") as stream:
        table = csv.writer(stream, lineterminator="\n")
        table.writerow(["game", "agent", "seed", *RESULTS, "seconds"])
        table.writerows(rows)
    before, _, rest = PAGE.read_text().partition(RUNS)
    after = rest.partition("\n\n")[2]
    with (STUDY / "predictions.csv").open() as stream:
        cells = [cell for cell in csv.DictReader(stream) if regrets_of(cell, rows)]
    lines = [line_of(cell, rows) for cell in cells]
    after = re.sub(r"Of DQN's intervals .*?\n\n", lambda _: agreement(cells, rows) + "\n\n", after, flags=re.DOTALL)
    PAGE.write_text("\n".join([before + RUNS, "|---" * RUNS.count(" | ") + "|---|", *lines, "", after]))


def predict_again() -> None:
    """Print the lines of the table of runs by the predictors of today, and how far they agree."""
    with (STUDY / "predictions.csv").open() as stream:
        cells = list(csv.DictReader(stream))
    with (STUDY / "runs.csv").open() as stream:
        rows = [list(row.values()) for row in csv.DictReader(stream)]
    for game in dict.fromkeys(cell["game"] for cell in cells):
        horizon, options = GAMES[game]
        with tempfile.TemporaryDirectory() as place:
            importers.save_recording(*table_and_screens(game, horizon, options), place)
            env = pharos.make("imported", folder=place)
            for cell in (cell for cell in cells if cell["game"] == game):
                answer = pharos.predict(env, ("recorded", {"grey": True, "size": 84}), agent=cell["agent"]).cells[0]
                cell |= {"predicted_regret": str(answer.value), "low": str(answer.low), "high": str(answer.high)}
                print(line_of(cell, rows), flush=True)
    print(agreement(cells, rows))


def agreement(cells: list[dict[str, str]], rows: list[list]) -> str:
    """How many intervals hold the mean of the runs, and the rank correlation of both, in words."""
    held, ranks = [], []
    for agent in ("dqn", "ppo"):
        own = [(cell, np.mean(regrets_of(cell, rows))) for cell in cells if cell["agent"] == agent]
        held.append(f"{sum(float(cell['low']) <= mean <= float(cell['high']) for cell, mean in own)} of {len(own)}")
        predicted = [float(cell["predicted_regret"]) for cell, _ in own]
        ranks.append(spearman(np.array(predicted), np.array([mean for _, mean in own])))
    return (
        f"Of DQN's intervals {held[0]} hold the mean of the runs, with a rank correlation of {ranks[0]:.2f}. Of PPO's\n"
        f"{held[1]} hold it, with a rank correlation of {ranks[1]:.2f}."
    )


def regrets_of(cell: dict[str, str], rows: list[list]) -> list[float]:
    """Normalised regrets of the runs that a prediction was made for."""
    return [float(row[3]) for row in rows if row[:2] == [cell["game"], cell["agent"]]]


def line_of(cell: dict[str, str], rows: list[list]) -> str:
    """The line of a game and an agent: prediction beside runs."""
    own = [row for row in rows if row[:2] == [cell["game"], cell["agent"]]]
    regrets, last = regrets_of(cell, rows), [float(row[4]) / (float(row[6]) - float(row[7])) for row in own]
    predicted = f"{float(cell['predicted_regret']):.2f} ({float(cell['low']):.2f} to {float(cell['high']):.2f})"
    observed = f"{np.mean(regrets):.2f} ({min(regrets):.2f} to {max(regrets):.2f})"
    return f"| `{cell['game']}` | {cell['agent']} | {len(own)} | {predicted} | {observed} | {np.mean(last):.2f} |"


if __name__ == "__main__":
    main()
