"""pharos solve: optimal values, beside the values of the uniformly random policy.

pharos evaluate: the exact value of a policy, between the best and the worst value.
"""

import contextlib
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pharos.cli.answers import Answer, compiling_fact, complain, describe_discount, progress_line, termination
from pharos.cli.options import (
    Building,
    Chance,
    Count,
    Gamma,
    Horizon,
    Objective,
    SharedBuilding,
    Target,
    Tolerance,
    Trust,
    file_ending,
    total_of,
)
from pharos.cli.policies import readable_policy, with_policy
from pharos.errors import DivergenceError, FileFormatError, ParameterError, PrecisionError, UnknownName
from pharos.solvers import Solving
from pharos.system import compiling
from pharos.system.wording import pluralize

if TYPE_CHECKING:
    from pharos.mdp import ChanceSetting, TabularMDP
    from pharos.solvers import Solution
    from pharos.training import Task


def solve(
    building: SharedBuilding,
    target: Target,
    *,
    gamma: Gamma = None,
    horizon: Horizon = None,
    objective: Objective = None,
    reach: str | None = None,
    chance: Chance,
    solving: Annotated[Solving, "tolerance threads dtype"],
    out: Annotated[Path | None, file_ending(".npz", ".npy")] = None,
    values: Path | None = None,
    print_policy: bool = False,
    policy_rows: Count = 100,
) -> Answer | None:
    """Find the optimal values and policy, with a proven error bound. With --processes the same command resumes.

    Args:
        reach: Compute probabilities and costs of reaching terminal, a label, an expression such as 'x=3 & !done', or
            states such as 5,7, instead of values.
        out: Write the arrays v and policy to FILE.npz, or the policy alone to FILE.npy.
        values: Keep the values in this folder if memory has no room for them. An interrupted solve resumes.
        print_policy: Print the action of each state that the policy reaches. With --reach for the least cost, or for
            the largest probability if the target may be missed.
        policy_rows: Print at most this many states of the policy.
    """
    ranks, processes = building.ranks, building.processes
    with termination():
        mdp = target.mdp(building, gamma=gamma, horizon=horizon, chance=chance)
        mdp = total_of(mdp, gamma, horizon, objective)
    if reach is not None:
        return reaching(target, mdp, reach, solving.tolerance, chance, out, policy_rows if print_policy else 0)
    if objective == "average":
        return averaging(target, mdp, solving.tolerance, chance, out, policy_rows if print_policy else 0)
    from pharos.solvers import uniform_value, value_iteration
    from pharos.system import storage

    checkpoint = (values or storage.cache_directory() / "values") if ranks != 1 else None
    suffix = ".npy" if solving.dtype == "float64" else f"-{solving.dtype}.npy"
    with progress_line("solving") as report, termination():

        def solution_by(solver: "Callable[..., Solution]", name: str, policy: str) -> "Solution":
            return solver(
                mdp,
                solving,
                progress=lambda sweeps, bound: report(f"{policy}sweep {sweeps}, error at most {bound:.2g}"),
                values=None if values is None or ranks != 1 else values / f"{name}{suffix}",
                processes=ranks,
                checkpoint=checkpoint,
            )

        solution = solution_by(value_iteration, "optimal", "")
        report("value of the uniform policy")
        try:
            uniform = solution_by(uniform_value, "uniform", "uniform policy, ")
        except DivergenceError:  # it may go on for ever although the optimal policy ends
            uniform = None
    if solution is None:  # a rank of MPI that is not the first
        return None
    if out is not None:
        save(out, solution)
    answer = {
        "value_at_start": solution.value_at_start,
        "uniform_value_at_start": None if uniform is None else uniform.value_at_start,
        "error_bound": solution.error_bound,
        "sweeps": solution.sweeps,
        "seconds": solution.seconds,
        "compiling_seconds": compiling.seconds(),
        "gamma": solution.gamma,
        "horizon": solution.horizon,
        **{name: getattr(chance, name) for name in CHANCE_OPTIONS},
        "tolerance": solving.tolerance,
        "dtype": solving.dtype,
        "processes": int(processes) if processes.isdigit() and processes != "1" else ranks,
        "uniform_error_bound": None if uniform is None else uniform.error_bound,
        "uniform_seconds": None if uniform is None else uniform.seconds,
        "num_states": mdp.num_states,
        "num_actions": mdp.num_actions,
        "file": None if out is None else str(out),
    }
    facts = [
        ("optimal value at the start", f"{solution.value_at_start:.8g}"),
        ("uniform policy at the start", "infinite" if uniform is None else f"{uniform.value_at_start:.8g}"),
        ("error at most", f"{max(each.error_bound for each in (solution, uniform) if each is not None):.2g}"),
        ("discount", describe_discount(solution.gamma, solution.horizon)),
        ("chance", chance.in_words(mdp.dynamics.has_chance)),
        ("states", f"{mdp.num_states:,} x {pluralize(mdp.num_actions, 'action')}"),
        ("sweeps", f"{solution.sweeps} in {solution.seconds:.2f} s"),
        *compiling_fact(),
        *([] if out is None else [("written", out)]),
    ]
    result = Answer(answer, (target.title, facts))
    return with_policy(result, readable_policy(mdp, solution.policy, policy_rows)) if print_policy else result


