"""pharos import: MDPs from elsewhere, as folders that every command takes as environments.

pharos export: MDPs for other programs.
"""

import json
import math
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pharos.cli.answers import Answer, complain, progress_line, termination, written
from pharos.cli.command import Commands
from pharos.cli.options import Count, Discount, Gamma, Target, Tolerance, check_format
from pharos.errors import DivergenceError, ParameterError, PharosError, UnknownName
from pharos.mdp import ChanceSetting
from pharos.system.wording import capped, pluralize

if TYPE_CHECKING:
    import numpy as np

    from pharos.importers import Question, Recording, SteppedStates
    from pharos.mdp import TabularMDP

app = Commands(help="Bring an MDP from elsewhere into a folder.", no_args_is_help=True)

Out = Annotated[Path, typer.Option(help="Folder for the MDP.")]
Episode = Annotated[int | None, typer.Option(min=1, help="Steps of an episode. Default: no limit.")]


@app.command("bridge")
def bridge(file: Path, *, out: Out, horizon: Annotated[int | None, typer.Option(min=1)] = None) -> Answer:
    """Import a tabular MDP of the BRIDGE dataset.

    Args:
        file: npz of the BRIDGE dataset.
        horizon: Steps of an episode. Default: as in the name of the file.
    """
    from pharos import importers

    mdp = importers.bridge(file, horizon)
    screens = importers.bridge_screens(file) if importers.has_screens(file) else None
    importers.save(mdp, out, source=f"BRIDGE: {file.name}", observations=screens)
    return _answer(file.name, mdp, out)


@app.command("minigrid")
def minigrid(name: str, *, out: Out, seed: int = 0, horizon: Count = 100, remember_carried: bool = False) -> Answer:
    """Enumerate an environment of MiniGrid, by playing it from every state.

    Args:
        name: Name of the environment, such as MiniGrid-KeyCorridorS3R1-v0.
        seed: Seed of the layout.
        horizon: Steps of an episode.
        remember_carried: Let objects know whether they were ever carried, as in BRIDGE.
    """
    from pharos import importers

    mdp, grids, actions = importers.minigrid_recording(
        name, seed=seed, horizon=horizon, remember_carried=remember_carried
    )
    source = f"{name}, seed {seed}" + (", objects remember" if remember_carried else "")
    importers.save(mdp, out, source=source, actions=actions, observations=grids, observed="grid")
    return _answer(name, mdp, out)


@app.command("gymnasium")
def gymnasium(
    name: Annotated[str, "ID"],
    *,
    out: Out,
    option: Mapping[str, Any],
    gamma: Discount = 0.99,
    horizon: Episode = None,
    initial: Annotated[str | None, "STATE,..."] = None,
    check: bool = True,
) -> Answer:
    """Import the table P of an environment of Gymnasium. Training takes its time limit.

    Args:
        name: Name of an environment with a table P, such as Taxi-v4.
        option: Option of the environment, such as is_slippery=false.
        gamma: Discount of the MDP.
        initial: The start, or several that are equally likely. Default: the environment's starts.
        check: Compare sampled steps with the table.
    """
    import gymnasium as package

    from pharos import importers

    try:
        env = package.make(name, disable_env_checker=True, **option)
    except Exception as error:  # whatever an environment does with options that are none of its own
        message = " ".join(str(error).split())
        raise ParameterError(f"{name}: Gymnasium cannot make it: {message or type(error).__name__}") from None
    starts = None if initial is None else _start_states(initial)
    mdp = importers.gymnasium(env, gamma=gamma, horizon=horizon, check=check, initial=starts)
    words = " ".join((name, *(f"{key}={written(value)}" for key, value in option.items())))
    limit, outcomes = env.spec.max_episode_steps if env.spec else None, importers.gymnasium_outcomes(env)
    importers.save(mdp, out, source=f"Gymnasium: {words}", time_limit=limit, outcomes=outcomes)
    return _answer(words, mdp, out)


def _start_states(text: str) -> int | list[int]:
    """States from 3, or 0,3,5. ParameterError if it is no such thing."""
    try:
        states = [int(part) for part in text.split(",")]
    except ValueError:
        raise ParameterError(f"--initial is {text!r}; expected numbers of states such as 0,3,5") from None
    return states[0] if len(states) == 1 else states


