"""Agents by name: those of pharos, a line for each, agents of the user's own, and the hyperparameters of all of them.

An agent of the user's own is named `module:Name` or `file.py:Name`. What the name stands for says how it is trained:

    class        an algorithm with Stable-Baselines3's interface
    generator    learn(env, steps, seed), which yields policies as it learns, or a class with act, observe and policy,
                 whose steps are taken for it (`generator_of`)
    jax          learn(env, params, steps, key) -> (apply, snapshots), which is compiled

What stands behind a `*` in the parameters of a function are its hyperparameters: learn(env, steps, seed, *, rate=0.1);
of a class with act, observe and policy it is what its constructor takes beside MADE_WITH.
A name is recognised here for all, `train`, `tune`, studies and the benchmark. A further form is a line of `form_of`.

Hyperparameters follow RL Zoo's convention, by agent, class of environments and observation. Each agent has defaults
(`Agent.defaults`). A class of environments declares what suits it better (`Environment.hyperparameters`). Your own
table, in YAML, has both.
"""

import contextlib
import inspect
import json
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pharos.agents.a2c import A2C
from pharos.agents.agent import POLICY, Agent, Learner, LearningRun, agents, is_known, read_policy_table, register
from pharos.agents.dqn import DQN
from pharos.agents.ppo import PPO
from pharos.agents.q_learning import Q_LEARNING
from pharos.agents.sb3 import DeepAgent
from pharos.environments import class_called
from pharos.errors import FileFormatError, ParameterError, UnknownName
from pharos.policies import PolicyLike
from pharos.system.sources import Source, announced, find_source, load_source, register_source

register(Q_LEARNING)
register(DQN)
register(PPO)
register(A2C)

CLASS, GENERATOR, COMPILED = "class", "generator", "jax"
STEPPED = ("act", "observe", "policy")
MADE_WITH = ("observation_space", "action_space", "num_envs", "seed")
FUNCTIONS = "a function learn(env, steps, seed), or learn(env, params, steps, key) of JAX"

FunctionLearner = Callable[[Sequence[LearningRun], Callable[..., Any]], Any]
_FUNCTION_LEARNERS: dict[str, FunctionLearner] = {}


def agent_called(name: str) -> Agent:
    """The agent of a name. Any other name belongs to a class or function, of a library or the user's own."""
    kind = DeepAgent if is_known(name) else OwnAgent
    return agents().get(name) or kind(name=name, title=name.rpartition(":")[2], path=name)


def primary_predictors() -> dict[str, str]:
    """Name of each agent that can be predicted -> the column that stands for it in predictions."""
    return {name: each.idealised.predictor for name, each in agents().items() if each.idealised.predictor}


def hyperparameters(
    agent: str, environment: str, observation: str, given: Mapping[str, Any] | None = None, *, table: Path | None = None
) -> dict[str, Any]:
    """Return the hyperparameters of an agent for a class of environments and an observation.

    Args:
        given: go before all others.
        table: a YAML that says all of it (agent, then "default" or the class, then "default" or the observation), such
            as one that `pharos tune` wrote. None for what pharos and the class declare. Values may stand directly under
            the first "default".
    Raises:
        ParameterError: the table has another form, or nothing for the agent in the class. MissingExtra: a table is
            given, and PyYAML is not installed.
    """
    by_observation: Mapping[str, Any]
    if table is None:
        declaring = class_called(environment)
        default: Mapping[str, Any] | None = agent_called(agent).defaults
        by_observation = declaring.hyperparameters.get(agent, {}) if declaring else {}
    else:
        agents_of_table = _read(table)
        entries = agents_of_table.get(agent) or {}
        if not {"default", environment} & set(entries):
            content = ", ".join(entries) or f"only {', '.join(agents_of_table) or 'nothing'}"
            raise ParameterError(
                f"{table} says nothing of {agent} in {environment}; found {content}; expected {agent}, then "
                f"{environment} or default"
            )
        default, by_observation = entries.get("default"), entries.get(environment) or {}
    result: dict[str, Any] = {}
    for part in (*_parts_of(default, observation), *_parts_of(by_observation, observation), given):
        result.update(part or {})
    return result