REACHED = {
    "maximum": "largest probability",
    "minimum": "least probability",
    "least_cost": "least cost that must arrive",
    "largest_cost": "largest cost that must arrive",
}
"""Names of what is known of a target -> in words."""


def reaching(
    target: Target,
    mdp: "TabularMDP",
    name: str,
    tolerance: float,
    chance: "ChanceSetting",
    out: Path | None,
    policy_rows: int = 0,
) -> Answer:
    """The answer about reaching a target: a name or an expression, or states with commas between them."""
    import numpy as np

    from pharos.solvers import reach
    from pharos.system import storage

    is_list = all(part.strip().isdigit() for part in name.split(","))
    began = time.perf_counter()
    result = reach(mdp, [int(part) for part in name.split(",")] if is_list else name, tolerance=tolerance)
    numbers: dict[str, Any] = {"target": name, "states": int(result.target.sum())}
    facts: list[tuple[str, object]] = []
    arrays: dict[str, Any] = {}
    with progress_line("solving"):
        for key, words in REACHED.items():
            try:
                bounds = getattr(result, key)
            except ParameterError:  # rewards of both signs are no costs
                numbers[key] = None
                facts.append((words, "rewards have both signs"))
                continue
            ends = [float(mdp.start_probabilities @ each[mdp.start_states]) for each in (bounds.lower, bounds.upper)]
            finite = [value if math.isfinite(value) else None for value in ends]
            numbers[key] = {"lower": finite[0], "upper": finite[1], "infinite": finite[0] is None}
            facts.append((words, _between(*ends)))
            arrays |= {f"{key}_lower": bounds.lower, f"{key}_upper": bounds.upper, f"{key}_policy": bounds.policy}
    if out is not None:
        if out.suffix.lower() == ".npy":
            raise ParameterError(f"{out}: a target has several arrays; expected FILE.npz")
        with storage.replacing(out, follow=True) as file:
            np.savez_compressed(file, **arrays)
    answer = {
        "reach": numbers,
        **_how_it_was_answered(mdp, tolerance, chance, out, began),
    }
    facts += [("states of the target", f"{numbers['states']:,} of {mdp.num_states:,}")]
    reply = Answer(answer, (f"reaching {name} in {target.title}", facts))
    if not policy_rows:
        return reply
    cost = numbers["least_cost"]
    best = "maximum" if cost is None or cost["infinite"] else "least_cost"
    rows = readable_policy(result.stopped, arrays[f"{best}_policy"], policy_rows, f"policy of the {REACHED[best]}")
    return with_policy(reply, rows)


