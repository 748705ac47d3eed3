"""Environments in JAX as exact tabular MDPs: pure functions, stepped in all states of a layer at once.

Nothing has to be copied: a state is a value. Chance is enumerated by a tape, see `jax_chance`.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

from pharos.errors import MissingExtra, ParameterError
from pharos.importers.chance import MOST_DRAW_OUTCOMES
from pharos.importers.search import SteppedStates
from pharos.importers.stepped_environment import Payment, SteppingOptions
from pharos.importers.stepping import MOST_STEPPED_STATES, SteppingRun, StepRecording
from pharos.mdp import TabularMDP, whole_number
from pharos.system.wording import in_one_line

if TYPE_CHECKING:
    from pharos.importers.jax_environment import JaxEnvironment


@dataclass(frozen=True)
class JaxFunctions:
    """An environment as pure functions of JAX.

    Attributes:
        step: (key, state, action) -> (observation, state, reward, whether the episode ended, ...), without resets.
        reset: key -> (observation, state).
        actions: their number, or what `step` takes.
        name: for messages. time_limit: in steps; None: it has none.
        action_names: None: numbers. counters: fields of a state that are left out if they turn
            out to decide nothing.
    """

    step: Callable[[Any, Any, Any], tuple]
    reset: Callable[[Any], tuple]
    actions: int | Sequence[Any]
    name: str = "step_env"
    time_limit: int | None = None
    action_names: tuple[str, ...] | None = None
    counters: tuple[str, ...] = ()


def jax_stepping(  # noqa: PLR0913  (options of one import)
    step_env: Callable[[Any, Any, Any], tuple],
    reset_env: Callable[[Any], tuple],
    actions: int | Sequence[Any],
    *,
    seed: int | None = None,
    ignore: Sequence[str] = (),
    reward: Payment | None = None,
    gamma: float | None = None,
    horizon: int | None = None,
    max_states: int = MOST_STEPPED_STATES,
    max_outcomes: int = MOST_DRAW_OUTCOMES,
    check: bool = True,
    progress: Callable[[SteppedStates, float, bool], None] | None = None,
) -> tuple[TabularMDP, StepRecording]:
    """Return the exact MDP of an environment in JAX, such as one of gymnax or pgx, by stepping all of its states.

    Draws of `jax.random` among finitely many outcomes are enumerated: `bernoulli`, `randint`, `choice`, `categorical`,
    `permutation`, and comparisons of `uniform`. Probabilities that the code gives as numbers are exact; those that
    depend on the state have JAX' precision, float32 as a rule.

    Args:
        step_env: (key, state, action) -> (observation, state, reward, whether the episode ended, ...); it does not
            reset. A state is any tree of arrays; keys of `jax.random` in it are no part of the state.
        reset_env: key -> (observation, state).
        actions: their number, or a list of what `step_env` takes.
        seed: of the one start; None: all starts that a reset can draw.
        ignore: names of fields of the state that do not matter, such as counters of steps; checked on pairs.
        reward, gamma, horizon, max_states, max_outcomes, progress: as of `stepping`.
        check: whether episodes are played with JAX' own chance, and compared with the MDP.
    Returns:
        (MDP, recording), as of `stepping`.
    Raises:
        MissingExtra: JAX is not installed.
        RuleError: a draw has no finite list of outcomes, or cannot be followed: under `vmap`, in a loop whose length
            depends on the state. The line of the environment's code is named.
        StateSpaceTooLarge: there are more than `max_states` states.
    Cost: seconds to compile; then 10,000 to 200,000 outcomes a second. All combinations of the draws of a step are run,
        on both sides of a branch.
    """
    functions = JaxFunctions(step_env, reset_env, actions)
    options = SteppingOptions(
        seed=seed,
        ignore=frozenset([ignore] if isinstance(ignore, str) else ignore),
        reward=reward,
        max_outcomes=whole_number(max_outcomes, "max_outcomes", "a number of at least 1"),
    )
    run = SteppingRun(
        lambda: functions, options, horizon=horizon, max_states=max_states, check=check, source_of=jax_source
    )
    return run.finish(gamma, progress)


def jax_source(factory: Callable[[], JaxFunctions], options: SteppingOptions) -> "JaxEnvironment":
    """The source of states of functions in JAX; MissingExtra if JAX is not there."""
    try:
        import jax
    except ImportError:
        raise MissingExtra("an environment in JAX", "jax", "jax") from None
    del jax
    from pharos.importers.jax_environment import JaxEnvironment

    return JaxEnvironment(factory, options)


@dataclass(frozen=True)
class GymnaxEnvironment:
    """Maker of an environment of gymnax.

    Attributes:
        name: such as Catch-bsuite. options: of the environment, or of its parameters.
    """

    name: str
    options: Mapping[str, Any]

    def __call__(self) -> JaxFunctions:
        """Its functions."""
        try:
            import gymnax
        except ImportError:
            raise MissingExtra(f"gymnax:{self.name}", "gymnax", "jax") from None
        try:
            _, params = gymnax.make(self.name)
            names = {field.name for field in fields(params)}
            env, params = gymnax.make(self.name, **{k: v for k, v in self.options.items() if k not in names})
            params = params.replace(**{k: v for k, v in self.options.items() if k in names})
        except Exception as error:  # whatever it does with options that are none of its own
            raise ParameterError(f"gymnax:{self.name}: gymnax cannot make it: {in_one_line(error)}") from None
        return JaxFunctions(
            lambda key, state, action: env.step_env(key, state, action, params),
            lambda key: env.reset_env(key, params),
            env.num_actions,
            name=self.name,
            time_limit=int(params.max_steps_in_episode),
            counters=("time",),
        )


@dataclass(frozen=True)
class PgxEnvironment:
    """Maker of a game of pgx for one player.

    Attributes:
        name: such as 2048. options: of the game.
    """

    name: str
    options: Mapping[str, Any]

    def __call__(self) -> JaxFunctions:
        """Its functions."""
        try:
            import pgx
        except ImportError:
            raise ParameterError(f"pgx:{self.name}: pgx is not installed: pip install pgx") from None
        try:
            env = pgx.make(self.name, **self.options)
        except Exception as error:
            raise ParameterError(f"pgx:{self.name}: pgx cannot make it: {in_one_line(error)}") from None
        if env.num_players > 1:
            raise ParameterError(
                f"pgx:{self.name}: is for {env.num_players} players; expected a game for one, or jax_stepping "
                f"with a step_env in which the others move as well"
            )

        def step(key: object, state: Any, action: object) -> tuple:
            after = env.step(state, action, key)
            return after.observation, after, after.rewards[0], after.terminated | after.truncated

        def reset(key: object) -> tuple:
            state = env.init(key)
            return state.observation, state

        last = ("_step_count", "rewards", "observation")
        return JaxFunctions(step, reset, env.num_actions, name=self.name, counters=last)
