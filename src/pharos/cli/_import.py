"""pharos import: MDPs from elsewhere, as folders that every command takes."""

from pathlib import Path
from typing import Annotated

import typer

from pharos.cli.common import Json, print_facts, print_json

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
    answer = {
        "num_states": mdp.num_states,
        "num_actions": mdp.num_actions,
        "num_terminal_states": int(mdp.terminal.sum()),
        "horizon": mdp.horizon,
        "gamma": mdp.gamma,
        "folder": out,
    }
    if json:
        print_json(answer)
        return
    print_facts(
        file.name,
        [
            ("states", f"{mdp.num_states:,} x {mdp.num_actions} actions"),
            ("horizon", mdp.horizon),
            ("folder", out),
        ],
    )


@app.callback()
def _several() -> None:
    """Keep `bridge` a word of its own, as more will follow."""
