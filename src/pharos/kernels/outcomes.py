"""What executing an action may lead to, for loops that do not ask how it is stored.

Kernels take `transitions`, one of two things:

- a table (S, A) of next states, -1 where the episode ends;
- several outcomes, as a tuple (successors (N,), offsets, codes, weights, (S, A, K)) that `OutcomeTable` makes. The
  outcomes of (s, a), row = s A + a, are successors[row K : (row + 1) K], or successors[offsets[row] : offsets[row + 1]]
  where there are offsets. Their probabilities are weights[codes[row]], or, without codes, weights at the same places as
  the successors. Of a row without offsets the last ones may have probability 0: they repeat its first successor.

`outcomes_of` and `outcome` give them one by one, `expectation` adds up values. The compiler knows which of the two it
has, so loops over tables cost nothing more.
"""

from numba import njit, types
from numba.extending import overload


def size_of(transitions):
    """(S, A)."""


@overload(size_of)
def _size_of(transitions):
    if isinstance(transitions, types.Array):
        return lambda transitions: transitions.shape
    return lambda transitions: (transitions[4][0], transitions[4][1])


def outcomes_of(transitions, s, a):
    """The range of numbers of the outcomes of (s, a)."""


@overload(outcomes_of)
def _outcomes_of(transitions, s, a):
    if isinstance(transitions, types.Array):
        return lambda transitions, s, a: range(1)
    if isinstance(transitions[1], types.NoneType):

        def dense(transitions, s, a):
            first = (s * transitions[4][1] + a) * transitions[4][2]
            return range(first, first + transitions[4][2])

        return dense

    def ragged(transitions, s, a):
        row = s * transitions[4][1] + a
        return range(transitions[1][row], transitions[1][row + 1])

    return ragged


def outcome(transitions, s, a, i):
    """(next state, -1 for the end; probability) of the outcome with number i."""


@overload(outcome)
def _outcome(transitions, s, a, i):
    if isinstance(transitions, types.Array):
        return lambda transitions, s, a, i: (transitions[s, a], 1.0)
    if isinstance(transitions[2], types.NoneType):
        return lambda transitions, s, a, i: (transitions[0][i], transitions[3][i])
    if isinstance(transitions[1], types.NoneType):

        def dense(transitions, s, a, i):
            row = s * transitions[4][1] + a
            return transitions[0][i], transitions[3][transitions[2][row], i - row * transitions[4][2]]

        return dense

    def ragged(transitions, s, a, i):
        row = s * transitions[4][1] + a
        return transitions[0][i], transitions[3][transitions[2][row], i - transitions[1][row]]

    return ragged


def expectation(transitions, v, s, a):
    """The mean of v (S + 1,) over what (s, a) leads to; -1 reads the last entry."""


@overload(expectation)
def _expectation(transitions, v, s, a):
    if isinstance(transitions, types.Array):
        return lambda transitions, v, s, a: v[transitions[s, a]]

    def several(transitions, v, s, a):
        total = 0.0
        for i in outcomes_of(transitions, s, a):
            t, p = outcome(transitions, s, a, i)
            total += p * v[t]
        return total

    return several


def expectation_of_pair(transitions, v, s, a):
    """The mean of v (S + 1, A) at a over what (s, a) leads to; -1 reads the last row."""


@overload(expectation_of_pair)
def _expectation_of_pair(transitions, v, s, a):
    if isinstance(transitions, types.Array):
        return lambda transitions, v, s, a: v[transitions[s, a], a]

    def several(transitions, v, s, a):
        total = 0.0
        for i in outcomes_of(transitions, s, a):
            t, p = outcome(transitions, s, a, i)
            total += p * v[t, a]
        return total

    return several


@njit(cache=True, nogil=True)
def expected(transitions, x, states, out):
    """out[i, a] = the mean of x (S + 1, W, M) over what (states[i], a) leads to; W = A by executed action, or 1.

    Outcomes that are impossible do not count, whatever x says there.
    """
    by_action = x.shape[1] > 1
    out[:] = 0.0
    for i in range(len(states)):
        for a in range(out.shape[1]):
            for j in outcomes_of(transitions, states[i], a):
                t, p = outcome(transitions, states[i], a, j)
                if p > 0.0:
                    for m in range(x.shape[2]):
                        out[i, a, m] += p * x[t, a if by_action else 0, m]


@njit(cache=True, nogil=True)
def pushed(transitions, mass, out):
    """out (S, W) += where the mass (S, A) of executed actions goes, without what ends."""
    by_action = out.shape[1] > 1
    for s in range(mass.shape[0]):
        for a in range(mass.shape[1]):
            if mass[s, a] != 0.0:
                for i in outcomes_of(transitions, s, a):
                    t, p = outcome(transitions, s, a, i)
                    if t >= 0:
                        out[t, a if by_action else 0] += p * mass[s, a]


@njit(cache=True, nogil=True)
def have_one_outcome(transitions):
    """Whether every (s, a) has one outcome, of probability 1."""
    num_states, num_actions = size_of(transitions)
    for s in range(num_states):
        for a in range(num_actions):
            for i in outcomes_of(transitions, s, a):
                if outcome(transitions, s, a, i)[1] != 1.0:
                    return False
                break
    return True
