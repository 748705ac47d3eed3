"""The idealised learner of a run: an agent's network as a kernel, and its schedule, from the run's configuration."""

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pharos.errors import ParameterError, PharosError
from pharos.training import RunConfig

if TYPE_CHECKING:
    from pharos.hardness import Result, Rollouts, Sampling, Schedule
    from pharos.mdp import TabularMDP
    from pharos.training import Task

Network = str | Callable[[tuple[int, ...]], Any]
"""A name, or a function of the shape of an input: `pharos.observations.representation`."""
MEASURES = ("kernel_regret", "kernel_learning_time", "kernel_sample_complexity", "aliasing_floor", "exploration_time")
PREDICTORS = (
    *("kernel_regret", "kernel_regret_played", "adam_regret", "adam_regret_played"),
    *("tabular_regret", "tabular_regret_played"),
    *("kernel_learning_time", "kernel_sample_complexity", "aliasing_floor", "exploration_time", "num_states"),
)
"""Columns of predictions, numbers; the larger, the harder. `adam_regret` is kernel regret with `optimizer="adam"`."""
POLICY_PREDICTORS = (
    *("policy_regret", "policy_regret_played", "policy_tabular_regret"),
    *("policy_regret_evaluated", "clipped_regret", "clipped_regret_evaluated", "clipped_tabular_regret"),
)
"""Columns beside them where an agent is an actor-critic: `kernel_policy_regret`, as played, of a table, as evaluated;
and of PPO with its clipping, of the most probable actions, as evaluated, and of a table."""
SAMPLED_PREDICTORS = ("sampled_regret", "sampled_deviation", "sampled_descent", "sampled_adam", "sampled_tabular")
"""Columns beside them of a DQN: the sampled learner, one walk's deviation, its two kernels, and a table's."""
PRIMARY: Mapping[str, str] = {"dqn": "sampled_regret", "ppo": "clipped_regret_evaluated"}
"""The predictor that stands for each agent, named on twelve development classes and fourteen sealed ones together."""
POLICY_CURVES = ("policy_curve", "clipped_curve")
_NO_POLICY: Mapping[str, Any] = {**dict.fromkeys(POLICY_PREDICTORS, math.nan), **dict.fromkeys(POLICY_CURVES, "")}
ACTOR_CRITICS: Mapping[str, Mapping[str, Any]] = {
    "ppo": {"gae_lambda": 0.95, "clip_range": 0.2},
    "a2c": {"gae_lambda": 1.0, "clip_range": None},
}
"""Agents that learn as actor-critics, with the hyperparameters that hold where none are given."""
CURVE_POINTS = 40


def predicted(config: Mapping[str, Any], *, primary: bool = False) -> dict[str, Any]:
    """Return PREDICTORS of a run, SAMPLED_PREDICTORS of a DQN, POLICY_PREDICTORS of an actor-critic, and their curves;
    and the measures that a user has registered, under their names.

    Args:
        config: of a run of a study that was read already, so that code which it names is trusted.
        primary: the learner of PRIMARY alone, with its table; `estimated_error` is then its own.
    Returns:
        Numbers, NaN where there is none and `notes` says why; `network`, `estimated_error`, `curve`, `adam_curve`.
    """
    from pharos.hardness import report

    numbers: dict[str, Any] = dict.fromkeys(PREDICTORS, math.nan)
    row = {**numbers, "network": "", "estimated_error": math.nan, "curve": "", "adam_curve": "", "notes": ""}
    # Measures of the kernel of the run's network, and of the learners with it
    try:
        task = RunConfig.from_dict(config).task(trust=True, strict=True)
        name, initialisation = network_of(config, task)
        options = _options(task, name, initialisation)
        row |= {"num_states": float(task.mdp.num_states), "network": f"{name}, {initialisation}"}
        if primary:
            return row | _of_primary(config, task.mdp, options)
        schedule = schedule_of(config)
        user_measures = own_measures()
        measures = report(task.mdp, (*MEASURES, *user_measures), schedule=schedule, **options)
        rescaled = report(task.mdp, ["kernel_regret"], schedule=replace(schedule, optimizer="adam"), **options)
        if config["agent"] in ACTOR_CRITICS:
            row |= _of_policy(config, task.mdp, options)
        if config["agent"] == "dqn":
            row |= _of_walks(_sampled(config, task.mdp, options).value)
    except PharosError as error:
        return {**row, "notes": str(error)}
    # Their values as columns
    regret = measures["kernel_regret"].value
    if regret is not None:
        row |= {"kernel_regret": regret["value"], "kernel_regret_played": regret["played"]}
        row |= {"tabular_regret": regret["tabular"], "tabular_regret_played": regret["tabular_played"]}
        row |= {"estimated_error": regret["estimated_error"], "curve": _curve(regret)}
    regret = rescaled["kernel_regret"].value
    if regret is not None:
        row |= {"adam_regret": regret["value"], "adam_regret_played": regret["played"], "adam_curve": _curve(regret)}
    for measure in (*MEASURES[1:], *user_measures):
        value = measures[measure].value
        if value is not None:
            row[measure] = float(value["value"] if isinstance(value, Mapping) else value)
    notes = (result.undefined or result.certificate.note for result in measures.results.values())
    return {**row, "notes": "; ".join(note for note in notes if note)}


