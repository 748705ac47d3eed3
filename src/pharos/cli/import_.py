"""pharos import: MDPs from elsewhere, as folders that every command takes as environments.

pharos export: MDPs for other programs.
"""

import json as json_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pharos.cli.answers import print_facts, print_json
from pharos.cli.options import Gamma, Json, Parameters, Random, TargetArgument, check_format, parse_parameters
from pharos.cli.target import parse_target
from pharos.errors import ParameterError, UnknownName
from pharos.system.wording import many

if TYPE_CHECKING:
    from pharos.mdp import TabularMDP

app = typer.Typer(help="Bring an MDP from elsewhere into a folder.", no_args_is_help=True)


@app.command("bridge")
def bridge(
    file: Annotated[Path, typer.Argument(help="npz of the BRIDGE dataset.")],
    out: Annotated[Path, typer.Option("--out", help="Folder for the MDP.")],
    horizon: Annotated[
        int | None, typer.Option("--horizon", min=1, help="Steps of an episode; what the name says when not given.")
    ] = None,
    json: Json = False,
) -> None:
    """Import a tabular MDP of the BRIDGE dataset."""
    from pharos import importers

    mdp = importers.bridge(file, horizon)
    screens = importers.bridge_screens(file) if importers.has_screens(file) else None
    importers.save(mdp, out, source=f"BRIDGE: {file.name}", observations=screens)
    _tell(file.name, mdp, out, json)


@app.command("minigrid")
def minigrid(
    name: Annotated[str, typer.Argument(help="Such as MiniGrid-KeyCorridorS3R1-v0.")],
    out: Annotated[Path, typer.Option("--out", help="Folder for the MDP.")],
    seed: Annotated[int, typer.Option("--seed", help="Of the layout.")] = 0,
    horizon: Annotated[int, typer.Option("--horizon", min=1, help="Steps of an episode.")] = 100,
    remember_carried: Annotated[
        bool, typer.Option("--remember-carried", help="Objects know whether they were ever carried, as in BRIDGE.")
    ] = False,
    json: Json = False,
) -> None:
    """Enumerate an environment of MiniGrid, by playing it from every state."""
    from pharos import importers

    mdp, grids, actions = importers.minigrid_recording(
        name, seed=seed, horizon=horizon, remember_carried=remember_carried
    )
    source = f"{name}, seed {seed}" + (", objects remember" if remember_carried else "")
    importers.save(mdp, out, source=source, actions=actions, observations=grids, observed="grid")
    _tell(name, mdp, out, json)


@app.command("gymnasium")
def gymnasium(
    name: Annotated[str, typer.Argument(metavar="ID", help="Such as Taxi-v4: an environment with a table P.")],
    out: Annotated[Path, typer.Option("--out", help="Folder for the MDP.")],
    option: Annotated[
        list[str] | None,
        typer.Option("--option", metavar="NAME=VALUE", help="Of the environment, such as is_slippery=false."),
    ] = None,
    gamma: Annotated[float, typer.Option("--gamma", min=0, max=1, help="Discount of the MDP.")] = 0.99,
    horizon: Annotated[
        int | None, typer.Option("--horizon", min=1, help="Steps of an episode; without end when not given.")
    ] = None,
    check: Annotated[bool, typer.Option("--check/--no-check", help="Compare sampled steps with the table.")] = True,
    json: Json = False,
) -> None:
    """Import the table P of an environment of Gymnasium; training takes its time limit."""
    import gymnasium as package

    from pharos import importers

    options = parse_parameters(option)
    try:
        env = package.make(name, disable_env_checker=True, **options)
    except Exception as error:  # whatever an environment does with options that are none of its own
        said = " ".join(str(error).split())
        raise ParameterError(f"{name}: Gymnasium cannot make it: {said or type(error).__name__}") from None
    mdp = importers.gymnasium(env, gamma=gamma, horizon=horizon, check=check)
    words = " ".join((name, *(option or ())))
    limit, outcomes = env.spec.max_episode_steps if env.spec else None, importers.gymnasium_outcomes(env)
    importers.save(mdp, out, source=f"Gymnasium: {words}", time_limit=limit, outcomes=outcomes)
    _tell(words, mdp, out, json)


@app.command("prism")
def prism(
    file: Annotated[Path, typer.Argument(help="A model: .prism, .nm, .pm, .jani or .drn; built by Storm.")],
    out: Annotated[Path, typer.Option("--out", help="Folder for the MDP.")],
    constants: Annotated[str, typer.Option("--constants", help="Undefined ones, such as N=3,K=2.")] = "",
    reward: Annotated[
        str | None, typer.Option("--reward", help="Reward structure; the only one when not given, without --target.")
    ] = None,
    target: Annotated[
        str | None, typer.Option("--target", help="Label that ends the episode; pays 1 where there is no --reward.")
    ] = None,
    gamma: Annotated[float, typer.Option("--gamma", min=0, max=1, help="Discount of the MDP.")] = 1.0,
    horizon: Annotated[
        int | None, typer.Option("--horizon", min=1, help="Steps of an episode; without end when not given.")
    ] = None,
    json: Json = False,
) -> None:
    """Import a model in PRISM's language, in JANI or in Storm's DRN."""
    from pharos import importers

    mdp, outcomes = importers.storm_recording(
        file, constants=constants, reward=reward, target=target, gamma=gamma, horizon=horizon
    )
    importers.save(mdp, out, source=f"Storm: {file.name} {constants}".rstrip(), outcomes=outcomes)
    _tell(file.name, mdp, out, json)


def _tell(name: str, mdp: "TabularMDP", out: Path, json: bool) -> None:
    if json:
        print_json(
            {
                "num_states": mdp.num_states,
                "num_actions": mdp.num_actions,
                "num_terminal_states": int(mdp.terminal.sum()),
                "horizon": mdp.horizon,
                "gamma": mdp.gamma,
                "folder": out,
            }
        )
        return
    size = f"{mdp.num_states:,} x {many(mdp.num_actions, 'action')}"
    print_facts(name, [("states", size), ("horizon", mdp.horizon), ("folder", out)])


# Export ---------------------------------------------------------------------------------------------------------------


ENDINGS = {"bridge": ".npz", "drn": ".drn", "gym": ".json"}


def export(
    target: TargetArgument,
    parameters: Parameters = None,
    format: Annotated[
        str, typer.Option("--format", help="bridge (npz), drn (Storm) or gym (P table as JSON).")
    ] = "bridge",
    out: Annotated[Path, typer.Option("--out", help="FILE.npz, FILE.drn or FILE.json.")] = Path("mdp.npz"),
    gamma: Gamma = None,
    random: Random = 0.0,
    json: Json = False,
) -> None:
    """Write an MDP for another program."""
    if format not in ENDINGS:
        raise UnknownName("format", format, ENDINGS)
    check_format(out, (ENDINGS[format],))
    mdp = parse_target(target, parameters).mdp(gamma=gamma, random=random)
    from pharos import exporters
    from pharos.system import storage

    if format == "bridge":
        exporters.bridge(mdp, out)
    elif format == "drn":
        exporters.drn(mdp, out)
    else:
        storage.replace_file(out, json_module.dumps(exporters.gym_p(mdp)) + "\n")
    answer = {"format": format, "file": out, "bytes": out.stat().st_size, "num_states": mdp.num_states}
    if json:
        print_json(answer)
    else:
        print_facts(
            str(out), [("format", format), ("states", f"{mdp.num_states:,}"), ("bytes", f"{out.stat().st_size:,}")]
        )
