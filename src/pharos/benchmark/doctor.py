"""Readings of an agent whose worlds are known exactly: whether its values obey the equation that they ought to obey.

Values of actions of a healthy learner are near their own backup, Q(s, a) = r(s, a) + gamma E max Q(s', .), and values
of states near the value of their policy, whatever has been learnt so far. A fault is another equation: without the end
of an episode, with clipped rewards, with another discount. `residuals` says how far the values are from each, in units
of the deviation of the backup, and the discount that fits best is part of the answer. All is arithmetic on small
arrays.

A learner of the values of the policy that explores, such as SARSA, obeys Q(s, a) = r(s, a) + gamma E sum mu(a'|s')
Q(s', a') in place of it, with mu as it was played. `on_policy` has the same readings for it.

Source: Sutton and Barto (2018), sections 3.6, 6.4 (SARSA) and 11.4 (Bellman residuals). The equations of faults are
ours.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from pharos.benchmark.examination import Examination, WorldArrays

GAMMAS = (0.0, 0.25, 0.5, 0.7, 0.8, 0.9, 0.95, 0.98, 0.99, 0.995)
RIGHT_EQUATION = "right"
EQUATIONS = {
    RIGHT_EQUATION: "reward, and the discounted value of what comes after",
    "through_ends": "values go on after the end of an episode",
    "to_next_episode": "values go on into the next episode",
    "cut_is_end": "the time limit counts as an end",
    "signs": "rewards are replaced by their signs",
    "earlier_reward": "each step has the reward of the one before",
    "itself": "what comes after is the state itself",
    "mean": "the mean of the next values in place of the largest",
    "negative": "rewards have the wrong sign",
}
"""Equations that values may obey: name -> in words."""
RESIDUAL_FLOOR = 0.02  # a residual below it is as good as none
LEAST_VISITS = 3  # visits of a pair that counts
CUTS = 30  # steps, of which one is cut by the time limit in worlds that tell whether it is an end
SAME = 1e-6


def targets(examination: Examination, gamma: float) -> dict[str, np.ndarray]:
    """Values by each of EQUATIONS if the next values are the agent's own.

    Args:
        examination: with `q`, (S, A), or `v`, (S,).
    Returns:
        Arrays of the shape of `q`, or of `v`, for the equations that the world can distinguish from the right one.
    """
    world, values, v = examination.world, answers_of(examination), state_values(examination)
    q = values if values.ndim == 2 else None
    live = np.where(world.terminal, 0.0, v)
    visits = np.maximum(examination.visits, 1)
    moves, rewards = world.transitions, world.rewards
    ends = moves @ world.terminal
    cuts = examination.cuts / visits
    onward = moves @ live
    first = world.start @ v
    backups = {
        RIGHT_EQUATION: rewards + gamma * onward,
        "through_ends": rewards + gamma * (moves @ v),
        "to_next_episode": rewards + gamma * ((1 - cuts) * onward + (ends + cuts) * first),
        "cut_is_end": rewards + gamma * (1 - cuts) * onward,
        "signs": np.sign(rewards) + gamma * onward,
        "earlier_reward": earlier_rewards(examination)[:, None] + gamma * onward,
        "itself": rewards + gamma * (1 - ends) * live[:, None],
        "negative": gamma * onward - rewards,
    }
    if q is not None:
        backups["mean"] = rewards + gamma * (moves @ np.where(world.terminal, 0.0, q.mean(axis=1)))
    differs = {
        "through_ends": ends.any(),
        "to_next_episode": ends.any() or cuts.any(),
        "cut_is_end": cuts.any(),
        "signs": not np.isin(rewards, (-1, 0, 1)).all(),
    }
    backups = {name: values for name, values in backups.items() if differs.get(name, True)}
    if q is None:
        return {name: (examination.policy * values).sum(axis=1) for name, values in backups.items()}
    return backups


def earlier_rewards(examination: Examination) -> np.ndarray:
    """(S,) mean reward of the step before each state, over the steps of the run, if that is not forgotten at a reset:
    at the start of an episode the last step of another one counts.
    """
    world, visits, cuts = examination.world, examination.visits, examination.cuts
    flow = (visits - cuts)[:, :, None] * world.transitions * ~world.terminal
    last = cuts + (visits - cuts) * (world.transitions @ world.terminal)
    arrivals = flow.sum(axis=(0, 1)) + world.start * last.sum()
    income = (flow * world.rewards[:, :, None]).sum(axis=(0, 1)) + world.start * (last * world.rewards).sum()
    return np.divide(income, arrivals, out=np.zeros(len(arrivals)), where=arrivals > 0)


def weights_of(examination: Examination, visits: np.ndarray) -> np.ndarray:
    """Weights of pairs, or of states if it has values of states alone: roots of visits, which sum to 1."""
    counts = visits if examination.q is not None else visits.sum(axis=1)
    counts = np.where(counts >= min(LEAST_VISITS, counts.max()), counts, 0)
    roots = np.sqrt(counts)
    return roots / max(roots.sum(), 1e-12)


def deviation(values: np.ndarray, weights: np.ndarray) -> float:
    """Standard deviation under weights."""
    mean = float((weights * values).sum())
    return float(np.sqrt((weights * (values - mean) ** 2).sum()))


def distance(values: np.ndarray, target: np.ndarray, weights: np.ndarray, least: float) -> float:
    """Root mean square of `values - target` in units of the deviation of the target, or of `least` if that is larger:
    at most 100.
    """
    error = float(np.sqrt((weights * (values - target) ** 2).sum()))
    scale = max(deviation(target, weights), least, 1e-12)
    return min(error / scale, 100.0) if np.isfinite(error) else 100.0


def answers_of(examination: Examination) -> np.ndarray:
    """The values of actions, or of states, huge ones cut."""
    values = examination.q if examination.q is not None else examination.v
    assert values is not None
    return np.nan_to_num(np.clip(values, -1e12, 1e12), nan=1e12)


def state_values(examination: Examination) -> np.ndarray:
    """(S,) values of states as they enter a backup: answers, or the largest value, or the mean of what comes onward."""
    values, onward = answers_of(examination), examination.onward
    if values.ndim == 1:
        return values
    return values.max(axis=1) if onward is None else (onward * values).sum(axis=1)


def on_policy(examination: Examination) -> Examination:
    """The same for a learner on-policy: next actions count as often as they were played in all of the run, as pairs
    are weighed by it. Where it never was, the largest value does.
    """
    assert examination.q is not None
    visits, greedy = examination.visits, answers_of(examination).argmax(axis=1)
    sums = visits.sum(axis=1, keepdims=True)
    return replace(
        examination, onward=np.where(sums > 0, visits / np.maximum(sums, 1), np.eye(visits.shape[1])[greedy])
    )


def residuals(examination: Examination, visits: np.ndarray | None = None) -> dict[str, np.ndarray]:
    """Distances from each of the equations that the world tells apart, (len(GAMMAS),) by name.

    Args:
        visits: (S, A), of the pairs that count. Default: all of the run.
    """
    weights = weights_of(examination, examination.visits if visits is None else visits)
    values, least = answers_of(examination), least_scale(examination.world)
    columns: dict[str, list[float]] = {}
    for gamma in GAMMAS:
        for name, target in targets(examination, gamma).items():
            columns.setdefault(name, []).append(distance(values, target, weights, least))
    return {name: np.array(column) for name, column in columns.items()}


def least_scale(world: WorldArrays) -> float:
    """The least deviation of values that errors are measured in: a twentieth of the largest reward."""
    return 0.05 * float(np.abs(world.rewards).max())


def contrast(
    examination: Examination, name: str, gamma: float, right_gamma: float, visits: np.ndarray | None = None
) -> float:
    """log10 of the distance from an equation, less the distance from the right one, where both differ: negative if the
    values obey this one. Each with its own discount. NaN: they differ nowhere where it was.

    Args:
        visits: (S, A), of the pairs that count. Default: all of the run.
    """
    other, right = targets(examination, gamma), targets(examination, right_gamma)[RIGHT_EQUATION]
    if name not in other:
        return float("nan")
    weights = weights_of(examination, examination.visits if visits is None else visits)
    values = answers_of(examination)
    parts = weights * (np.abs(other[name] - other[RIGHT_EQUATION]) > 0.02 * _scale(other[RIGHT_EQUATION], weights))
    if parts.sum() < 1e-3:
        return float("nan")
    parts = parts / parts.sum()
    logs = []
    for target in (other[name], right):
        error = float(np.sqrt((parts * (values - target) ** 2).sum())) / _scale(target, weights)
        logs.append(np.log10(min(error, 100.0) + RESIDUAL_FLOOR))
    return float(logs[0] - logs[1])


def _scale(target: np.ndarray, weights: np.ndarray) -> float:
    """Deviation of a target under weights, at least a twentieth of its largest value."""
    return max(deviation(target, weights), 0.05 * float(np.abs(target[weights > 0]).max(initial=0)), 1e-9)


def cut_shares(examination: Examination, gamma: float, visits: np.ndarray | None = None) -> tuple[float, float]:
    """Shares of the way from the right equation, 0, to the equation in which the time limit is an end, 1: by
    projection, and by regression beside the next values and a constant, which a slow target network does not move.

    NaN if the time limit ends less than one in CUTS steps.

    Args:
        visits: (S, A), of the pairs that count. Default: all of the run.
    """
    if examination.cuts.sum() * CUTS < examination.visits.sum():
        return float("nan"), float("nan")
    backups, values = targets(examination, gamma), answers_of(examination)
    right, weights = backups[RIGHT_EQUATION], weights_of(examination, examination.visits if visits is None else visits)
    way, error = backups["cut_is_end"] - right, values - right
    length = float((weights * way**2).sum())
    if length < 1e-12:
        return float("nan"), float("nan")
    roots = np.sqrt(weights.ravel())
    columns = np.stack([way.ravel(), right.ravel(), np.ones(way.size)], axis=1) * roots[:, None]
    partial = np.linalg.lstsq(columns, error.ravel() * roots, rcond=None)[0][0]
    return tuple(float(np.clip(x, -2, 3)) for x in ((weights * way * error).sum() / length, partial))  # type: ignore[return-value]


def exact_values(examination: Examination, gamma: float) -> np.ndarray:
    """Exact values of what it learns, of the shape of its answers: of the optimal policy, of the one that is played
    onward, or, of states, of its own.
    """
    if examination.q is not None:
        return optimal(examination.world, gamma, examination.onward)
    return (examination.policy * optimal(examination.world, gamma, examination.policy)).sum(axis=1)


def optimal(world: WorldArrays, gamma: float, policy: np.ndarray | None = None, sweeps: int = 2000) -> np.ndarray:
    """(S, A) values of actions of the optimal policy, or of a policy (S, A), by iteration until nothing changes."""
    q = np.zeros_like(world.rewards)
    for _ in range(sweeps):
        v = q.max(axis=1) if policy is None else (policy * q).sum(axis=1)
        after = world.rewards + gamma * (world.transitions @ np.where(world.terminal, 0.0, v))
        if np.abs(after - q).max() < 1e-9 * (1 + np.abs(after).max()):
            return after
        q = after
    return q


# Readings -------------------------------------------------------------------------------------------------------------


def readings(examinations: Sequence[Examination]) -> dict[str, float]:
    """Numbers that describe an agent, by name. Numbers that do not apply to it are left out.

    Of an agent with values:

    - `gamma`: the discount that fits them best, as log10 of 1 / (1 - gamma)
    - `consistency`: log10 of the residual
    - of each other equation the residual less the right one's, negative if it fits better
    - `cut_share` and `cut_partial`: see `cut_shares`
    - `image` and `image_size`: the residual and `size` if it sees images less the same for others
    - `cut_partial_late` and `itself_late`: the same in states that it visited in the last fifth alone, as values
      elsewhere lag behind, as if the time limit were an end, or what comes after the state itself
    - `on_policy`: `consistency` if the next actions count as they were played, see `on_policy`
    - `slope`: log10 of the factor with which rewards enter
    - `size`: log10 of the deviation of the values relative to exact ones
    - `truth`: their correlation with exact ones, and `truth_unvisited` elsewhere
    - `bias`: their mean error in deviations
    - `ends`: values of terminal states in deviations
    - `deaf`: the share of numbers of observations that change nothing, and `deaf_last` of last ones
    - `wavering`: log10 of the change if asked again
    - `forgets`: the residual in lately visited states less the residual of all
    - `own`: whether they are nearer to values of its policy than to optimal ones
    - `far`: the error far from the end less the error near it

    Of all:

    - `overlap` of late behaviour with the policy, and `overlap_shifted` with its actions shifted, less that
    - `random`: entropy of late behaviour, 1 as uniform
    - `certain`: probability of the likeliest action
    - `coverage` of states
    - `behind`: late regret of behaviour less the policy's
    - `equal_seeds`: share of worlds in which two seeds did the same
    - `regret` of each world
    """
    numbers: dict[str, float] = {}
    with_values = [each for each in examinations if each.q is not None or each.v is not None]
    if with_values:
        numbers |= _of_values(with_values)
    numbers |= _of_behaviour(examinations)
    return {name: float(value) for name, value in numbers.items() if np.isfinite(value)}


def _of_values(examinations: Sequence[Examination]) -> dict[str, float]:
    tables = [residuals(each) for each in examinations]
    logs = [{name: np.log10(row + RESIDUAL_FLOOR) for name, row in table.items()} for table in tables]
    right = np.mean([table[RIGHT_EQUATION] for table in logs], axis=0)
    index = int(right.argmin())
    gamma = GAMMAS[index]
    numbers = {"gamma": -np.log10(1 - gamma), "consistency": float(right[index])}
    if all(each.q is not None for each in examinations):
        played = [np.log10(residuals(on_policy(each))[RIGHT_EQUATION] + RESIDUAL_FLOOR) for each in examinations]
        numbers["on_policy"] = float(np.mean(played, axis=0).min())
    for name in EQUATIONS:
        applicable = [table for table in logs if name in table]
        if name != RIGHT_EQUATION and applicable:
            own = GAMMAS[int(np.mean([table.get(name, table[RIGHT_EQUATION]) for table in logs], axis=0).argmin())]
            numbers[name] = _mean_contrast(contrast(each, name, own, gamma) for each in examinations)
            if name == "itself":
                late = (contrast(each, name, own, gamma, each.late) for each in examinations)
                numbers["itself_late"] = _mean_contrast(late)
    is_image = np.array([each.name.endswith("image") for each in examinations])
    if 0 < is_image.sum() < len(is_image):
        at_best = np.array([table[RIGHT_EQUATION][index] for table in logs])
        numbers["image"] = at_best[is_image].mean() - at_best[~is_image].mean()
        sizes = np.array([_size(each, gamma) for each in examinations])
        numbers["image_size"] = sizes[is_image].mean() - sizes[~is_image].mean()
    columns: dict[str, list[float]] = {}
    for each in examinations:
        for name, value in _of_one(each, gamma).items():
            if np.isfinite(value):
                columns.setdefault(name, []).append(value)
    return numbers | {name: float(np.mean(column)) for name, column in columns.items()}


def _mean_contrast(contrasts: Iterable[float]) -> float:
    """Mean of those that are numbers, or NaN if none is."""
    rows = [each for each in contrasts if np.isfinite(each)]
    return float(np.mean(rows)) if rows else np.nan


def _of_one(examination: Examination, gamma: float) -> dict[str, float]:
    """Readings of the values of one run."""
    world, values = examination.world, answers_of(examination)
    weights = weights_of(examination, examination.visits)
    exact = exact_values(examination, gamma)
    is_live = np.broadcast_to((~world.terminal).reshape(-1, *[1] * (values.ndim - 1)), values.shape)
    is_new = is_live & (weights == 0)
    scale = max(deviation(exact, weights), 1e-6 + 0.05 * float(np.abs(world.rewards).max()))
    error = np.abs(values - exact) / scale
    numbers = {
        "size": _size(examination, gamma),
        "truth": correlation(values, exact, weights),
        "bias": np.clip((weights * (values - exact)).sum() / scale, -5, 5),
        "deaf": float((examination.reaction[world.vary] < SAME).mean()),
        "deaf_last": float(examination.reaction[np.flatnonzero(world.vary)[-1]] < SAME),
        "wavering": np.log10(max(examination.wavering, SAME)),
    }
    if is_new.any():
        numbers["error_unvisited"] = np.clip(np.log10(error[is_new].mean() + RESIDUAL_FLOOR), -2, 3)
    if world.terminal.any():
        after = values[world.terminal].max(axis=1) if values.ndim == 2 else values[world.terminal]
        numbers["ends"] = np.clip(np.log10(np.abs(after).mean() / max(deviation(values, weights), 1e-9) + 1e-3), -3, 3)
    late = residuals(examination, examination.last)[RIGHT_EQUATION][GAMMAS.index(gamma)]
    numbers["forgets"] = np.log10(late + RESIDUAL_FLOOR) - np.log10(
        residuals(examination)[RIGHT_EQUATION][GAMMAS.index(gamma)] + RESIDUAL_FLOOR
    )
    numbers["slope"] = np.clip(reward_slope(examination, gamma), -3, 3)
    numbers["cut_share"], numbers["cut_partial"] = cut_shares(examination, gamma)
    _, numbers["cut_partial_late"] = cut_shares(examination, gamma, examination.late)
    if examination.q is not None:
        own = optimal(world, gamma, examination.policy)
        numbers["own"] = np.log10(
            (distance(values, own, weights, 1e-6) + RESIDUAL_FLOOR)
            / (distance(values, exact, weights, 1e-6) + RESIDUAL_FLOOR)
        )
        numbers["truth_greedy"] = greedy_share(values, exact, weights)
    steps = steps_to_end(world)
    is_far = steps > np.median(steps[weights.reshape(len(steps), -1).sum(axis=1) > 0])
    far = weights * np.broadcast_to(is_far.reshape(-1, *[1] * (values.ndim - 1)), values.shape)
    if 0 < far.sum() < weights.sum():
        near = weights - far
        parts = [(part * error).sum() / part.sum() for part in (far, near)]
        numbers["far"] = np.clip(np.log10((parts[0] + RESIDUAL_FLOOR) / (parts[1] + RESIDUAL_FLOOR)), -2, 2)
    return {name: float(value) for name, value in numbers.items()}


def _size(examination: Examination, gamma: float) -> float:
    """log10 of the deviation of values relative to exact ones, of the optimal policy or of the agent's own."""
    world, weights = examination.world, weights_of(examination, examination.visits)
    exact = exact_values(examination, gamma)
    least = 1e-6 + least_scale(world)
    return float(
        np.clip(
            np.log10(max(deviation(answers_of(examination), weights), 1e-9) / max(deviation(exact, weights), least)),
            -3,
            3,
        )
    )