def _of_primary(config: Mapping[str, Any], mdp: "TabularMDP", options: Mapping[str, Any]) -> dict[str, Any]:
    """Columns of the learner of PRIMARY: its numbers, the error that its landmarks are estimated to cause, notes.

    Raises:
        ParameterError: the agent has none.
    """
    if config["agent"] not in PRIMARY:
        raise ParameterError(f"agent {config['agent']} has no primary predictor; expected one of {', '.join(PRIMARY)}")
    result = _primary(config, mdp, options)
    row = _of_walks(result.value) if config["agent"] == "dqn" else {**_NO_POLICY, **_of_clipped(result.value)}
    error = math.nan if result.value is None else result.value["estimated_error"]
    return {**row, "estimated_error": error, "notes": result.undefined or result.certificate.note or ""}


def own_measures() -> list[str]:
    """Names of the measures that a user has registered (`pharos.hardness.register`): predictors beside ours."""
    from pharos.hardness import measures

    return [name for name, measure in measures().items() if not measure.function.__module__.startswith("pharos.")]


def _options(task: "Task", network: Network, initialisation: str, landmarks: int | None = None) -> dict[str, Any]:
    """Options of `pharos.hardness.report` that measure a network's representation of a task's observation."""
    from pharos.observations import representation

    features = representation(
        *(task.space, task.observation, network),
        **{"initialisation": initialisation, "landmarks": landmarks, **dict(task.observation_options)},
    )
    return {"horizon": task.time_limit, "representation": features}


def _sampled(config: Mapping[str, Any], mdp: "TabularMDP", options: Mapping[str, Any]) -> "Result":
    """Result of `sampled_regret`: the regret of the learner that draws what a DQN draws."""
    from pharos.hardness import report

    name = "sampled_regret"
    return report(mdp, [name], schedule=schedule_of(config), sampling=sampling_of(config), **options)[name]


def _actor_critic(
    config: Mapping[str, Any], mdp: "TabularMDP", rollouts: "Rollouts", options: Mapping[str, Any]
) -> "Result":
    """Result of `kernel_policy_regret`, of the idealised actor-critic with the steps and the discount of an agent."""
    from pharos.hardness import Schedule, report

    name = "kernel_policy_regret"
    schedule = Schedule(steps=config["steps"], gamma=config["hyperparameters"].get("gamma", Schedule.gamma))
    return report(mdp, [name], schedule=schedule, rollouts=rollouts, **options)[name]


def _primary(config: Mapping[str, Any], mdp: "TabularMDP", options: Mapping[str, Any]) -> "Result":
    """Result of the learner that stands for the agent."""
    if config["agent"] == "dqn":
        return _sampled(config, mdp, options)
    return _actor_critic(config, mdp, rollouts_of(config), options)


