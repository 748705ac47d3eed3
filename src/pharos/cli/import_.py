"""pharos import: MDPs from elsewhere, as folders that every command takes."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pharos.cli.common import Json, print_facts, print_json
from pharos.wording import many

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
    importers.save(mdp, out, source=f"BRIDGE: {file.name}")
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

    mdp = importers.minigrid(name, seed=seed, horizon=horizon, remember_carried=remember_carried)
    importers.save(mdp, out, source=f"{name}, seed {seed}" + (", objects remember" if remember_carried else ""))
    _tell(name, mdp, out, json)


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
