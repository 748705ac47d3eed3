"""Chance and the table walk of vector environments: loops over N environments, each with a stream of random numbers."""

from numba import float64, int64, njit, uint64

NEXT_STEP, SAME_STEP, DISABLED = range(3)  # when an environment that has ended is reset


@njit(forceinline=True)
def uniform_number(rng, i):
    """A number in [0, 1) of stream i: SplitMix64 (Steele, Lea and Flood 2014) on the counter rng[i]."""
    rng[i] += uint64(0x9E3779B97F4A7C15)
    z = rng[i]
    z = (z ^ (z >> uint64(30))) * uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> uint64(27))) * uint64(0x94D049BB133111EB)
    z ^= z >> uint64(31)
    return float64(z >> uint64(11)) * 2.0**-53


@njit(forceinline=True)
def executed_action(chosen, previous, chance, num_actions, rng, i):
    """The executed action: chosen, previous or uniform with the weights `chance`; without chance nothing is drawn."""
    if chance[0] >= 1.0:
        return chosen
    u = uniform_number(rng, i)
    if u < chance[0] or (u < chance[0] + chance[1] and previous < 0):
        return chosen
    if u < chance[0] + chance[1]:
        return previous
    return min(int64((u - chance[0] - chance[1]) / chance[2] * num_actions), num_actions - 1)


@njit(forceinline=True)
def drawn_start(cumulative, rng, i):
    """The number of a start state; nothing is drawn where there is one."""
    k = 0
    if len(cumulative) > 1:
        u = uniform_number(rng, i)
        while k < len(cumulative) - 1 and u >= cumulative[k]:
            k += 1
    return k


@njit(cache=True, nogil=True)
def draw_starts(cumulative, rng, mask, out):
    """out[i] = number of a start state, for every i in `mask`."""
    for i in range(len(out)):
        if mask[i]:
            out[i] = drawn_start(cumulative, rng, i)


@njit(cache=True, nogil=True)
def first_outside(actions, num_actions):
    """The first i whose action is none, or -1."""
    for i in range(len(actions)):
        if actions[i] < 0 or actions[i] >= num_actions:
            return i
    return -1


@njit(cache=True, nogil=True)
def walk_table(successors, table_rewards, is_terminal, chance, limit, mode, first_previous, starts, cumulative, rng, actions,
               index, previous, elapsed, ended, rewards, terminated, truncated, executed, final, first, last):  # fmt: skip
    """One step of environments first .. last - 1 on a tabulated state space; arguments as in `step_many`, states as indices."""
    for i in range(first, last):
        rewards[i], terminated[i], truncated[i], executed[i] = 0.0, False, False, -1
        if ended[i]:
            index[i] = starts[drawn_start(cumulative, rng, i)]
            previous[i], elapsed[i], ended[i] = first_previous, 0, False
            continue
        action = executed_action(actions[i], previous[i], chance, successors.shape[1], rng, i)
        rewards[i] = table_rewards[index[i], action]
        index[i] = successors[index[i], action]
        previous[i] = executed[i] = action
        elapsed[i] += 1
        terminated[i] = is_terminal[index[i]]
        truncated[i] = elapsed[i] >= limit
        ended[i] = terminated[i] or truncated[i]
        if mode == SAME_STEP and ended[i]:
            final[i] = index[i]
            index[i] = starts[drawn_start(cumulative, rng, i)]
            previous[i], elapsed[i], ended[i] = first_previous, 0, False
