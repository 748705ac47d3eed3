"""pharos plot: pictures of runs, values, state spaces, hardness and policies at play."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from pharos.cli.answers import describe_chance, print_json, progress_line
from pharos.cli.evaluate import POLICIES, read_policy
from pharos.cli.options import (
    Gamma,
    Horizon,
    Json,
    Parameters,
    Random,
    TargetArgument,
    Trust,
    check_format,
    parse_parameters,
)
from pharos.cli.target import parse_target
from pharos.errors import ParameterError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

app = typer.Typer(no_args_is_help=True, help="Draw runs, values, state spaces, hardness and policies at play.")

Out = Annotated[Path, typer.Option("--out", help="FILE.png, FILE.pdf or FILE.svg.")]
Runs = Annotated[list[Path], typer.Argument(metavar="RUN_DIR...", help="Folders of finished runs.")]
Targets = Annotated[
    list[str], typer.Argument(metavar="TARGET...", help="Instances such as frozen_lake/8x8, or folders.")
]
FIGURES = (".png", ".pdf", ".svg")


@app.command()
def regret(runs: Runs, out: Out, json: Json = False) -> None:
    """Draw the regret of runs over their steps; runs that differ in the seed alone become one line with an interval."""
    check_format(out, FIGURES)
    from pharos import plots

    _save(plots.regret(runs), out, json, {"runs": [str(folder) for folder in runs]})


@app.command()
def value(
    target: TargetArgument,
    out: Out,
    parameters: Parameters = None,
    policy: Annotated[
        str, typer.Option("--policy", help="optimal, uniform, worst, FILE.npy, or the folder of a finished run.")
    ] = "optimal",
    gamma: Gamma = None,
    horizon: Horizon = None,
    random: Random = 0.0,
    fix: Annotated[
        list[str] | None,
        typer.Option(
            "--fix",
            metavar="NAME=VALUE|start",
            help="Draw the slice in which this variable has this value; start: all others as where episodes start.",
        ),
    ] = None,
    over: Annotated[
        str, typer.Option("--over", metavar="NAME,NAME", help="Two variables to draw over: down, and to the right.")
    ] = "row,column",
    trust: Trust = False,
    json: Json = False,
) -> None:
    """Draw the values and the actions of a policy over the cells of a grid, or over any two variables."""
    check_format(out, FIGURES)
    down, comma, right = over.partition(",")
    if not comma:
        raise ParameterError(f"--over is {over!r}; expected two variables, such as row,column")
    rest: Literal["start"] | None = "start" if "start" in (fix or ()) else None
    fixed = parse_parameters([text for text in fix or () if text != "start"])
    goal = parse_target(target, parameters)
    decisions = None if policy in POLICIES else read_policy(policy, trust=trust)
    mdp = goal.mdp(gamma=gamma, horizon=horizon, random=random)
    from pharos import plots
    from pharos.cli.evaluate import solution_of

    solution = solution_of(mdp, policy, decisions, 1e-6)
    name = policy if policy in POLICIES else Path(policy).name
    title = f"{' '.join((target, *(parameters or ())))}, {name}"
    if random:
        title += f", {describe_chance(0.0, random)}"
    facts = {"policy": policy, "value_at_start": solution.value_at_start, "gamma": mdp.gamma, "horizon": mdp.horizon}
    if fixed:
        title += f", {' '.join(f'{name}={value}' for name, value in fixed.items())}"
    drawn = plots.value_map(goal.space(), solution, over=(down, right), fix=fixed, rest=rest, title=title)
    _save(drawn, out, json, facts)


@app.command()
def growth(targets: Targets, out: Out, json: Json = False) -> None:
    """Draw the number of states at each distance from the start."""
    check_format(out, FIGURES)
    from pharos import plots

    spaces = {text: parse_target(text).space() for text in targets}
    sizes = {text: space.num_states for text, space in spaces.items()}
    _save(plots.growth(spaces), out, json, {"num_states": sizes})


@app.command()
def plane(
    targets: Targets,
    out: Out,
    visitation: Annotated[str, typer.Option("--visitation", help="A measure.")] = "diameter",
    estimation: Annotated[str, typer.Option("--estimation", help="A measure.")] = "sum_of_reciprocal_gaps",
    gamma: Gamma = None,
    budget: Annotated[float, typer.Option("--budget", min=0.1, help="Seconds for each measure.")] = 60.0,
    json: Json = False,
) -> None:
    """Draw instances by visitation and estimation complexity; a diameter known as an interval is a bar."""
    check_format(out, FIGURES)
    from pharos import hardness, plots

    reports = {}
    for text in targets:
        with progress_line(text):
            mdp = parse_target(text).mdp(gamma=gamma)
            reports[text] = hardness.report(mdp, [visitation, estimation], budget=budget)
    drawn = plots.hardness_plane(reports, visitation=visitation, estimation=estimation)
    values = {text: {name: report[name].value for name in (visitation, estimation)} for text, report in reports.items()}
    _save(drawn, out, json, {"measures": values})


@app.command()
def policies(
    runs: Runs,
    out: Annotated[Path, typer.Option("--out", help="FILE.gif.")],
    steps: Annotated[int, typer.Option("--steps", min=1, help="At most.")] = 200,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Of chance and of random actions.")] = 0,
    gamma: Annotated[float, typer.Option("--gamma", min=0, max=1, help="Discount of the best policy.")] = 0.99,
    trust: Trust = False,
    json: Json = False,
) -> None:
    """Draw an episode of what runs have learnt on one task, beside the best policy and a random one, as a GIF."""
    check_format(out, (".gif",))
    import numpy as np

    from pharos import plots
    from pharos.solvers import value_iteration
    from pharos.training import load_agent

    loaded = {folder.name: load_agent(folder, trust=trust) for folder in runs}
    tasks = [task for task, _ in loaded.values()]
    seeing = [
        task for task, agent in loaded.values() if not isinstance(agent, np.ndarray)
    ]  # tables see the state itself
    task = (seeing or tasks)[0]
    if len({(each.env.name, str(each.env.parameters)) for each in tasks}) > 1:
        raise ParameterError("the runs are of several environments; draw each in a picture of its own")
    if len({str(each.observation) for each in seeing}) > 1:
        raise ParameterError("the runs have several observations; draw each in a picture of its own")
    agents: dict[str, Any] = {name: agent for name, (_, agent) in loaded.items()}
    best = value_iteration(task.mdp.with_horizon(None).with_gamma(gamma))
    agents["optimal"] = best.policy
    agents["random"] = np.full((task.mdp.num_states, task.mdp.num_actions), 1 / task.mdp.num_actions)
    plots.policies(task, agents, out, steps=min(steps, task.time_limit), seed=seed)
    _answer(out, json, {"policies": list(agents)})


def _save(drawn: "Figure", out: Path, json: bool, facts: dict[str, Any]) -> None:
    from pharos import plots

    plots.save(drawn, out)
    _answer(out, json, facts)


def _answer(out: Path, json: bool, facts: dict[str, Any]) -> None:
    if json:
        print_json({**facts, "file": out, "bytes": out.stat().st_size})
    else:
        print(out)