@app.command("env")
def env(
    target: str,
    *,
    out: Out,
    option: Mapping[str, Any],
    seed: int | None = None,
    key: Annotated[str | None, "CODE"] = None,
    ignore: str = "",
    reward: Annotated[str | None, "CODE"] = None,
    weights: str = "",
    gamma: Gamma = None,
    horizon: Episode = None,
    max_states: Count = 100_000,
    max_outcomes: Count = 3_000,
    workers: Count = 1,
    check: bool = True,
) -> Answer:
    """Import any environment of Gymnasium or JAX by stepping it from every state. The same command resumes.

    Args:
        target: gymnasium:ID, gymnax:ID, pgx:ID, module:factory, file.py:factory, or jax:file.py:factory.
        option: Option of the environment or the factory, such as is_slippery=false.
        seed: Import the start of the reset with this seed. Default: all starts.
        key: module:function or file.py:function (environment) -> equal for equal states. Pairs are checked.
        ignore: Leave these fields out of the state, such as counters of steps: FIELD,FIELD.
        reward: module:function or file.py:function (reward) -> number.
        weights: Weights of a vector of rewards, such as 1,0.5.
        max_states: Fail beyond this many states.
        max_outcomes: Fail if the draws of one step have more outcomes than these.
        workers: Number of processes that share the work.
        check: Play the environment and compare.
    """
    from pharos import importers

    source = importers.StepTarget(target, option, key=key, reward=reward, weights=weights)
    with progress_line(f"stepping {target}") as show:
        mdp, recording = source.import_into(
            out,
            seed=seed,
            ignore=tuple(name for name in ignore.split(",") if name),
            gamma=gamma,
            horizon=horizon,
            max_states=max_states,
            max_outcomes=max_outcomes,
            workers=workers,
            check=check,
            progress=lambda states, seconds, _: show(_stepping_text(states, seconds)),
        )
    for note in recording.notes:
        complain(note)
    answer = _answer(source.words, mdp, out)
    return answer._replace(json={**answer.json, "notes": list(recording.notes)})


def _stepping_text(states: "SteppedStates", seconds: float) -> str:
    left = states.num_states - states.num_expanded
    rate = (states.num_expanded - states.num_resumed) / max(seconds, 1e-9)
    return f"{states.num_states:,} states, {left:,} to expand, step {states.depths[-1]}, {rate:,.0f} states/s"


Noops = Annotated[int, typer.Option(min=0)]


@app.command("atari")
def atari(
    game: str,
    *,
    out: Out,
    horizon: Count = 10,
    frame_skip: Count = 30,
    noops: Noops = 0,
    all_actions: bool = False,
    life_loss_ends: bool = True,
    settle: Annotated[int | None, typer.Option(min=0)] = None,
    raw: bool = False,
    max_states: Count = 100_000,
    workers: Count = 1,
) -> Answer:
    """Enumerate an Atari game over its first steps, as BRIDGE does. The same command resumes an interrupted import.

    Args:
        game: A ROM of ale-py, such as freeway.
        horizon: Steps of an episode.
        frame_skip: Frames of a step, during which the action is held.
        noops: Frames without an action before the first step.
        all_actions: Take all 18 actions, in place of the actions that the game uses.
        life_loss_ends: End the episode when a life is lost.
        settle: Steps without an action after the last one, whose rewards count. Default: 200 in skiing, else 0.
        raw: Keep states that cannot be distinguished.
        max_states: Refuse more states than these.
        workers: Processes that share the work. The result is the same.
    """
    from pharos import importers

    with progress_line("importing") as report, termination():
        mdp, recording = importers.atari(
            game,
            horizon=horizon,
            frame_skip=frame_skip,
            noops=noops,
            all_actions=all_actions,
            life_loss_ends=life_loss_ends,
            settle=settle,
            raw=raw,
            max_states=max_states,
            workers=workers,
            folder=importers.building_folder(out),
            progress=report,
        )
        return _recorded_answer(game, mdp, recording, out)