def correlation(x: np.ndarray, y: np.ndarray, weights: np.ndarray) -> float:
    """Correlation under weights, or 0 if one of them is constant."""
    x, y = x - (weights * x).sum(), y - (weights * y).sum()
    both = float(np.sqrt((weights * x * x).sum() * (weights * y * y).sum()))
    return float((weights * x * y).sum() / both) if both > 1e-12 else 0.0


def greedy_share(q: np.ndarray, exact: np.ndarray, weights: np.ndarray) -> float:
    """Share of states, by their weights, in which an action of the largest value is optimal."""
    best = exact >= exact.max(axis=1, keepdims=True) - 1e-6 * (1 + np.abs(exact).max())
    share = weights.sum(axis=1)
    return float(share @ best[np.arange(len(q)), q.argmax(axis=1)])


def reward_slope(examination: Examination, gamma: float) -> float:
    """log10 of the factor with which rewards enter values: the slope of values less discounted next values on rewards.

    NaN if rewards do not differ in states that it visited. -3 if the slope is not positive.
    """
    values, world = answers_of(examination), examination.world
    live = np.where(world.terminal, 0.0, state_values(examination))
    onward, rewards = gamma * (world.transitions @ live), world.rewards
    if values.ndim == 1:
        onward, rewards = (examination.policy * onward).sum(axis=1), (examination.policy * rewards).sum(axis=1)
    weights = weights_of(examination, examination.visits)
    centred = rewards - (weights * rewards).sum()
    variance = float((weights * centred**2).sum())
    if variance < 1e-12:
        return float("nan")
    slope = float((weights * centred * (values - onward)).sum()) / variance
    return float(np.log10(slope)) if slope > 1e-3 else -3.0


