"""pharos explore: an MDP state by state, on a page in the browser."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pharos.cli.answers import complain, print_json, progress_line
from pharos.cli.evaluate import read_policy
from pharos.cli.options import (
    Json,
    Lazy,
    MaxStates,
    Memory,
    Parameters,
    Random,
    Sticky,
    TargetArgument,
    Trust,
    Workers,
    build_options,
    check_format,
)
from pharos.cli.target import Target, parse_target
from pharos.errors import ParameterError

if TYPE_CHECKING:
    from pharos.explorer import Exploration, Learnt


def explore(
    target: TargetArgument,
    parameters: Parameters = None,
    policy: Annotated[
        str | None,
        typer.Option("--policy", help="FILE.npy, or the folder of a finished run: shown beside optimal and uniform."),
    ] = None,
    gamma: Annotated[
        float | None,
        typer.Option("--gamma", min=0, max=1, help="Discount; 0.99 when not given. Values have no horizon."),
    ] = None,
    sticky: Sticky = 0.0,
    random: Random = 0.0,
    lazy: Lazy = 0.0,
    out: Annotated[
        Path | None, typer.Option("--out", help="FILE.html: one page with all its data, for up to 10,000 states.")
    ] = None,
    port: Annotated[int, typer.Option("--port", min=0, max=65535, help="Of the local server; 0: any free one.")] = 0,
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Open the page in the browser.")] = True,
    memory: Memory = None,
    workers: Workers = None,
    max_states: MaxStates = None,
    trust: Trust = False,
    json: Json = False,
) -> None:
    """Show states, values, gaps, paths and maps on a page in the browser; TARGET may be the folder of a run, too."""
    if out is not None:
        check_format(out, (".html",))
    goal = parse_target(target, parameters)
    building = build_options(memory, workers, max_states)
    from pharos.explorer import Server, write
    from pharos.training import ChanceSetting

    with progress_line("exploring") as report:
        options: dict[str, Any] = {
            "learnt": _learnt(policy, trust),
            "gamma": gamma,
            "chance": ChanceSetting(sticky, random, lazy),
        }
        options |= {
            "trust": trust,
            "title": " ".join((target, *(parameters or ()))),
            "progress": report,
            "in_one_page": out is not None,
        }
        world = _exploration(goal, building, **options)
        if out is not None:
            file = write(world, out)
        else:
            server = Server(world, port)
    answer: dict[str, Any] = {"title": world.title, "num_states": world.mdp.num_states, "gamma": world.mdp.gamma}
    if out is not None:
        answer |= {"file": file, "bytes": file.stat().st_size}
        print_json(answer) if json else print(file)
        return
    if json:
        print_json({**answer, "url": server.url, "port": server.port})
    else:
        print(server.url)
    sys.stdout.flush()
    _serve(server, browser and not json and sys.stdout.isatty())


def _serve(server: Any, with_browser: bool) -> None:
    """Answer until the user interrupts; that is how it ends, so it is no error."""
    from pharos.explorer import open_browser

    try:
        if with_browser and not open_browser(server.url):
            complain("no browser opened: open the address above in one on this machine")
        if sys.stderr.isatty():
            complain("Ctrl-C ends it")
        server.serve()
    except KeyboardInterrupt:
        if sys.stderr.isatty():
            print(file=sys.stderr)
    finally:
        server.leave()


def _learnt(policy: str | None, trust: bool) -> "Learnt | None":
    """What `--policy` names."""
    if policy is None:
        return None
    from pharos.explorer import Learnt

    named = read_policy(policy, trust=trust)
    agent, seeing = named.policy, named.seeing
    return Learnt(agent, Path(policy).name, **seeing)


def _exploration(goal: Target, building: dict[str, Any], **options: Any) -> "Exploration":
    """What a target shows; `building` as for `build`, `options` as for `exploration_of`."""
    from pharos.explorer import exploration_of

    if goal.path is not None and (goal.path / "run.json").is_file():
        return exploration_of(goal.path, **options | {"title": ""})
    if goal.is_imported:
        assert goal.path is not None
        env = goal.found_environment() if goal.path.is_dir() else None
        return exploration_of(goal.mdp(), env=env, **options)
    options["progress"]("states")
    space = goal.space(**building)
    if space.environment is None:
        raise ParameterError(
            f"{goal.text}: pharos does not know the class {space.manifest['class']} of this environment, so not its "
            f"rewards; name it as module:Class instead of its folder"
        )
    return exploration_of(space, **options)