@app.command("procgen")
def procgen(
    game: str,
    *,
    out: Out,
    level: Annotated[int, typer.Option(min=0)] = 0,
    mode: str = "easy",
    horizon: Count = 10,
    frame_skip: Annotated[int | None, typer.Option(min=1)] = None,
    noops: Noops = 0,
    all_actions: bool = False,
    raw: bool = False,
    max_states: Count = 100_000,
    workers: Count = 1,
) -> Answer:
    """Enumerate a level of a Procgen game over its first steps. The same command resumes an interrupted import.

    Args:
        game: Name of the game, such as maze.
        level: Seed of the level.
        mode: easy, hard, extreme, memory or exploration.
        horizon: Steps of an episode.
        frame_skip: Steps of Procgen in a step, during which the action is held. Default: as in BRIDGE.
        noops: Steps of Procgen without an action before the first step.
        all_actions: Take all 15 actions, in place of the actions that BRIDGE takes.
        raw: Keep states that cannot be distinguished.
        max_states: Refuse more states than these.
        workers: Processes that share the work. The result is the same.
    """
    from pharos import importers

    with progress_line("importing") as report, termination():
        mdp, recording = importers.procgen(
            game,
            level=level,
            mode=mode,
            horizon=horizon,
            frame_skip=frame_skip,
            noops=noops,
            all_actions=all_actions,
            raw=raw,
            max_states=max_states,
            workers=workers,
            folder=importers.building_folder(out),
            progress=report,
        )
        return _recorded_answer(f"{game}, level {level}", mdp, recording, out)


@app.command("prism")
def prism(
    file: Path,
    *,
    out: Out,
    constants: str = "",
    reward: str | None = None,
    target: Annotated[str | None, "LABEL|EXPRESSION"] = None,
    property: str | None = None,
    gamma: Discount = 1.0,
    horizon: Episode = None,
    tolerance: Tolerance = 1e-6,
) -> Answer:
    """Import a model in PRISM's language, in JANI or in Storm's DRN. With a property, answer it.

    Args:
        file: A model: .prism, .nm, .pm, .jani or .drn, built by Storm.
        constants: Values of undefined constants, such as N=3,K=2.
        reward: Reward structure. Default: the only one, if there is no --target.
        target: Label or expression that ends the episode. It pays 1 if there is no --reward.
        property: Property to compute, such as 'Pmax=? [F "goal" & !x=3]' or 'Rmin{"steps"}=? [F "goal"]', or its name
            in a JANI file.
        gamma: Discount of the MDP.
        tolerance: Largest error of the answer to a property.
    """
    from pharos import importers

    mdp, outcomes, question = importers.storm_import(
        file, constants=constants, reward=reward, target=target, property=property, gamma=gamma, horizon=horizon
    )
    words = " ".join(filter(None, (file.name, constants, property)))
    importers.save(mdp, out, source=f"Storm: {words}", outcomes=outcomes)
    if question is None:
        return _answer(file.name, mdp, out)
    return _answer(file.name, mdp, out, *_answered(capped(property, 60), mdp, question, tolerance, out))


def _answered(
    name: str, mdp: "TabularMDP", question: "Question", tolerance: float, out: Path
) -> tuple[dict[str, Any], list[tuple[str, object]]]:
    """The proven interval of the number that a property asks for: as JSON, and as lines of a table."""
    from pharos.solvers import reach, value_iteration, worst_value

    entry: dict[str, Any] = {"text": question.text, "reach": question.reach, "answer": question.answer}
    command = f"pharos solve {out}" + ("" if question.reach is None else f" --reach {shlex.quote(question.reach)}")
    facts: list[tuple[str, object]] = []
    try:
        if question.reach is not None:
            bounds = getattr(reach(mdp, question.reach, tolerance=tolerance), question.answer)
            ends = bounds.lower, bounds.upper
        else:
            total = mdp.with_gamma(1.0).with_horizon(None)
            solution = (worst_value if question.answer == "least_total" else value_iteration)(total, tolerance)
            ends = solution.v - solution.error_bound, solution.v + solution.error_bound
        lower, upper = (_at_start(mdp, each, question.of_starts) for each in ends)
        is_infinite = math.isinf(lower)
        entry |= {"lower": None if is_infinite else lower, "upper": None if is_infinite else upper}
        entry |= {"infinite": is_infinite, "reason": None}
        number = "infinite" if is_infinite else f"{(lower + upper) / 2:.10g}, within {(upper - lower) / 2:.2g}"
        facts.append((name, number))
        values = ends[0][mdp.starts]
        if len(values) > 1 and math.isfinite(values.max()):
            span = f"{values.min():.8g} to {values.max():.8g}"
            facts.append(("start states", f"{len(values):,}, from {span}; the {question.of_starts} is said"))
    except PharosError as error:
        entry |= {"lower": None, "upper": None, "infinite": isinstance(error, DivergenceError), "reason": str(error)}
        facts.append((name, f"not answered: {error}"))
    return {"property": entry}, [*facts, ("more", command)]