def _parts_of(entry: Mapping[str, Any] | None, observation: str) -> Sequence[Mapping[str, Any] | None]:
    """Hyperparameters of an entry by observation, the ones that go before others last. Of plain values the entry."""
    if entry is None or any(name.endswith("kwargs") or not isinstance(entry[name], Mapping | None) for name in entry):
        return (entry,)
    return entry.get("default"), entry.get(observation)


def _read(path: Path) -> dict[str, Any]:
    from pharos.system.yaml_files import read_yaml  # which needs PyYAML

    table = read_yaml(path)
    if not isinstance(table, dict) or not _is_table(table, 4):
        raise ParameterError(f"{path}: expected agent, then class, then observation, each with names and values")
    return table


def _is_table(entry: object, levels: int) -> bool:
    """Whether an entry is a dictionary nested to this depth. A default has one level, and None stands for no entry."""
    if not isinstance(entry, dict) or not all(isinstance(name, str) for name in entry):
        return False
    below = entry.items() if levels > 1 else ()
    return all(part is None or _is_table(part, 1 if name == "default" else levels - 1) for name, part in below)


# Agents of the user's own ---------------------------------------------------------------------------------------------


def register_form(form: str, learner: FunctionLearner) -> None:
    """Say who trains the functions of a form. `pharos.training` does, as their policies are evaluated there."""
    _FUNCTION_LEARNERS[form] = learner


def form_of(name: str, code: object) -> str:
    """The form of what an agent's name stands for: CLASS, GENERATOR or COMPILED.

    Raises:
        ParameterError: it is no agent.
    """
    if isinstance(code, type):
        return GENERATOR if all(callable(getattr(code, each, None)) for each in STEPPED) else CLASS
    if code is None:
        where, _, attribute = name.rpartition(":")
        raise ParameterError(f"agent {name!r}: {where} has no {attribute!r}; expected the name of a class or function")
    if not callable(code):
        raise ParameterError(
            f"agent {name!r} is {code!r}; expected a class for Stable-Baselines3, or a function learn(env, steps, seed)"
        )
    try:
        inspect.signature(code).bind(None, 0, 0)
    except (TypeError, ValueError) as error:  # of both together: learn(env, steps, seed, rate=0.1) is a generator, too
        with contextlib.suppress(TypeError, ValueError):
            inspect.signature(code).bind(None, None, 0, None)
            return COMPILED
        raise ParameterError(f"agent {name!r}: {error}; expected {FUNCTIONS}") from None
    return GENERATOR


def generator_of(code: Callable[..., Any]) -> Callable[..., Iterator[PolicyLike]]:
    """An agent of the form GENERATOR as a function learn(env, steps, seed, **hyperparameters).

    A class is made with MADE_WITH, num_envs = 1. Each step asks `act(observations)`, arrays (1, ...), for (1,) actions,
    and ends with `observe(observations, actions, rewards, next_observations, terminated, truncated)`, in which
    next_observations are those before a reset. At each evaluation `policy(observations)`, of any number of them, is
    what it has learnt.
    """
    if not isinstance(code, type):
        return code

    def learn(env: Any, steps: int, seed: int, **hyperparameters: Any) -> Iterator[PolicyLike]:
        agent = code(
            observation_space=env.observation_space,
            action_space=env.action_space,
            num_envs=1,
            seed=seed,
            **hyperparameters,
        )
        observation, _ = env.reset(seed=seed)
        for step in range(1, steps + 1):
            actions = np.asarray(agent.act(observation[None]))
            if actions.shape != (1,):
                raise ParameterError(
                    f"act(observations) gave an array of shape {actions.shape}; expected (1,), an action for each of "
                    f"{len(observation[None])} observations"
                )
            after, reward, terminated, truncated, _ = env.step(actions[0])
            ends = np.array([terminated]), np.array([truncated])
            agent.observe(observation[None], actions, np.array([reward]), after[None], *ends)
            observation = env.reset()[0] if terminated or truncated else after
            if step % env.budget.interval == 0 or step == steps:
                yield agent.policy

    return learn


