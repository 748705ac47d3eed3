"""pharos solve: optimal values, beside those of the uniformly random policy."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from pharos.cli.answers import Answer, compiling_fact, describe_chance, describe_discount, progress_line, termination
from pharos.cli.evaluate import ACTING
from pharos.cli.options import Chance, Count, Gamma, Horizon, Tolerance, file_ending
from pharos.cli.target import SharedBuilding, Target
from pharos.system import compiling
from pharos.system.wording import many

if TYPE_CHECKING:
    from pharos.solvers import Solution


def solve(
    building: SharedBuilding,
    target: Target,
    *,
    gamma: Gamma = None,
    horizon: Horizon = None,
    chance: Chance,
    tolerance: Tolerance = 1e-6,
    out: Annotated[Path | None, file_ending(".npz", ".npy")] = None,
    values: Path | None = None,
    threads: Count = 1,
    dtype: str = "float64",
    blocks: Count = 1,
) -> Answer | None:
    """Find the optimal values and policy, with a proven error bound. With --processes the same command resumes.

    Args:
        out: FILE.npz for the arrays v and policy, FILE.npy for the policy alone.
        values: Folder for the values, in place of memory where that has no room; a solve that was ended goes on.
        threads: Of a sweep; beyond one, last digits may differ, within the error.
        dtype: Of values: float64; or float32, half the memory, and a bound that counts it.
        blocks: Ranges of states that are swept one after another: fewer reads of a disk.
    """
    ranks, processes = building.ranks, building.processes
    with termination():
        mdp = target.mdp(building, gamma=gamma, horizon=horizon, chance=chance)
    from pharos.solvers import uniform_value, value_iteration
    from pharos.system import paths

    checkpoint = (values or paths.cache_directory() / "values") if ranks != 1 else None
    suffix = ".npy" if dtype == "float64" else f"-{dtype}.npy"
    with progress_line("solving") as report, termination():

        def solution_by(solver: "Callable[..., Solution]", name: str, policy: str) -> "Solution":
            return solver(
                mdp,
                tolerance,
                progress=lambda sweeps, bound: report(f"{policy}sweep {sweeps}, error at most {bound:.2g}"),
                values=None if values is None or ranks != 1 else values / f"{name}{suffix}",
                **{"threads": threads, "processes": ranks, "checkpoint": checkpoint, "dtype": dtype, "blocks": blocks},
            )

        solution = solution_by(value_iteration, "optimal", "")
        report("value of the uniform policy")
        uniform = solution_by(uniform_value, "uniform", "uniform policy, ")
    if solution is None:  # a rank of MPI that is not the first
        return None
    if out is not None:
        save(out, solution)
    answer = {
        "value_at_start": solution.value_at_start,
        "uniform_value_at_start": uniform.value_at_start,
        "error_bound": solution.error_bound,
        "sweeps": solution.sweeps,
        "seconds": solution.seconds,
        "compiling_seconds": compiling.seconds(),
        "gamma": solution.gamma,
        "horizon": solution.horizon,
        **{name: getattr(chance, name) for name in ACTING},
        "tolerance": tolerance,
        "dtype": dtype,
        "processes": int(processes) if processes.isdigit() and processes != "1" else ranks,
        "uniform_error_bound": uniform.error_bound,
        "uniform_seconds": uniform.seconds,
        "num_states": mdp.num_states,
        "num_actions": mdp.num_actions,
        "file": None if out is None else str(out),
    }
    facts = [
        ("optimal value at the start", f"{solution.value_at_start:.8g}"),
        ("uniform policy at the start", f"{uniform.value_at_start:.8g}"),
        ("error at most", f"{max(solution.error_bound, uniform.error_bound):.2g}"),
        ("discount", describe_discount(solution.gamma, solution.horizon)),
        ("chance", describe_chance(chance, mdp.dynamics.has_chance)),
        ("states", f"{mdp.num_states:,} x {many(mdp.num_actions, 'action')}"),
        ("sweeps", f"{solution.sweeps} in {solution.seconds:.2f} s"),
        *compiling_fact(),
        *([] if out is None else [("written", out)]),
    ]
    return Answer(answer, (target.title, facts))


def save(path: Path, solution: "Solution") -> None:
    """Write the policy (.npy), or values and policy (.npz)."""
    import numpy as np

    from pharos.system import storage

    if path.suffix.lower() == ".npy":
        storage.replace_array(path, solution.policy)
        return
    with storage.replacing(path) as file:
        np.savez_compressed(file, v=solution.v, policy=solution.policy)