def _at_start(mdp: "TabularMDP", values: "np.ndarray", of_starts: str) -> float:
    if of_starts == "mean":
        return float(mdp.start_probabilities @ values[mdp.start_states])
    return float(getattr(values[mdp.starts], of_starts)())


def _answer(
    name: str,
    mdp: "TabularMDP",
    out: Path,
    more: Mapping[str, Any] = MappingProxyType({}),
    facts: Sequence[tuple[str, object]] = (),
) -> Answer:
    answer = {
        "num_states": mdp.num_states,
        "num_actions": mdp.num_actions,
        "num_terminal_states": int(mdp.terminal.sum()),
        "horizon": mdp.horizon,
        "gamma": mdp.gamma,
        "folder": out,
        **more,
    }
    size = f"{mdp.num_states:,} x {pluralize(mdp.num_actions, 'action')}"
    return Answer(answer, (name, [("states", size), ("horizon", mdp.horizon), ("folder", out), *facts]))


def _recorded_answer(name: str, mdp: "TabularMDP", recording: "Recording", out: Path) -> Answer:
    """Keep what an emulator showed, and say how many states were merged."""
    from pharos import importers

    importers.save_recording(mdp, recording, out)
    merged, screens = recording.num_raw_states - mdp.num_states, recording.observations.num_distinct
    more = {
        "num_raw_states": recording.num_raw_states,
        "num_merged_states": merged,
        "num_distinct_observations": screens,
        "layers": recording.layers,
    }
    words = f"{merged:,} of {recording.num_raw_states:,}, by equal screens, rewards and successors"
    return _answer(name, mdp, out, more, [("merged", words), ("distinct screens", f"{screens:,}")])


# Export ---------------------------------------------------------------------------------------------------------------


ENDINGS = {"bridge": ".npz", "drn": ".drn", "gym": ".json"}


def export(
    target: Target,
    *,
    format: str = "bridge",
    out: Path = Path("mdp.npz"),
    gamma: Gamma = None,
    chance: Annotated[ChanceSetting, "random"],
) -> Answer:
    """Write an MDP for another program.

    Args:
        format: bridge (npz), drn (Storm) or gym (P table as JSON).
        out: Write to FILE.npz, FILE.drn or FILE.json.
    """
    if format not in ENDINGS:
        raise UnknownName("format", format, ENDINGS)
    check_format(out, (ENDINGS[format],))
    mdp = target.mdp(gamma=gamma, chance=chance)
    from pharos import exporters
    from pharos.system import storage

    if format == "bridge":
        exporters.bridge(mdp, out)
    elif format == "drn":
        exporters.drn(mdp, out)
    else:
        storage.replace_file(out, json.dumps(exporters.gym_p(mdp)) + "\n", follow=True)
    answer = {"format": format, "file": out, "bytes": out.stat().st_size, "num_states": mdp.num_states}
    horizon = None if mdp.horizon is None else f"{mdp.horizon} steps: not in the file, which has none"
    facts = [("format", format), ("states", f"{mdp.num_states:,}"), ("bytes", f"{answer['bytes']:,}")]
    facts += [("horizon", horizon)] if horizon else []
    return Answer({**answer, "horizon": mdp.horizon}, (str(out), facts))
