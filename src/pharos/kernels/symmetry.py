"""Symmetries of a deterministic table: maps of the states onto each other under which every action does the same."""

from numba import njit

from pharos.kernels.interpreted import interpreted_first


@interpreted_first("queue")
@njit(cache=True, nogil=True)
def symmetry(next_states, ends, start, s, t, image, preimage, queue):
    """Find the map f with f(s) = t and f(next_states[u, a]) = next_states[f(u), a]; there is at most one.

    All states must be within reach of s. A state that ends the episode is mapped to such a one, the end (-1) to
    itself, and so is `start` where states lead there as they end. image, preimage: (S,), zero before; afterwards, as
    far as queue[:steps], image[u] = f(u) + 1 and preimage[f(u)] = u + 1.
    Returns (whether there is such a map, steps).
    """
    num_states, num_actions = next_states.shape
    image[s], preimage[t], queue[0] = t + 1, s + 1, s
    head, tail, restarts = 0, 1, False
    while head < tail:
        u = queue[head]
        head += 1
        x = image[u] - 1
        if ends[u] != ends[x]:
            return False, tail
        if ends[u]:
            restarts = start >= 0
            continue
        for a in range(num_actions):
            v, y = next_states[u, a], next_states[x, a]
            if v < 0 or y < 0:
                if v != y:
                    return False, tail
                restarts = start >= 0
            elif image[v] == 0 and preimage[y] == 0:
                image[v], preimage[y], queue[tail] = y + 1, v + 1, v
                tail += 1
            elif image[v] != y + 1:
                return False, tail
    return tail == num_states and (not restarts or image[start] == start + 1), tail


@interpreted_first("steps")
@njit(cache=True, nogil=True)
def forget(image, preimage, queue, steps):
    """Zero again, where `symmetry` wrote."""
    for i in range(steps):
        preimage[image[queue[i]] - 1] = 0
        image[queue[i]] = 0


@njit(cache=True, nogil=True)
def join(orbit, image):
    """Make one orbit of the orbits of u and its image, for every u; orbit (S,): a smaller state of the same orbit, or
    itself. Returns how many orbits there are."""
    for u in range(len(orbit)):
        a, b = u, image[u] - 1
        while orbit[a] != a:
            orbit[a] = orbit[orbit[a]]
            a = orbit[a]
        while orbit[b] != b:
            orbit[b] = orbit[orbit[b]]
            b = orbit[b]
        orbit[max(a, b)] = min(a, b)
    count = 0
    for u in range(len(orbit)):
        count += orbit[u] == u
    return count
