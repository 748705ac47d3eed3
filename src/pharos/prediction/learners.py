"""The idealised learner of a run: an agent's network as a kernel, and its schedule, from the run's configuration."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from pharos.agents import agent_called, curve_points, primary_predictors
from pharos.errors import ParameterError, PharosError
from pharos.mdp import whole_number
from pharos.training import RunConfig

if TYPE_CHECKING:
    from pharos.agents import Idealised
    from pharos.mdp import TabularMDP
    from pharos.training import Task

Network = str | Callable[[tuple[int, ...]], Any]
"""A name, or a function of the shape of an input: `pharos.observations.representation`."""
LEARNER_MEASURES = (
    "kernel_regret",
    "kernel_learning_time",
    "kernel_sample_complexity",
    "aliasing_floor",
    "exploration_time",
)
PREDICTORS = (
    *("kernel_regret", "kernel_regret_played", "adam_regret", "adam_regret_played"),
    *("tabular_regret", "tabular_regret_played"),
    *("kernel_learning_time", "kernel_sample_complexity", "aliasing_floor", "exploration_time", "num_states"),
)
"""Columns of predictions, numbers; the larger, the harder. `adam_regret` is kernel regret with `optimizer="adam"`."""


def predicted(config: Mapping[str, Any], *, primary: bool = False) -> dict[str, Any]:
    """Return PREDICTORS of a run, the columns of its agent's idealised learner (`pharos.agents.Idealised`), and their
    curves, and the measures that a user has registered, under their names.

    Args:
        config: of a run of a study that was read already, so that code which it names is trusted.
        primary: the idealised learner alone, with its table. `estimated_error` is then its own.
    Returns:
        Numbers, NaN if there is none and `notes` says why, `network`, `estimated_error`, `curve`, `adam_curve`.
    """
    from pharos.hardness import report

    numbers: dict[str, Any] = dict.fromkeys(PREDICTORS, math.nan)
    row = {**numbers, "network": "", "estimated_error": math.nan, "curve": "", "adam_curve": "", "notes": ""}
    # Measures of the kernel of the run's network, and of the learners with it
    try:
        task = RunConfig.from_dict(config).task(trust=True, strict=True)
        name, initialisation = network_of(config, task)
        options, config = _options(task, name, initialisation), {**config, "chance": task.scaled_chance.to_dict()}
        row |= {"num_states": float(task.mdp.num_states), "network": f"{name}, {initialisation}"}
        if primary:
            return row | _of_primary(config, task.mdp, options)
        idealised = agent_called(config["agent"]).idealised
        idealised.check(config["hyperparameters"])
        schedule = idealised.schedule(config)
        user_measures = own_measures()
        measures = report(task.mdp, (*LEARNER_MEASURES, *user_measures), schedule=schedule, **options)
        rescaled = report(task.mdp, ["kernel_regret"], schedule=replace(schedule, optimizer="adam"), **options)
        row |= idealised.columns(config, task.mdp, options)
    except PharosError as error:
        return {**row, "notes": str(error)}
    # Their values as columns
    regret = measures["kernel_regret"].value
    if regret is not None:
        row |= {"kernel_regret": regret["value"], "kernel_regret_played": regret["played"]}
        row |= {"tabular_regret": regret["tabular"], "tabular_regret_played": regret["tabular_played"]}
        row |= {"estimated_error": regret["estimated_error"], "curve": curve_points(regret)}
    regret = rescaled["kernel_regret"].value
    if regret is not None:
        row |= {
            "adam_regret": regret["value"],
            "adam_regret_played": regret["played"],
            "adam_curve": curve_points(regret),
        }
    for measure in (*LEARNER_MEASURES[1:], *user_measures):
        value = measures[measure].value
        if value is not None:
            row[measure] = float(value["value"] if isinstance(value, Mapping) else value)
    notes = (result.undefined or result.certificate.note for result in measures.results.values())
    return {**row, "notes": "; ".join(note for note in notes if note)}


def _of_primary(config: Mapping[str, Any], mdp: "TabularMDP", options: Mapping[str, Any]) -> dict[str, Any]:
    """Columns of the idealised learner: its numbers, the error that its landmarks are estimated to cause, notes.

    Raises:
        ParameterError: the agent has none.
    """
    idealised = _idealised(config)
    result = idealised.primary(config, mdp, options)
    error = math.nan if result.value is None else result.value["estimated_error"]
    notes = result.undefined or result.certificate.note or ""
    row = dict.fromkeys(idealised.earlier, math.nan) | idealised.primary_columns(result.name, result.value)
    return {**row, "estimated_error": error, "notes": notes}


def _idealised(config: Mapping[str, Any]) -> "Idealised":
    """The learner that stands for an agent. ParameterError: there is none."""
    idealised = agent_called(config["agent"]).idealised
    if not idealised.predictor:
        expected = ", ".join(primary_predictors())
        raise ParameterError(f"agent {config['agent']} has no primary predictor; expected one of {expected}")
    idealised.check(config["hyperparameters"])
    return idealised


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


@dataclass(frozen=True, kw_only=True)
class PrimaryRegret:
    """Predicted regret of an agent, by the predictor that stands for it.

    Attributes:
        network: its name. measure: the predictor, or the one that stands in for it (`Idealised.fallback`).
        value: normalised regret of the learnt policies, a mean over training: 0 optimal, 1 uniform play.
        deviation: standard deviation of one walk of the idealised learner, NaN if nothing is drawn.
        tabular: of the same learner with a table of the states in the place of the network.
        note: what is random in it, and what half of the landmarks change if they stand for the kernel.
    """

    network: str
    measure: str = ""
    value: float
    tabular: float
    deviation: float
    note: str = ""


def primary_regret(
    config: Mapping[str, Any],
    task: "Task",
    network: Network | None = None,
    landmarks: int | None = None,
    measure: str | None = None,
) -> PrimaryRegret:
    """Return the regret of a run's idealised learner, and the name of the network.

    Args:
        config: of the run. task: its task.
        network: as `pharos.observations.representation` takes it. Default: the agent's own, with its `net_arch`.
        measure: another one of the idealised learner. Default: its predictor, or the one that stands in for it.
    Raises:
        ParameterError: the agent has no such learner, the network does not fit, or the kernel is too large.
        UndefinedMeasure: no policy beats uniform play.
    """
    from pharos.errors import UndefinedMeasure

    idealised = _idealised(config)
    own_network, initialisation = network_of(config, task)
    name: Network = own_network
    if network is not None:
        name = network + idealised.suffix if isinstance(network, str) and _is_named(network) else network
    options, config = (
        _options(task, name, initialisation, landmarks),
        {**config, "chance": task.scaled_chance.to_dict()},
    )
    result = (
        idealised.primary(config, task.mdp, options)
        if measure is None
        else idealised.result(measure, config, task.mdp, options)
    )
    value = result.value
    if value is None:
        raise UndefinedMeasure(result.undefined or f"{result.name} is undefined")
    return PrimaryRegret(
        network=str(options["representation"].conventions["network"]),
        measure=result.name,
        value=idealised.regret(value),
        deviation=value.get("deviation", math.nan),
        tabular=value["tabular"],
        note=result.certificate.note or "",
    )


def _is_named(network: str) -> bool:
    """Whether a network is one of pharos' names, and none of a file or module."""
    from pharos.system.sources import is_reference

    return not is_reference(network) and "+tanh" not in network