def _of_walks(value: Mapping[str, Any] | None) -> dict[str, Any]:
    """SAMPLED_PREDICTORS by name, from the value of `sampled_regret`; NaN where there is none."""
    if value is None:
        return dict.fromkeys(SAMPLED_PREDICTORS, math.nan)
    parts = (value["value"], value.get("deviation", math.nan), value["descent"], value["adam"], value["tabular"])
    return dict(zip(SAMPLED_PREDICTORS, parts, strict=True))


def sampling_of(config: Mapping[str, Any]) -> "Sampling":
    """Sampling of a DQN by its hyperparameters and the noise of its rewards."""
    from pharos.hardness import Sampling

    hyperparameters, noise = config["hyperparameters"], config["chance"].get("reward_noise", 0.0)
    sizes = {name: int(hyperparameters[name]) for name in ("batch_size", "buffer_size") if name in hyperparameters}
    return Sampling(reward_noise=float(noise), **sizes)


@dataclass(frozen=True, kw_only=True)
class PrimaryRegret:
    """Predicted regret of an agent, by the predictor that stands for it (PRIMARY).

    Attributes:
        network: its name.
        value: normalised regret of the learnt policies, a mean over training: 0 optimal, 1 uniform play.
        deviation: standard deviation of one walk of the idealised learner; NaN where nothing is drawn.
        tabular: of the same learner with a table of the states in the place of the network.
        note: what is random in it, and what half of the landmarks change where they stand for the kernel.
    """

    network: str
    value: float
    tabular: float
    deviation: float
    note: str = ""


def primary_regret(
    config: Mapping[str, Any],
    task: "Task",
    network: Network | None = None,
    landmarks: int | None = None,
) -> PrimaryRegret:
    """Return the regret of a run's idealised learner by PRIMARY, and the name of the network.

    Args:
        config: of the run. task: its task.
        network: as `pharos.observations.representation` takes it; None: the agent's own, with its `net_arch`.
    Raises:
        ParameterError: the agent has no such learner, the network does not fit, or the kernel is too large.
        UndefinedMeasure: no policy beats uniform play.
    """
    from pharos.errors import UndefinedMeasure

    agent = config["agent"]
    own_network, initialisation = network_of(config, task)
    name: Network = own_network
    if network is not None:
        name = f"{network}+tanh" if isinstance(network, str) and agent != "dqn" and _is_named(network) else network
    options = _options(task, name, initialisation, landmarks)
    result = _primary(config, task.mdp, options)
    value = result.value
    if value is None:
        raise UndefinedMeasure(result.undefined or f"{result.name} is undefined")
    return PrimaryRegret(
        network=str(options["representation"].conventions["network"]),
        value=value["value"] if agent == "dqn" else _evaluated(value),
        deviation=value.get("deviation", math.nan),
        tabular=value["tabular"],
        note=result.certificate.note or "",
    )


def _is_named(network: str) -> bool:
    """Whether a network is one of pharos' names, and none of a file or module."""
    from pharos.system.sources import is_reference

    return not is_reference(network) and "+tanh" not in network


def _of_policy(config: Mapping[str, Any], mdp: "TabularMDP", options: Mapping[str, Any]) -> dict[str, Any]:
    """POLICY_PREDICTORS and POLICY_CURVES, of the idealised actor-critic with the rollouts and steps of the agent."""
    rollouts = rollouts_of(config)
    regret = _actor_critic(config, mdp, replace(rollouts, clip_range=None), options).value
    clipped = None if rollouts.clip_range is None else _actor_critic(config, mdp, rollouts, options).value
    row = dict(_NO_POLICY)
    if regret is not None:
        numbers = (regret["value"], regret["played"], regret["tabular"], _evaluated(regret))
        row |= {**dict(zip(POLICY_PREDICTORS, numbers, strict=False)), "policy_curve": _curve(regret)}
    return row | _of_clipped(clipped)


def _of_clipped(regret: Mapping[str, Any] | None) -> dict[str, Any]:
    """Columns of the idealised PPO with its clipping; none of them where there is no regret."""
    if regret is None:
        return {}
    numbers = {"clipped_regret": regret["value"], "clipped_regret_evaluated": _evaluated(regret)}
    return {**numbers, "clipped_tabular_regret": regret["tabular"], "clipped_curve": _curve(regret, "played")}


