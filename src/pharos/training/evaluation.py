"""The value of what an agent has learnt, in the setting of its task."""

from pharos.policies import Evaluation, PolicyLike, evaluate_seeing
from pharos.training.task import Task

__all__ = ["Evaluation", "evaluate_agent"]


def evaluate_agent(
    agent: PolicyLike,
    task: Task,
    *,
    deterministic: bool = False,
    max_states: int = 100_000,
    episodes: int = 2_000,
    seed: int = 0,
    again: bool = False,
) -> Evaluation:
    """Return the value of an agent's current policy on a task.

    Args:
        agent: has `policy_table()` (S,), (S, A) or as `pharos.evaluate_policy` takes it; or
            `action_probabilities(observations)` -> (N, A); or is a model of Stable-Baselines3; or an array like the
            table; or a function of observations that returns (N, A) probabilities or (N,) actions.
        deterministic: whether the most probable action is taken (the first among equals) instead of one at random.
        max_states: how many states (pairs, where previous actions matter) the policy may reach for an exact value.
        episodes, seed: of the estimate beyond that.
        again: whether more policies of the task will be evaluated: what they share is remembered. Changes no value.
    Raises:
        ParameterError: the agent is none of these, or its answers are no probabilities.
    Cost: one answer of the policy for each state reached, then horizon x states reached.
    Source: exact policy evaluation, Puterman (1994), section 6.1; reached states: a closed class of an MDP has the same
        values alone; Maurer and Pontil (2009), theorem 4.
    """
    return evaluate_seeing(
        agent,
        task.mdp,
        lambda: task.sight,
        lambda: task.return_range,
        deterministic=deterministic,
        max_states=max_states,
        episodes=episodes,
        seed=seed,
        reach=task.reach if again else None,
    )