def _between(low: float, high: float) -> str:
    """The middle of an interval in words, which says nothing of numbers that may be 0."""
    if math.isinf(low):
        return "infinite"
    return f"at most {high:.2g}" if low == 0 < high else f"{(low + high) / 2:.8g}"


def _how_it_was_answered(
    mdp: "TabularMDP", tolerance: float, chance: "ChanceSetting", out: Path | None, began: float
) -> dict[str, Any]:
    """Keys of answers to other objectives than values: time, chance, tolerance, size, and the file written."""
    return {
        "seconds": time.perf_counter() - began,
        "compiling_seconds": compiling.seconds(),
        **{each: getattr(chance, each) for each in CHANCE_OPTIONS},
        "tolerance": tolerance,
        "num_states": mdp.num_states,
        "num_actions": mdp.num_actions,
        "file": None if out is None else str(out),
    }


def averaging(
    target: Target,
    mdp: "TabularMDP",
    tolerance: float,
    chance: "ChanceSetting",
    out: Path | None,
    policy_rows: int,
) -> Answer:
    """The answer about the average reward of a step in the long run."""
    import numpy as np

    from pharos.solvers import average_reward
    from pharos.system import storage

    began = time.perf_counter()
    with progress_line("solving") as report, termination():
        report("optimal average")
        best = average_reward(mdp, tolerance=tolerance)
        report("average of the uniform policy")
        uniform = average_reward(mdp, "uniform", tolerance=tolerance)
        report("bias")
        try:
            bias = best.bias
        except PrecisionError:  # the equations of the policy are too large
            bias = None
    if out is not None and out.suffix.lower() == ".npy":
        storage.replace_array(out, best.policy, follow=True)
    elif out is not None:
        arrays = {"gain": best.gain} | ({} if bias is None else {"bias": bias})
        sides = {f"{name}_{side}": getattr(each, side) for name, each in arrays.items() for side in ("lower", "upper")}
        with storage.replacing(out, follow=True) as file:
            np.savez_compressed(file, **sides, policy=best.policy)
    gain, of_uniform = best.gain_at_start, uniform.gain_at_start
    answer = {
        "gain_at_start": gain._asdict(),
        "uniform_gain_at_start": of_uniform._asdict(),
        "bias_at_start": None if bias is None else best.at_start(bias)._asdict(),
        **_how_it_was_answered(mdp, tolerance, chance, out, began),
    }
    facts = [
        ("optimal average reward a step", gain),
        ("of the uniform policy", of_uniform),
        ("bias at the start", "too many equations" if bias is None else best.at_start(bias)),
        ("chance", chance.in_words(mdp.dynamics.has_chance)),
        ("states", f"{mdp.num_states:,} x {pluralize(mdp.num_actions, 'action')}"),
        *compiling_fact(),
        *([] if out is None else [("written", out)]),
    ]
    result = Answer(answer, (f"long run of {target.title}", facts))
    return with_policy(result, readable_policy(mdp, best.policy, policy_rows)) if policy_rows else result


def save(path: Path, solution: "Solution") -> None:
    """Write the policy (.npy), or values and policy (.npz)."""
    import numpy as np

    from pharos.system import storage

    if path.suffix.lower() == ".npy":
        storage.replace_array(path, solution.policy, follow=True)
        return
    with storage.replacing(path, follow=True) as file:
        np.savez_compressed(file, v=solution.v, policy=solution.policy)


# Evaluate -------------------------------------------------------------------------------------------------------------


NAMED_POLICIES = ("optimal", "uniform", "worst")
CHANCE_OPTIONS = ("sticky", "random", "lazy")


@dataclass(frozen=True)
class Given:
    """A policy that a command names, with its observation options and the task that it was trained on.

    Attributes:
        task: None for a file.
    """

    policy: Any
    observer_options: dict[str, Any] = field(default_factory=dict)
    task: "Task | None" = None