def rollouts_of(config: Mapping[str, Any]) -> "Rollouts":
    """Rollouts of an actor-critic, with the clipping of its agent."""
    from pharos.hardness import Rollouts

    hyperparameters = {**ACTOR_CRITICS[config["agent"]], **config["hyperparameters"]}
    steps = int(hyperparameters["n_steps"]) * int(hyperparameters.get("n_envs", 1))
    minibatches = math.ceil(steps / int(hyperparameters["batch_size"])) if hyperparameters.get("batch_size") else 1
    gradient_steps = minibatches * int(hyperparameters.get("n_epochs", 1))
    shared = {name: hyperparameters[name] for name in ("gae_lambda", "clip_range")}
    return Rollouts(steps=steps, gradient_steps=gradient_steps, **shared)


def _evaluated(regret: Mapping[str, Any]) -> float:
    """Mean regret as evaluated, `LearningCurve.mean_evaluated`, computed anew: results of older versions lack it."""
    from pharos.hardness import LearningCurve

    return LearningCurve(**{name: np.asarray(values) for name, values in regret["curve"].items()}).mean_evaluated


def _curve(regret: Mapping[str, Any], of: str = "greedy") -> str:
    """Steps and regret of the idealised learner, of at most CURVE_POINTS of its phases, as JSON."""
    steps, regrets = regret["curve"]["steps"], regret["curve"][of]
    every = max(1, math.ceil(len(steps) / CURVE_POINTS))
    return json.dumps(
        [[int(step), round(value, 4)] for step, value in zip(steps[::every], regrets[::every], strict=True)]
    )


def network_of(config: Mapping[str, Any], task: "Task") -> tuple[str, str]:
    """The name and the initialisation of the network of an agent of pharos."""
    from pharos.hardness import default_network
    from pharos.observations import observe

    observation = observe(task.env, task.observation, state_space=task.space, **dict(task.observation_options))
    name, hidden = default_network(observation.space), _hidden_layers(config["hyperparameters"])
    if hidden != [128]:
        name = "-".join([name.removesuffix("x2"), *(["128"] if "mlp" not in name else []), *map(str, hidden)])
    return (name, "pytorch") if config["agent"] == "dqn" else (f"{name}+tanh", "sb3")


def _hidden_layers(hyperparameters: Mapping[str, Any]) -> list[int]:
    """Units of the layers after the features, the same for policy and value.

    Raises:
        ParameterError: they differ, or the network is not of the kind that has a closed form.
    """
    arguments = dict(hyperparameters.get("policy_kwargs") or {})
    layers = arguments.pop("net_arch", hyperparameters.get("net_arch", [128]))
    if arguments:
        raise ParameterError(f"policy_kwargs has {min(arguments)!r}; only net_arch may differ for predictions")
    if isinstance(layers, Mapping):
        if layers.get("pi") != layers.get("vf"):
            raise ParameterError(f"net_arch is {dict(layers)}; predictions need the same layers for policy and value")
        layers = layers.get("pi") or []
    return list(layers)


def schedule_of(config: Mapping[str, Any]) -> "Schedule":
    """Schedule of a DQN by its hyperparameters; of other agents the steps alone."""
    from pharos.hardness import Schedule

    hyperparameters = config["hyperparameters"]
    if config["agent"] != "dqn":
        return Schedule(steps=config["steps"])
    same = ("learning_starts", "exploration_initial_eps", "exploration_final_eps", "exploration_fraction", "gamma")
    options = {name: hyperparameters[name] for name in same if name in hyperparameters}
    period, every = int(hyperparameters.get("target_update_interval", 250)), hyperparameters.get("train_freq", 4)
    every = every if isinstance(every, int) else 4
    copies = int(hyperparameters.get("gradient_steps", 1))
    steps = max(1, round(period * (copies / every if copies > 0 else 1.0)))
    return Schedule(steps=config["steps"], period=period, gradient_steps=steps, **options)
