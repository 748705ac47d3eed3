"""pharos build: enumerate a state space.

pharos count: how many states there are, in one line.

pharos check: whether a class keeps the contract, and whether there is anything to learn in an instance of it.
"""

import math
import shutil
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from pharos.cli.answers import Answer, bytes_of, compiling_fact, describe, peak_memory_bytes, size_text
from pharos.cli.options import Building, Count, SharedBuilding, Target
from pharos.errors import ParameterError, PharosError, StateSpaceTooLarge
from pharos.system import compiling
from pharos.system.compiling import Stopwatch
from pharos.system.wording import pluralize

if TYPE_CHECKING:
    from pharos.environments import Environment
    from pharos.mdp import TabularMDP
    from pharos.state_space import StateSpace


def build(building: SharedBuilding, target: Target, *, out: Path | None = None) -> Answer:
    """Enumerate every state that can be reached, and its transitions, onto disk. The same command resumes.

    Args:
        out: Write to this folder. Default: the cache.
    """
    from pharos import state_space
    from pharos.state_space import cached_folder

    options, env = building.options, target.found_environment()
    was_there = _is_there(out or cached_folder(env))
    watch = Stopwatch()
    space = state_space.build(env, out, **options)
    seconds = watch.seconds
    rate, peak, bytes_on_disk = space.num_states / seconds, peak_memory_bytes(), bytes_of(space.folder)
    answer = {
        "environment": env.name,
        "parameters": space.parameters,
        "num_states": space.num_states,
        "num_actions": space.num_actions,
        **({"num_transitions": space.manifest["num_transitions"]} if space.has_chance else {}),
        "num_terminal_states": space.num_terminal_states,
        "depth": space.depth,
        "seconds": seconds,
        "compiling_seconds": watch.compiling,
        "states_per_second": rate,
        "peak_memory_bytes": peak,
        "bytes_on_disk": bytes_on_disk,
        "folder": str(space.folder),
        "found": was_there,
    }
    pace = "it was there already" if was_there else f"{rate:,.0f} states/s"
    facts = [
        ("states", f"{space.num_states:,} ({space.num_terminal_states:,} terminal)"),
        ("actions", f"{space.num_actions} ({', '.join(env.actions)})"),
        *_outcomes(space),
        ("depth", f"{space.depth:,}"),
        ("seconds", f"{seconds:.2f} ({pace})"),
        *compiling_fact(),
        ("peak memory", size_text(peak)),
        ("on disk", size_text(bytes_on_disk)),
        ("folder", space.folder),
    ]
    return Answer(answer, (describe(env), facts))


def _outcomes(space: "StateSpace") -> list[tuple[str, str]]:
    """Numbers of outcomes of actions as a fact, or none if the rules have no chance."""
    if not space.has_chance:
        return []
    manifest = space.manifest
    return [("outcomes", f"at most {manifest['num_outcomes']} of an action, {manifest['num_transitions']:,} in all")]


def _is_there(folder: Path) -> bool:
    """Whether the folder already holds the finished state space."""
    from pharos.state_space import read_manifest

    manifest = read_manifest(folder)
    return manifest is not None and bool(manifest["complete"])


# Count ----------------------------------------------------------------------------------------------------------------


MOST_QUICK_STATES = 10_000  # states, so that solving takes no time


def count(target: Target, *, building: Building) -> Answer:
    """Count the states that can be reached, their transitions and the depth, and keep nothing."""
    watch, most = Stopwatch(), building.max_states
    counted = counts_of_table(_table_of(target)) if target.is_imported else _counts_of_space(target, building)
    if target.is_imported and most is not None and counted["num_states"] > most:
        raise StateSpaceTooLarge(f"{target.target}: has {counted['num_states']:,} states; expected at most {most:,}")
    extra = "" if counted.pop("has_regret", True) else ", no policy beats uniform play"
    answer = {"target": target.target, **counted, "seconds": watch.seconds, "compiling_seconds": watch.compiling}
    apart = counted["num_states"] - counted["num_reachable_states"]
    return Answer(
        answer,
        f"{target.title}: {pluralize(counted['num_states'], 'state')} ({counted['num_terminal_states']:,} terminal"
        + (f", {apart:,} never reached" if apart else "")
        + f"), {pluralize(counted['num_actions'], 'action')}, {pluralize(counted['num_transitions'], 'transition')}, "
        f"depth {counted['depth']:,}, {watch.seconds:.2f} s{extra}"
        + "".join(f", compiling {how_long}" for _, how_long in compiling_fact()),
    )