def evaluate(
    context: typer.Context,
    target: Target,
    *,
    policy: str = "uniform",
    gamma: Gamma = None,
    horizon: Horizon = None,
    objective: Objective = None,
    chance: Chance,
    tolerance: Tolerance = 1e-6,
    building: Building,
    trust: Trust = False,
) -> Answer:
    """Evaluate a policy exactly, and report its regret: 0 is optimal, 1 is as bad as playing at random.

    What a run has learnt is evaluated in the run's own setting (discount, horizon, chance) but for what options say.
    Only a policy that sees several frames and reaches more than 100,000 histories is estimated, from 2,000 episodes.

    Args:
        policy: optimal, uniform, worst, FILE.npy with actions (S,) or probabilities (S, A), or a finished run's folder.
    """
    from pharos.regret import ReferenceValues, regret

    decisions = None if policy in NAMED_POLICIES else read_policy(policy, trust=trust)
    source, of_command = "given", (gamma, horizon)
    if decisions is not None and decisions.task is not None:
        own, names = decisions.task, ("gamma", "horizon", *CHANCE_OPTIONS)
        overridden = {name for name in names if context.get_parameter_source(name).name == "COMMANDLINE"}  # type: ignore[union-attr]
        gamma = gamma if "gamma" in overridden else own.gamma
        horizon = horizon if "horizon" in overridden else own.horizon_steps
        chance = replace(chance, **{name: getattr(own.chance, name) for name in {*CHANCE_OPTIONS} - overridden})
        source = "the run's own" if not overridden else f"the run's own, but for {', '.join(sorted(overridden))}"
    goal = target
    if goal.is_imported and Path(policy).expanduser().is_dir():  # what was learnt on the environment of the table
        table = goal.mdp()
        gamma, horizon = table.gamma if gamma is None else gamma, table.horizon if horizon is None else horizon
        goal = goal.as_environment()
    mdp = total_of(goal.mdp(building, gamma=gamma, horizon=horizon, chance=chance), *of_command, objective)
    if objective == "average":
        reply = averaged(goal, mdp, policy, decisions, tolerance, chance, source)
        _warn_of_another_world(decisions, goal)
        return reply
    with progress_line("evaluating"):
        values = {name: _worth_of_named(mdp, name, tolerance) for name in NAMED_POLICIES}
        if decisions is None:
            worth = values[policy]
        elif _sees_frames(goal, decisions):
            worth = _worth_over_histories(goal, mdp, decisions, chance)
        else:
            worth = _worth_of_given(goal, mdp, decisions, chance, tolerance)
    _warn_of_another_world(decisions, goal)
    is_network = decisions is not None and "observation" in decisions.observer_options
    rounding = ", for the probabilities that its network computes in 32 bits" if is_network else ""
    best, uniform, worst = (values[name].value for name in NAMED_POLICIES)
    every = [*values.values(), worth]
    reference = ReferenceValues(best, uniform, worst, max(values[name].error_bound for name in NAMED_POLICIES))
    lost, relative, against_worst = (
        regret(worth.value, reference, normalized_by=name) for name in (None, "uniform", "worst")
    )
    answer = {
        "policy": policy,
        "value_at_start": worth.value,
        "error_bound": worth.error_bound,
        "exact": worth.episodes == 0,
        "episodes": worth.episodes,
        "regret": lost,
        "normalized_regret": relative,
        "regret_relative_to_worst": against_worst,
        "optimal_value_at_start": best,
        "uniform_value_at_start": uniform,
        "worst_value_at_start": worst,
        "seconds": sum(each.seconds for each in every),
        "gamma": mdp.gamma,
        "horizon": mdp.horizon,
        **{name: getattr(chance, name) for name in CHANCE_OPTIONS},
        "setting": source,
        "policy_dtype": "float32" if is_network else None,
    }
    facts = [
        ("value at the start", f"{worth.value:.8g}"),
        ("regret", f"{answer['regret']:.8g}"),
        ("normalised regret", "-" if math.isnan(relative) else f"{relative:.6g}  (0: optimal, 1: uniform)"),
        ("relative to worst", "-" if math.isnan(against_worst) else f"{against_worst:.6g}  (0: optimal, 1: worst)"),
        ("optimal, uniform, worst", f"{best:.8g}, {uniform:.8g}, {worst:.8g}"),
        ("error at most", f"{max(each.error_bound for each in every):.2g}{_estimated(worth)}{rounding}"),
        *([] if source == "given" else [("setting", source)]),
        ("discount", describe_discount(mdp.gamma, mdp.horizon)),
        ("chance", chance.in_words(mdp.dynamics.has_chance)),
    ]
    return Answer(answer, (f"{policy} policy on {target.title}", facts))


