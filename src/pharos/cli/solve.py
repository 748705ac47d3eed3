"""pharos solve: optimal values, beside those of the uniformly random policy."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pharos.cli.answers import (
    compiling_fact,
    describe_chance,
    describe_discount,
    print_facts,
    print_json,
    progress_line,
    termination,
)
from pharos.cli.options import (
    Gamma,
    Horizon,
    Json,
    Lazy,
    MaxStates,
    Memory,
    Parameters,
    Processes,
    Random,
    Sticky,
    TargetArgument,
    Workers,
    build_options,
    check_format,
    ranks_of,
)
from pharos.cli.target import parse_target
from pharos.system import compiling
from pharos.system.wording import many

if TYPE_CHECKING:
    from pharos.solvers import Solution


def solve(
    target: TargetArgument,
    parameters: Parameters = None,
    gamma: Gamma = None,
    horizon: Horizon = None,
    sticky: Sticky = 0.0,
    random: Random = 0.0,
    lazy: Lazy = 0.0,
    tolerance: Annotated[
        float, typer.Option("--tolerance", help="Largest error of a value, in units of return.")
    ] = 1e-6,
    out: Annotated[
        Path | None, typer.Option("--out", help="FILE.npz for the arrays v and policy, FILE.npy for the policy alone.")
    ] = None,
    values: Annotated[
        Path | None,
        typer.Option(
            "--values",
            help="Folder for the values, in place of memory where that has no room; a solve that was ended goes on.",
        ),
    ] = None,
    threads: Annotated[
        int, typer.Option("--threads", min=1, help="Of a sweep; beyond one, last digits may differ, within the error.")
    ] = 1,
    dtype: Annotated[
        str,
        typer.Option("--dtype", help="Of values: float64; or float32, half the memory, and a bound that counts it."),
    ] = "float64",
    blocks: Annotated[
        int,
        typer.Option(
            "--blocks", min=1, help="Ranges of states that are swept one after another: fewer reads of a disk."
        ),
    ] = 1,
    memory: Memory = None,
    workers: Workers = None,
    processes: Processes = "1",
    max_states: MaxStates = None,
    json: Json = False,
) -> None:
    """Find the optimal values and policy, with a proven error bound. With --processes the same command resumes."""
    ranks = ranks_of(processes)
    if out is not None:
        check_format(out, (".npz", ".npy"))
    building = build_options(memory, workers, max_states, processes)
    chance: dict[str, Any] = {"sticky": sticky, "random": random, "lazy": lazy}
    with termination():
        mdp = parse_target(target, parameters).mdp(gamma=gamma, horizon=horizon, **chance, **building, processes=ranks)
    from pharos.solvers import uniform_value, value_iteration
    from pharos.system import paths

    checkpoint = (values or paths.cache_directory() / "values") if ranks != 1 else None
    sharing: dict[str, Any] = {"processes": ranks, "checkpoint": checkpoint}
    sharing |= {"dtype": dtype, "blocks": blocks}
    suffix = ".npy" if dtype == "float64" else f"-{dtype}.npy"
    with progress_line("solving") as report, termination():

        def solution_by(solver: Callable[..., Any], name: str, policy: str) -> Any:
            return solver(
                mdp,
                tolerance,
                progress=lambda sweeps, bound: report(f"{policy}sweep {sweeps}, error at most {bound:.2g}"),
                values=None if values is None or ranks != 1 else values / f"{name}{suffix}",
                threads=threads,
                **sharing,
            )

        solution = solution_by(value_iteration, "optimal", "")
        report("value of the uniform policy")
        uniform = solution_by(uniform_value, "uniform", "uniform policy, ")
    if solution is None:  # a rank of MPI that is not the first
        return
    if out is not None:
        save(out, solution)
    options = {
        **chance,
        "tolerance": tolerance,
        "dtype": dtype,
        "processes": int(processes) if processes.isdigit() and processes != "1" else ranks,
    }
    if json:
        print_json(_answer(solution, uniform, options, out))
    else:
        print_facts(" ".join((target, *(parameters or ()))), _facts(solution, uniform, chance, out))


def _answer(solution: "Solution", uniform: "Solution", options: Mapping[str, Any], out: Path | None) -> dict[str, Any]:
    """What --json prints; options: those that it repeats."""
    return {
        "value_at_start": solution.value_at_start,
        "uniform_value_at_start": uniform.value_at_start,
        "error_bound": solution.error_bound,
        "sweeps": solution.sweeps,
        "seconds": solution.seconds,
        "compiling_seconds": compiling.seconds(),
        "gamma": solution.gamma,
        "horizon": solution.horizon,
        **options,
        "uniform_error_bound": uniform.error_bound,
        "uniform_seconds": uniform.seconds,
        "num_states": solution.mdp.num_states,
        "num_actions": solution.mdp.num_actions,
        "file": None if out is None else str(out),
    }


def _facts(
    solution: "Solution", uniform: "Solution", chance: Mapping[str, float], out: Path | None
) -> list[tuple[str, object]]:
    """What is printed without --json."""
    mdp = solution.mdp
    facts: list[tuple[str, object]] = [
        ("optimal value at the start", f"{solution.value_at_start:.8g}"),
        ("uniform policy at the start", f"{uniform.value_at_start:.8g}"),
        ("error at most", f"{max(solution.error_bound, uniform.error_bound):.2g}"),
        ("discount", describe_discount(solution.gamma, solution.horizon)),
        ("chance", describe_chance(chance["sticky"], chance["random"], mdp.dynamics.has_chance, chance["lazy"])),
        ("states", f"{mdp.num_states:,} x {many(mdp.num_actions, 'action')}"),
        ("sweeps", f"{solution.sweeps} in {solution.seconds:.2f} s"),
        *compiling_fact(),
    ]
    return facts if out is None else [*facts, ("written", out)]


def save(path: Path, solution: "Solution") -> None:
    """Write the policy (.npy), or values and policy (.npz)."""
    import numpy as np

    from pharos.system import storage

    if path.suffix.lower() == ".npy":
        storage.replace_array(path, solution.policy)
        return
    with storage.replacing(path) as file:
        np.savez_compressed(file, v=solution.v, policy=solution.policy)