def steps_to_end(world: WorldArrays) -> np.ndarray:
    """(S,) least number of steps to a terminal state, or, without one, to the state with the largest reward."""
    steps = np.where(world.terminal, 0, np.inf)
    if not world.terminal.any():
        steps[world.rewards.max(axis=1).argmax()] = 0
    reachable = (world.transitions > 0).any(axis=1)
    for _ in range(len(steps)):
        nearest = np.where(reachable, steps[None, :], np.inf).min(axis=1) + 1
        steps = np.minimum(steps, nearest)
    return np.where(np.isfinite(steps), steps, len(steps))


def _of_behaviour(examinations: Sequence[Examination]) -> dict[str, float]:
    columns: dict[str, list[float]] = {}
    for each in examinations:
        late, num_actions = each.late, each.policy.shape[1]
        share = late.sum(axis=1) / max(late.sum(), 1)
        frequency = late / np.maximum(late.sum(axis=1, keepdims=True), 1)
        overlaps = [float(share @ np.minimum(frequency, np.roll(each.policy, -k, axis=1)).sum(axis=1)) for k in (0, 1)]
        surprise = -(frequency * np.log(np.maximum(frequency, 1e-12))).sum(axis=1)
        numbers = {
            "overlap": overlaps[0],
            "overlap_shifted": overlaps[1] - overlaps[0],
            "random": float(share @ surprise / np.log(num_actions)),
            "certain": float(share @ each.policy.max(axis=1)),
            "coverage": float((each.visits.sum(axis=1) > 0).sum() / max((~each.world.terminal).sum(), 1)),
            "behind": float(np.clip(each.late_regret - each.regret, -2, 2)),
            f"regret_{each.name}": float(np.clip(each.regret, 0, 1.5)),
        }
        for name, value in numbers.items():
            columns.setdefault(name, []).append(value)
    numbers = {name: float(np.nanmean(column)) for name, column in columns.items() if not np.isnan(column).all()}
    pairs = same_runs(examinations)
    return numbers | ({"equal_seeds": float(np.mean([*pairs.values()]))} if pairs else {})


def same_runs(examinations: Sequence[Examination]) -> Mapping[str, bool]:
    """By world with two seeds or more: whether all did the same, in each state each action as often."""
    runs: dict[str, list[np.ndarray]] = {}
    for each in examinations:
        runs.setdefault(each.name, []).append(each.visits)
    return {
        name: all((one == visits[0]).all() for one in visits[1:]) for name, visits in runs.items() if len(visits) > 1
    }