def _warn_of_another_world(decisions: Given | None, goal: Target) -> None:
    """Warn if a run learnt in another environment than its policy is evaluated in."""
    task = None if decisions is None else decisions.task
    with contextlib.suppress(ParameterError):  # a folder without its class has no other
        if task is not None and (env := goal.found_environment()) != task.env:
            complain(f"warning: the run learnt in {task.env}; its policy is evaluated in {env}")


def averaged(
    goal: Target,
    mdp: "TabularMDP",
    policy: str,
    decisions: Given | None,
    tolerance: float,
    chance: "ChanceSetting",
    source: str,
) -> Answer:
    """The answer about the average reward of a policy, and its regret a step."""
    from pharos.policies import average_regret
    from pharos.regret import regret_scale

    began = time.perf_counter()
    with progress_line("evaluating"):
        if decisions is None:
            result = average_regret(mdp, policy, tolerance)
        else:
            result = average_regret(mdp, decisions.policy, tolerance, **decisions.observer_options)
        uniform, worst = (average_regret(mdp, name, tolerance, optimal=result.optimal) for name in ("uniform", "worst"))
    middle, scale = (sum(each) / 2 for each in (result.regret, uniform.regret))
    relative = middle / regret_scale(scale, 0.0, tolerance)
    answer = {
        "policy": policy,
        "gain_at_start": result.gain._asdict(),
        "average_regret": result.regret._asdict(),
        "normalized_average_regret": relative,
        "optimal_gain_at_start": result.optimal._asdict(),
        "uniform_gain_at_start": uniform.gain._asdict(),
        "worst_gain_at_start": worst.gain._asdict(),
        "seconds": time.perf_counter() - began,
        **{name: getattr(chance, name) for name in CHANCE_OPTIONS},
        "setting": source,
    }
    facts = [
        ("average reward a step", result.gain),
        ("average regret a step", result.regret),
        ("normalised regret", "-" if math.isnan(relative) else f"{relative:.6g}  (0: optimal, 1: uniform)"),
        ("optimal, uniform, worst", f"{result.optimal}, {uniform.gain}, {worst.gain}"),
        *([] if source == "given" else [("setting", source)]),
        ("chance", chance.in_words(mdp.dynamics.has_chance)),
    ]
    return Answer(answer, (f"{policy} policy on {goal.title}, in the long run", facts))


@dataclass(frozen=True)
class Worth:
    """The value of a policy at the start, how far it may be off, and the episodes behind an estimate (exact: 0)."""

    value: float
    error_bound: float
    seconds: float
    episodes: int = 0


def _worth(solution: "Solution") -> Worth:
    return Worth(solution.value_at_start, solution.error_bound, solution.seconds)


def _worth_of_named(mdp: "TabularMDP", name: str, tolerance: float) -> Worth:
    """Worth of one of POLICIES. All but the best may go on for ever, if the total reward has no limit."""
    from pharos.policies import endless_value

    began = time.perf_counter()
    try:
        return _worth(solution_of(mdp, name, None, tolerance))
    except DivergenceError:
        if name == "optimal":
            raise
        value = -math.inf if name == "worst" else endless_value(mdp, name)
        return Worth(value, 0.0, time.perf_counter() - began)


