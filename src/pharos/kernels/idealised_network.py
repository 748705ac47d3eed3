"""A network that learns by Adam: its outputs of C observations, and the kernels of its output layer and of the rest.

Where a network with output weights w_a and hidden features h is linear in each of them, gradient steps change

    f_a(x) = w_a . h(x),    H(x, y) = h(x) . h(y) + 1,    M_ab = w_a . w_b

by what these are alone. B is the kernel of all layers beneath the output, of an output whose weights have length 1. An
error e (A, C), the derivative of the objective by f, moves f_a by H e_a by the output layer, and by B sum_b M_ab e_b by
the layers beneath. `settled` changes H and M by what has been learnt; a step does not.
Source: pharos; Kingma and Ba (2015) for Adam.
"""

from typing import NamedTuple

import numpy as np

from pharos.kernels.kernel_cache import inlined, kernel


class Net(NamedTuple):
    """Arrays of a network of C observations and A outputs, all float64 but for the kernels.

    Attributes:
        last, beneath: (C, C) float32, H and B.
        gram: (A, A), M.
        outputs: (A, C), f.
        by_last, by_beneath, by_error: (A, C), Adam's mean of H e, B e and e.
        weights, grown: (A, C), what the output weights and the features have moved by since H and M were settled: in
            units of features and of output weights.
        squares: (3,), Adam's mean of the squared gradient of both groups of parameters, and its number of steps.
        error: (A, C), e, 0 but of live observations. first, second: (A, C), H e and B e.
        live: (C + 1,) int64, the observations of an error, and how many they are. is_live: (C,) bool.
    """

    last: np.ndarray
    beneath: np.ndarray
    gram: np.ndarray
    outputs: np.ndarray
    by_last: np.ndarray
    by_beneath: np.ndarray
    by_error: np.ndarray
    weights: np.ndarray
    grown: np.ndarray
    squares: np.ndarray
    error: np.ndarray
    first: np.ndarray
    second: np.ndarray
    live: np.ndarray
    is_live: np.ndarray


@inlined
def add_error(net, a, c, value):
    """e(a, c) += value."""
    if not net.is_live[c]:
        net.is_live[c] = True
        net.live[net.live[-1]] = c
        net.live[-1] += 1
    net.error[a, c] += value


@kernel
def squared_gradients(net):
    """Squared lengths of the error's gradient: (of the output layer, of the layers beneath). Fills first and second."""
    num_outputs, count = net.outputs.shape
    net.first[:] = 0.0
    net.second[:] = 0.0
    for i in range(net.live[-1]):
        c = net.live[i]
        for a in range(num_outputs):
            e = net.error[a, c]
            if e != 0.0:
                for x in range(count):
                    net.first[a, x] += e * net.last[c, x]
                    net.second[a, x] += e * net.beneath[c, x]
    of_last, of_beneath = 0.0, 0.0
    for i in range(net.live[-1]):
        c = net.live[i]
        for a in range(num_outputs):
            e = net.error[a, c]
            if e != 0.0:
                of_last += e * net.first[a, c]
                for b in range(num_outputs):
                    of_beneath += e * net.gram[a, b] * net.second[b, c]
    return max(of_last, 0.0), max(of_beneath, 0.0)


@kernel
def adam_step(net, of_last, of_beneath, share, optimizer):
    """A step of Adam up the error, and forget it. The gradient counts by a share, to which it was clipped.

    optimizer: (learning rate, epsilon, decay of the mean, decay of the mean square, parameters of both groups: two
    numbers, mean size of a parameter's gradient as a share of its root mean square: two numbers).
    """
    rate, epsilon, decay, decay_of_squares, last_size, beneath_size, last_evenness, beneath_evenness = optimizer
    num_outputs, count = net.outputs.shape
    squares = net.squares
    squares[0] = decay_of_squares * squares[0] + (1 - decay_of_squares) * share * share * of_last
    squares[1] = decay_of_squares * squares[1] + (1 - decay_of_squares) * share * share * of_beneath
    squares[2] += 1.0
    unbiased = 1 - decay_of_squares ** squares[2]
    step = rate / (1 - decay ** squares[2])
    last_step = step * last_evenness / (np.sqrt(squares[0] / unbiased / last_size) + epsilon)
    beneath_step = step * beneath_evenness / (np.sqrt(squares[1] / unbiased / beneath_size) + epsilon)
    new = (1 - decay) * share
    for a in range(num_outputs):
        for x in range(count):
            net.by_last[a, x] = decay * net.by_last[a, x] + new * net.first[a, x]
            net.by_beneath[a, x] = decay * net.by_beneath[a, x] + new * net.second[a, x]
            net.by_error[a, x] = decay * net.by_error[a, x] + new * net.error[a, x]
            net.outputs[a, x] += last_step * net.by_last[a, x]
            net.weights[a, x] += last_step * net.by_error[a, x]
            net.grown[a, x] += beneath_step * net.by_beneath[a, x]
    for a in range(num_outputs):
        for b in range(num_outputs):
            m = beneath_step * net.gram[a, b]
            for x in range(count):
                net.outputs[a, x] += m * net.by_beneath[b, x]
    for i in range(net.live[-1]):
        c = net.live[i]
        net.is_live[c] = False
        for a in range(num_outputs):
            net.error[a, c] = 0.0
    net.live[-1] = 0


@kernel
def move_kernel(last, left, right, shrunk, root, least):
    """H += left' right + right' left, times shrunk(x) shrunk(y), held to +- root(x) root(y), H(x, x) to `least`.

    All of them float32. One pass over H, which remains symmetric to the last bit.
    """
    num_outputs, count = left.shape
    for x in range(count):
        row = last[x]
        for a in range(num_outputs):
            for y in range(count):
                row[y] += left[a, x] * right[a, y] + right[a, x] * left[a, y]
        for y in range(count):
            bound = root[x] * root[y]
            row[y] = min(max(row[y] * (shrunk[x] * shrunk[y]), -bound), bound)
        row[x] = max(row[x], least)  # a bias alone is 1
