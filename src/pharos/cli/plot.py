"""pharos plot: pictures of runs, values, state spaces, hardness and policies at play.

pharos explore: an MDP state by state, on a page in the browser.
"""

import contextlib
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from pharos.cli.answers import Answer, complain, print_json, progress_line
from pharos.cli.command import Commands
from pharos.cli.evaluate import NAMED_POLICIES, read_policy, solution_of
from pharos.cli.options import (
    Building,
    Chance,
    Count,
    Discount,
    Gamma,
    Horizon,
    Seed,
    Target,
    Targets,
    Trust,
    file_ending,
    parse_parameters,
)
from pharos.errors import ParameterError
from pharos.mdp import ChanceSetting, uniform_choice

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from pharos.explorer import Exploration, Explorer, Learnt


app = Commands(no_args_is_help=True, help="Draw runs, values, state spaces, hardness and policies at play.")

Runs = Annotated[list[Path], typer.Argument(metavar="RUN_DIR...", help="Folders of finished runs.")]
Picture = Annotated[Path, file_ending(".png", ".pdf", ".svg", help="FILE.png, FILE.pdf or FILE.svg.")]


@app.command()
def regret(runs: Runs, *, out: Picture) -> Answer:
    """Draw the regret of runs over their steps. Runs that differ in the seed alone become one line with an interval."""
    from pharos import plots

    return _saved(plots.regret(runs), out, {"runs": [str(folder) for folder in runs]})


@app.command()
def value(
    target: Target,
    *,
    out: Picture,
    policy: str = "optimal",
    gamma: Gamma = None,
    horizon: Horizon = None,
    chance: Annotated[ChanceSetting, "random"],
    fix: Annotated[list[str] | None, "NAME=VALUE|start"] = None,
    over: Annotated[str, "NAME,NAME"] = "row,column",
    trust: Trust = False,
) -> Answer:
    """Draw the values and the actions of a policy over the cells of a grid, or over any two variables.

    Args:
        policy: optimal, uniform, worst, FILE.npy, or the folder of a finished run.
        fix: Draw the slice in which this variable has this value. start: all others as at the start of episodes.
        over: Two variables to draw over: down, and to the right.
    """
    down, comma, right = over.partition(",")
    if not comma:
        raise ParameterError(f"--over is {over!r}; expected two variables, such as row,column")
    rest: Literal["start"] | None = "start" if "start" in (fix or ()) else None
    fixed = parse_parameters([text for text in fix or () if text != "start"])
    decisions = None if policy in NAMED_POLICIES else read_policy(policy, trust=trust)
    mdp = target.mdp(gamma=gamma, horizon=horizon, chance=chance)
    from pharos import plots

    solution = solution_of(mdp, policy, decisions, 1e-6)
    title = f"{target.title}, {policy if policy in NAMED_POLICIES else Path(policy).name}"
    if chance:
        title += f", {chance.in_words()}"
    facts = {"policy": policy, "value_at_start": solution.value_at_start, "gamma": mdp.gamma, "horizon": mdp.horizon}
    if fixed:
        title += f", {' '.join(f'{name}={value}' for name, value in fixed.items())}"
    drawn = plots.value_map(target.space(), solution, over=(down, right), fix=fixed, rest=rest, title=title)
    return _saved(drawn, out, facts)


@app.command()
def growth(targets: Targets, *, out: Picture) -> Answer:
    """Draw the number of states at each distance from the start."""
    from pharos import plots

    spaces = {text: Target(text).space() for text in targets}
    sizes = {text: space.num_states for text, space in spaces.items()}
    return _saved(plots.growth(spaces), out, {"num_states": sizes})


@app.command()
def plane(
    targets: Targets,
    *,
    out: Picture,
    visitation: str = "diameter",
    estimation: str = "sum_of_reciprocal_gaps",
    gamma: Gamma = None,
    budget: Annotated[float, typer.Option(min=0.1)] = 60.0,
) -> Answer:
    """Draw instances by visitation and estimation complexity. A diameter known as an interval is a bar.

    Args:
        visitation, estimation: Name of a measure.
        budget: Seconds for each measure.
    """
    from pharos import hardness, plots

    reports = {}
    for text in targets:
        with progress_line(text):
            reports[text] = hardness.report(Target(text).mdp(gamma=gamma), [visitation, estimation], budget=budget)
    drawn = plots.hardness_plane(reports, visitation=visitation, estimation=estimation)
    values = {text: {name: report[name].value for name in (visitation, estimation)} for text, report in reports.items()}
    return _saved(drawn, out, {"measures": values})


