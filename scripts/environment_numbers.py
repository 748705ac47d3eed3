"""Writes docs/environments.json: counts and values of every named instance, for the pages of the site.

python scripts/environment_numbers.py                          what is missing, or was computed under other rules
python scripts/environment_numbers.py breakout taxi/5x5        these alone, anew
python scripts/environment_numbers.py --max-states 300000000   larger instances too; by default up to 3 million states
"""

import argparse
import json
import tempfile
from pathlib import Path

import pharos
from pharos import solvers
from pharos.environments import classes, named_instances
from pharos.errors import StateSpaceTooLarge
from pharos.system import storage

FILE = Path(__file__).parents[1] / "docs" / "environments.json"
GAMMA = 0.99
SWEPT = 10_000_000_000  # state-action pairs times steps, up to which the time limit of episodes is a horizon, too


def key_of(name: str) -> dict:
    """What the numbers of an instance depend on."""
    cls_name, parameters = named_instances()[name]
    cls = classes()[cls_name]
    return {"version": cls.version, "parameters": json.loads(json.dumps(dict(parameters)))}


def numbers_of(name: str, max_states: int) -> dict:
    """Counts, and values at the start of the optimal, the uniform and the worst policy."""
    env = pharos.make(name)
    with tempfile.TemporaryDirectory() as folder:
        try:
            space = pharos.build(env, f"{folder}/space", max_states=max_states, progress=False)
        except StateSpaceTooLarge:
            return {**key_of(name), "more_than": max_states}
        counts = {
            "num_states": space.num_states,
            "num_terminal_states": space.num_terminal_states,
            "num_actions": space.num_actions,
            "depth": space.depth,
            "episode_limit": env.max_episode_steps,
        }
        values = {"discounted": values_of(space.mdp(gamma=GAMMA), None)}
        if space.num_states * space.num_actions * env.max_episode_steps <= SWEPT:
            values["episode"] = values_of(space.mdp(gamma=1.0), env.max_episode_steps)
        return {**key_of(name), **counts, "gamma": GAMMA, **values}


def values_of(mdp, horizon: int | None) -> dict[str, float]:
    """Values at the start, each within 1e-6."""
    found = (solver(mdp, 1e-6, horizon=horizon) for solver in SOLVERS.values())
    return {name: solution.value_at_start for name, solution in zip(SOLVERS, found, strict=True)}


SOLVERS = {"optimal": solvers.value_iteration, "uniform": solvers.uniform_value, "worst": solvers.worst_value}


def main() -> None:
    """Compute what is asked for, and write after each instance: a killed run has kept what it had."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*")
    parser.add_argument("--max-states", type=int, default=3_000_000)
    options = parser.parse_args()
    stored = json.loads(FILE.read_text()) if FILE.exists() else {}
    for wanted in options.names:
        if not any(name == wanted or name.startswith(f"{wanted}/") for name in named_instances()):
            parser.error(f"{wanted}: no named instance, so no numbers; name some in `instances` of the class")
    for name in named_instances():
        old = stored.get(name, {})
        if options.names and not any(name == wanted or name.startswith(f"{wanted}/") for wanted in options.names):
            continue
        fits = all(old.get(part) == value for part, value in key_of(name).items())
        if not options.names and fits and old.get("more_than", options.max_states) >= options.max_states:
            continue
        print(name, flush=True)
        stored[name] = numbers_of(name, options.max_states)
        ordered = {name: stored[name] for name in named_instances() if name in stored}
        lines = ",\n".join(f"{json.dumps(name)}: {json.dumps(numbers)}" for name, numbers in ordered.items())
        storage.replace_file(FILE, f"{{\n{lines}\n}}\n")


if __name__ == "__main__":
    main()