def _worth_of_given(
    goal: Target, mdp: "TabularMDP", decisions: Given, chance: "ChanceSetting", tolerance: float
) -> Worth:
    """Worth of a policy of one's own, by its values from all states if they are finite, else from the start alone."""
    from pharos.policies import NumberObserver, policy_value

    try:
        return _worth(solution_of(mdp, "", decisions, tolerance))
    except DivergenceError:
        if "observation" in decisions.observer_options:
            return _worth_over_histories(goal, mdp, decisions, chance)
    began, observer = time.perf_counter(), NumberObserver.of(mdp.num_states)
    limits = (-math.inf, math.inf)
    value = policy_value(decisions.policy, mdp, lambda: observer, lambda: limits, max_states=mdp.num_states)
    return Worth(value.value, value.error_bound, time.perf_counter() - began)


def _estimated(worth: Worth) -> str:
    return f" with a probability of 99 % (estimated from {worth.episodes:,} episodes)" if worth.episodes else ""


def _sees_frames(goal: Target, decisions: Given) -> bool:
    """Whether the policy sees several frames, so that its values belong to histories of states."""
    setting = decisions.observer_options
    if "observation" not in setting:
        return False
    from pharos.observations import observe

    name, options = setting["observation"], setting["observation_options"]
    return "frames" in options and observe(goal.found_environment(), name, **options).frames > 1


def _worth_over_histories(goal: Target, mdp: "TabularMDP", decisions: Given, chance: "ChanceSetting") -> Worth:
    """Value of a policy that sees several frames: exact if it reaches few histories, else estimated."""
    from pharos.training import Task, evaluate_agent

    began = time.perf_counter()
    task = Task(goal.found_environment(), chance, **decisions.observer_options, gamma=mdp.gamma, horizon=mdp.horizon)
    evaluation = evaluate_agent(decisions.policy, task)
    return Worth(evaluation.value, evaluation.error_bound, time.perf_counter() - began, evaluation.episodes)


def solution_of(mdp: "TabularMDP", policy: str, decisions: Given | None, tolerance: float) -> "Solution":
    """The values of a policy: one of POLICIES, or what `read_policy` gave."""
    from pharos.policies import evaluate_policy
    from pharos.solvers import uniform_value, value_iteration, worst_value

    if decisions is not None:
        return evaluate_policy(mdp, decisions.policy, tolerance, **decisions.observer_options)
    return {"optimal": value_iteration, "uniform": uniform_value, "worst": worst_value}[policy](mdp, tolerance)


def read_policy(name: str, *, trust: bool = False) -> Given:
    """The policy in a file: .npy, or `policy` of .npz, or what a finished run has learnt, in the folder of the run.

    Args:
        trust: whether code that the run names may be imported. What the command names itself is imported before.
    Returns:
        The policy, and how `pharos.evaluate_policy` is to take it.
    Raises:
        UnknownName: neither a policy nor a file. FileFormatError: the file holds no such array, or the folder no such
            run.
    """
    import numpy as np

    path = Path(name).expanduser()
    if path.is_dir():
        from pharos.training import load_agent

        task, agent = load_agent(path, trust=trust)
        if isinstance(agent, np.ndarray):
            return Given(agent, {}, task)
        return Given(agent, {"observation": task.observation, "observation_options": task.observation_options}, task)
    if path.suffix.lower() not in (".npy", ".npz"):
        raise UnknownName("policy", name, [*NAMED_POLICIES, "FILE.npy", "RUN_DIR"])
    if not path.is_file():
        raise ParameterError(f"--policy {name}: no such file")
    try:
        if path.suffix.lower() == ".npy":
            return Given(np.load(path, allow_pickle=False))
        with np.load(path, allow_pickle=False) as arrays:
            return Given(arrays["policy"])
    except Exception as error:  # headers of arrays are read as Python
        raise FileFormatError(f"{path}: {error}; expected an array of actions (S,) or probabilities (S, A)") from error