def network_of(config: Mapping[str, Any], task: "Task") -> tuple[str, str]:
    """The name and the initialisation of the network of an agent of pharos."""
    from pharos.hardness import default_network
    from pharos.observations import observe

    observation = observe(task.env, task.observation, state_space=task.space, **dict(task.observation_options))
    name, hidden = default_network(observation.space), _hidden_layers(config["hyperparameters"])
    if hidden != [128]:
        name = "-".join([name.removesuffix("x2"), *(["128"] if "mlp" not in name else []), *map(str, hidden)])
    idealised = agent_called(config["agent"]).idealised
    return name + idealised.suffix, idealised.initialisation


def _hidden_layers(hyperparameters: Mapping[str, Any]) -> list[int]:
    """Units of the layers after the features, the same for policy and value.

    Raises:
        ParameterError: they differ, or the network is not of the kind that has a closed form.
    """
    arguments = hyperparameters.get("policy_kwargs") or {}
    if not isinstance(arguments, Mapping):
        raise ParameterError(f"policy_kwargs is {arguments!r}; expected a mapping")
    arguments = dict(arguments)
    layers = arguments.pop("net_arch", hyperparameters.get("net_arch", [128]))
    if arguments:
        raise ParameterError(f"policy_kwargs has {min(arguments)!r}; only net_arch may differ for predictions")
    if isinstance(layers, Mapping):
        if layers.get("pi") != layers.get("vf"):
            raise ParameterError(f"net_arch is {dict(layers)}; predictions need the same layers for policy and value")
        layers = layers.get("pi") or []
    if isinstance(layers, str) or not isinstance(layers, Sequence):
        raise ParameterError(f"net_arch is {layers!r}; expected a list of units, such as [64, 64]")
    return [whole_number(units, "a layer of net_arch") for units in layers]
