"""pharos export: MDPs for other programs."""

import json as json_module
from pathlib import Path
from typing import Annotated

import typer

from pharos.cli.answers import print_facts, print_json
from pharos.cli.options import Gamma, Json, Parameters, Random, TargetArgument, check_format
from pharos.cli.target import parse_target
from pharos.errors import UnknownName

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