@app.command()
def policies(
    runs: Runs,
    *,
    out: Annotated[Path, file_ending(".gif")],
    steps: Count = 200,
    seed: Seed = 0,
    gamma: Discount = 0.99,
    trust: Trust = False,
) -> Answer:
    """Draw an episode of what runs have learnt on one task, beside the optimal policy and a random one, as a GIF.

    Args:
        out: Write to FILE.gif.
        steps: Draw at most this many steps.
        seed: Seed of chance and of random actions.
        gamma: Discount of the optimal policy.
    """
    import numpy as np

    from pharos import plots
    from pharos.solvers import value_iteration
    from pharos.training import load_agent

    loaded = {folder.name: load_agent(folder, trust=trust) for folder in runs}
    tasks = [task for task, _ in loaded.values()]
    # Tables see the state itself
    observed_tasks = [task for task, agent in loaded.values() if not isinstance(agent, np.ndarray)]
    task = (observed_tasks or tasks)[0]
    if len({(each.env.name, str(each.env.parameters)) for each in tasks}) > 1:
        raise ParameterError("the runs are of several environments; draw each in a picture of its own")
    if len({str(each.observation) for each in observed_tasks}) > 1:
        raise ParameterError("the runs have several observations; draw each in a picture of its own")
    agents: dict[str, Any] = {name: agent for name, (_, agent) in loaded.items()}
    best = value_iteration(task.mdp.with_horizon(None).with_gamma(gamma))
    agents["optimal"] = best.policy
    agents["random"] = uniform_choice(task.mdp)
    plots.policies(task, agents, out, steps=min(steps, task.time_limit), seed=seed)
    return _answer(out, {"policies": list(agents)})


def _saved(drawn: "Figure", out: Path, facts: dict[str, Any]) -> Answer:
    from pharos import plots

    plots.save(drawn, out)
    return _answer(out, facts)


def _answer(out: Path, facts: dict[str, Any]) -> Answer:
    return Answer({**facts, "file": out, "bytes": out.stat().st_size}, out)


# Explore --------------------------------------------------------------------------------------------------------------


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
    """Show states, values, gaps, paths and maps on a page in the browser. TARGET may also be the folder of a run.

    Args:
        policy: FILE.npy, or the folder of a finished run: shown beside optimal and uniform.
        gamma: Discount. Default: 0.99. Values have no horizon.
        out: Write one page with all its data to FILE.html, for up to 10,000 states.
        port: Port of the local server. 0 picks a free one.
        browser: Open the page in the browser.
    """
    from pharos.explorer import Explorer, write

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
        explorer = None if out is not None else Explorer(world, port=port)
        file = None if out is None else write(world, out)
    answer: dict[str, Any] = {"title": world.title, "num_states": world.mdp.num_states, "gamma": world.mdp.gamma}
    if file is not None:
        print_json({**answer, "file": file, "bytes": file.stat().st_size}) if json else print(file)
    if explorer is not None:
        print_json({**answer, "url": explorer.url, "port": explorer.port}) if json else print(explorer.url)
        sys.stdout.flush()
        _serve(explorer, browser and not json and sys.stdout.isatty())


def _serve(explorer: "Explorer", with_browser: bool) -> None:
    """Serve requests until the user interrupts, which is not an error."""
    from pharos.explorer import open_browser

    with explorer, contextlib.suppress(KeyboardInterrupt):
        if with_browser and not open_browser(explorer.url):
            complain("no browser opened: open the address above in one on this machine")
        if sys.stderr.isatty():
            complain("Ctrl-C ends it")
        explorer.wait()
    if sys.stderr.isatty():
        print(file=sys.stderr)


def _learnt(policy: str | None, trust: bool) -> "Learnt | None":
    """Policy that `--policy` names."""
    if policy is None:
        return None
    from pharos.explorer import Learnt

    named = read_policy(policy, trust=trust)
    return Learnt(named.policy, Path(policy).name, **named.observer_options)


def _exploration(goal: Target, building: Building, **options: Any) -> "Exploration":
    """Exploration of a target. `options` are the same as for `exploration_of`."""
    from pharos.explorer import exploration_of

    if goal.path is not None and (goal.path / "run.json").is_file():
        return exploration_of(goal.path, **options | {"title": ""})
    if goal.is_imported:
        assert goal.path is not None
        env = goal.found_environment() if goal.path.is_dir() else None
        return exploration_of(goal.mdp(), env=env, **options)
    options["progress"]("states")
    return exploration_of(goal.rewarded_space(building), **options)