def _table_of(goal: Target) -> "TabularMDP":
    """The imported table. The horizon, which a file of BRIDGE may lack, does not matter here."""
    try:
        return goal.mdp()
    except ParameterError:
        return goal.mdp(horizon=1)


def _counts_of_space(goal: Target, building: Building) -> dict[str, int]:
    """Counts of a folder, or of the cache if the space is there. Otherwise it is built beside the cache and removed."""
    from pharos.state_space import cached_folder, load, read_manifest
    from pharos.system import storage

    if goal.environment is None:
        assert goal.path is not None
        return counts_of(load(goal.path, verify=False))
    manifest = read_manifest(cached_folder(goal.environment))
    if manifest is not None and manifest["complete"]:
        return counts_of(goal.space(building))
    cache = storage.cache_directory()
    cache.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(prefix="count-", dir=cache))
    try:
        return counts_of(goal.space(building, temporary))
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def counts_of(space: "StateSpace") -> dict[str, int]:
    """Counts of a built state space: all of its states can be reached."""
    rows = space.manifest["num_transitions"] if space.has_chance else space.num_states * space.num_actions
    return {
        "num_states": space.num_states,
        "num_reachable_states": space.num_states,
        "num_terminal_states": space.num_terminal_states,
        "num_actions": space.num_actions,
        "num_transitions": rows - space.num_terminal_states * space.num_actions,
        "depth": space.depth,
        "has_regret": space.num_states > MOST_QUICK_STATES or _has_regret(space.mdp(gamma=0.99)),
    }


def _has_regret(mdp: "TabularMDP") -> bool:
    """Whether some policy is better than uniform play."""
    from pharos.regret import regret_scale
    from pharos.solvers import uniform_value, value_iteration

    optimal, uniform = value_iteration(mdp), uniform_value(mdp)
    error = max(optimal.error_bound, uniform.error_bound)
    return not math.isnan(regret_scale(optimal.value_at_start, uniform.value_at_start, error))


def counts_of_table(mdp: "TabularMDP") -> dict[str, int]:
    """Counts of a table: transitions are possible outcomes in states that are not terminal, ends included."""
    import numpy as np

    terminal = np.asarray(mdp.terminal)
    visited, transitions, depth = np.zeros(mdp.num_states + 1, np.bool_), 0, -1
    visited[-1] = True
    frontier = mdp.starts
    while frontier.size:
        depth += 1
        visited[frontier] = True
        live = frontier[~terminal[frontier]]
        actions = np.tile(np.arange(mdp.num_actions), len(live))
        outcomes = mdp.dynamics.outcomes(np.repeat(live, mdp.num_actions), actions)
        transitions += int((outcomes.probabilities > 0).sum())
        frontier = np.unique(outcomes.states[(outcomes.probabilities > 0) & ~visited[outcomes.states]])
    return {
        "num_states": mdp.num_states,
        "num_reachable_states": int(visited[:-1].sum()),
        "num_terminal_states": int(terminal.sum()),
        "num_actions": mdp.num_actions,
        "num_transitions": transitions,
        "depth": depth,
    }


# Check ----------------------------------------------------------------------------------------------------------------


UNSOLVED = "not solved: not all states were looked at; --max-states 100000 looks at so many"


def check(target: Target, *, max_states: Count = 1000) -> Answer:
    """Check an environment against the contract, state by state, and whether any policy beats uniform play.

    Args:
        max_states: Check at most this many states. Raise it for a larger sample.
    """
    env = target.found_environment()
    from pharos import check_environment

    conformance = check_environment(env, max_states=max_states)
    values, sentence = _values(env) if conformance.complete else (None, UNSOLVED)
    notes = {"notes": [*conformance.notes, sentence], "values": values, "compiling_seconds": compiling.seconds()}
    lines = [sentence, *(f"{name}: {value}" for name, value in compiling_fact())]
    return Answer({**vars(conformance), **notes}, "\n  ".join([str(conformance), *lines]))


def _values(env: "Environment") -> tuple[dict[str, float] | None, str]:
    """Optimal, uniform and worst value of an episode, and a sentence about them."""
    from pharos.training import Task

    try:
        values = Task(env).reference
    except PharosError as error:
        return None, f"not solved: {error}"
    numbers = {"optimal": values.optimal, "uniform": values.uniform, "worst": values.worst}
    text = f"an episode is worth {values.optimal:.6g} at best, {values.uniform:.6g} by uniform play"
    if math.isnan(values.spread()):
        return numbers, f"{text}: no policy beats uniform play, so there is nothing to learn"
    return numbers, f"{text}, {values.worst:.6g} at worst"
