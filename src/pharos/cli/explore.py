"""pharos explore: an MDP state by state, on a page in the browser."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pharos.cli.answers import complain, print_json, progress_line
from pharos.cli.evaluate import read_policy
from pharos.cli.options import Chance, Discount, Trust, file_ending
from pharos.cli.target import Building, Target

if TYPE_CHECKING:
    from pharos.explorer import Exploration, Learnt, Server


def explore(
    target: Target,
    *,
    policy: str | None = None,
    gamma: Discount | None = None,
    chance: Chance,
    out: Annotated[Path | None, file_ending(".html")] = None,
    port: Annotated[int, typer.Option(min=0, max=65535)] = 0,
    browser: bool = True,
    building: Building,
    trust: Trust = False,
    json: bool = False,
) -> None:
    """Show states, values, gaps, paths and maps on a page in the browser; TARGET may be the folder of a run, too.

    Args:
        policy: FILE.npy, or the folder of a finished run: shown beside optimal and uniform.
        gamma: Discount; 0.99 when not given. Values have no horizon.
        out: FILE.html: one page with all its data, for up to 10,000 states.
        port: Of the local server; 0: any free one.
        browser: Open the page in the browser.
    """
    from pharos.explorer import Server, write

    with progress_line("exploring") as report:
        world = _exploration(
            target,
            building,
            learnt=_learnt(policy, trust),
            gamma=gamma,
            chance=chance,
            trust=trust,
            title=target.title,
            progress=report,
            in_one_page=out is not None,
        )
        server = None if out is not None else Server(world, port)
        file = None if out is None else write(world, out)
    answer: dict[str, Any] = {"title": world.title, "num_states": world.mdp.num_states, "gamma": world.mdp.gamma}
    if file is not None:
        print_json({**answer, "file": file, "bytes": file.stat().st_size}) if json else print(file)
    if server is not None:
        print_json({**answer, "url": server.url, "port": server.port}) if json else print(server.url)
        sys.stdout.flush()
        _serve(server, browser and not json and sys.stdout.isatty())


def _serve(server: "Server", with_browser: bool) -> None:
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
    """Policy that `--policy` names."""
    if policy is None:
        return None
    from pharos.explorer import Learnt

    named = read_policy(policy, trust=trust)
    agent, seeing = named.policy, named.seeing
    return Learnt(agent, Path(policy).name, **seeing)


def _exploration(goal: Target, building: Building, **options: Any) -> "Exploration":
    """Exploration of a target; `options` as for `exploration_of`."""
    from pharos.explorer import exploration_of

    if goal.path is not None and (goal.path / "run.json").is_file():
        return exploration_of(goal.path, **options | {"title": ""})
    if goal.is_imported:
        assert goal.path is not None
        env = goal.found_environment() if goal.path.is_dir() else None
        return exploration_of(goal.mdp(), env=env, **options)
    options["progress"]("states")
    return exploration_of(goal.rewarded_space(building), **options)