def agent_source(
    agent: str | Callable[..., Any], folder: str | Path | None = None, *, check: bool = True
) -> Source | None:
    """Place of the code of a user's own agent, or None for all others.

    Args:
        agent: a name, or the class or function itself, which then has this name in this process.
        folder: relative files and modules are looked for there first. Default: the current directory.
        check: whether it is imported, to see that it is an agent.
    Raises:
        ParameterError: it cannot be imported, or is no agent.
    """
    if not isinstance(agent, str):
        source = register_source(agent)
        form_of(source.name, agent)
        return source
    if is_known(agent):
        return None
    source = announced(agent) or find_source(agent, folder)
    if check:
        form_of(source.name, load_source(source))
    return source


def agent_name(agent: str | Callable[..., Any]) -> str:
    """The name of an agent, under which this process has it."""
    source = None if isinstance(agent, str) else agent_source(agent)
    return str(agent) if source is None else source.name


@dataclass(frozen=True, kw_only=True, eq=False)
class OwnAgent(DeepAgent):
    """An agent by its name alone: its code is imported when a run is prepared, if it is trusted."""

    def library_default(self, name: str) -> object:
        source = agent_source(self.name)
        assert source is not None
        code = load_source(source)
        if form_of(self.name, code) == CLASS:
            return super().library_default(name)
        parameter = inspect.signature(code).parameters.get(name)
        return None if parameter is None or parameter.default is parameter.empty else parameter.default

    def check_before(self, hyperparameters: Mapping[str, Any], engine: str) -> None:
        """Nothing: its code is not imported before it is trusted."""

    def prepare(self, run: LearningRun, device: str, *, is_single: bool) -> Hashable | None:
        form = form_of(self.name, run.algorithm)
        if form == CLASS:
            return super().prepare(run, device, is_single=is_single)
        check_keywords(self.name, run.algorithm, run.hyperparameters)
        if form == GENERATOR or is_single:
            return None
        return form, json.dumps({**run.config.to_dict(), "seed": None}, sort_keys=True)

    def learner(self, runs: Sequence[LearningRun], device: str, logs: Path | None = None) -> Learner:
        code = runs[0].algorithm
        form = form_of(self.name, code)
        if form == CLASS:
            return super().learner(runs, device, logs)
        if logs is not None:
            raise ParameterError(
                f"agent {self.name!r} is a function, which has no logs of TensorBoard; leave tensorboard out"
            )
        assert not isinstance(code, str)
        return _FUNCTION_LEARNERS[form](runs, code)

    def load(self, folder: Path, run: LearningRun) -> PolicyLike:
        if form_of(self.name, run.algorithm) == CLASS:
            return super().load(folder, run)
        if not (folder / POLICY).exists():
            raise FileFormatError(
                f"{folder}: the policy of the function {self.name} is not kept, as it is no table of states"
            )
        return read_policy_table(folder)


def check_keywords(name: str, code: Any, hyperparameters: Mapping[str, Any]) -> None:
    """Raise UnknownName or ParameterError for hyperparameters that are no keywords of the function.

    Keywords are what is behind a *, or has a default and comes after the arguments that every agent gets.
    """
    parameters = inspect.signature(code).parameters.values()
    if any(each.kind is each.VAR_KEYWORD for each in parameters):
        return
    if isinstance(code, type):
        keywords = [each.name for each in parameters if each.name not in MADE_WITH]
    else:
        further = [each for each in parameters if each.kind is each.POSITIONAL_OR_KEYWORD]
        further = further[3 if form_of(name, code) == GENERATOR else 4 :]
        keywords = [each.name for each in parameters if each.kind is each.KEYWORD_ONLY or each in further]
    unknown = [each for each in hyperparameters if each not in keywords]
    if unknown and not keywords:
        raise ParameterError(
            f"agent {name!r} is a function, which has its hyperparameters in its code; found {', '.join(unknown)}; "
            f"name them behind a *: learn(env, steps, seed, *, {unknown[0]}=...)"
        )
    if unknown:
        raise UnknownName(f"hyperparameter of {name}", unknown[0], keywords)
