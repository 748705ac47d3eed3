"""Observations by the components of a block of states alone, without rules, and tangent kernels of observations.

Neural tangent kernels of one block of pairs (x, y) of observations, I times J of them: q: covariance of the
pre-activations of a layer. theta: its tangent kernel. variance_x (I,), variance_y (J,): q of x with itself. Of a ReLU,
E[f(u) f(v)] and E[f'(u) f'(v)] are arc-cosine kernels (Cho and Saul, 2009). Of a hyperbolic tangent they are power
series in the correlation, made of Hermite coefficients (Daniely, Frostig and Singer, 2016).
"""

import math

import numpy as np

from pharos.kernels.kernel_cache import kernel


@kernel
def first_beyond_ranges(states, low, size):
    """The first n with a component of states (N, D) outside of low[i] .. low[i] + size[i] - 1, or -1."""
    for n in range(states.shape[0]):
        for i in range(states.shape[1]):
            if states[n, i] < low[i] or states[n, i] >= low[i] + size[i]:
                return n
    return -1


@kernel
def normalize(states, low, scale, out):
    """out[n, i] = (states[n, i] - low[i]) * scale[i] for the first D columns of out (N, D or more) float32."""
    for n in range(states.shape[0]):
        for i in range(states.shape[1]):
            out[n, i] = (states[n, i] - low[i]) * scale[i]


@kernel
def mark_components(states, low, offset, out):
    """out[n, offset[i] + states[n, i] - low[i]] = 1 for every component i."""
    for n in range(states.shape[0]):
        for i in range(states.shape[1]):
            out[n, offset[i] + states[n, i] - low[i]] = 1


@kernel(inline="always")
def _mixed_word(word):
    """Mix the bits of a word by the finalizer of SplitMix64 (Steele, Lea and Flood, 2014)."""
    word = (word ^ (word >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    word = (word ^ (word >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return word ^ (word >> np.uint64(31))


@kernel
def scramble(states, low, lengths, keys, out):
    """out (N, B), zeros: the components of each state in binary, permuted by a Feistel network of len(keys) rounds."""
    one, step = np.uint64(1), np.uint64(0x9E3779B97F4A7C15)
    num_bits, half = out.shape[1], out.shape[1] // 2
    for n in range(states.shape[0]):
        # the components in binary, the lowest bit of each first
        index = 0
        for i in range(states.shape[1]):
            for b in range(lengths[i]):
                out[n, index] = ((states[n, i] - low[i]) >> b) & 1
                index += 1
        for r in range(len(keys)):
            # a hash of one half and the key of the round
            first, last = (0, half) if r % 2 == 0 else (half, num_bits)
            word = keys[r]
            for index in range(first, last):
                word = _mixed_word(word + step + np.uint64(out[n, index]))
            # flips bits of the other half: a new word for every 64 of them
            begin, end = (half, num_bits) if r % 2 == 0 else (0, half)
            mask = word
            for index in range(begin, end):
                if (index - begin) % 64 == 0:
                    word += step
                    mask = _mixed_word(word)
                out[n, index] ^= np.int8(mask & one)
                mask >>= one


# Tangent kernels ------------------------------------------------------------------------------------------------------


RELU, TANH = 0, 1


@kernel(inline="always")
def _relu(q, scale):
    """(E[f(u) f(v)], E[f'(u) f'(v)]) of a centred Gaussian pair of covariance q. scale: product of the deviations."""
    if scale <= 0.0:
        return 0.0, 0.0
    cosine = min(max(q / scale, -1.0), 1.0)
    angle = math.pi - math.acos(cosine)
    return scale * (math.sqrt(1.0 - cosine * cosine) + angle * cosine) / (2 * math.pi), angle / (2 * math.pi)


@kernel(inline="always")
def _series(q, scale, a, b):
    """(E[f(u) f(v)], E[f'(u) f'(v)]) of an odd function, by its Hermite coefficients a, b (M,) of degree 1, 3, 5, ...

    a, b: at the deviations of u and v. q: their covariance. scale: product of the deviations.
    """
    correlation = min(max(q / scale, -1.0), 1.0) if scale > 0.0 else 0.0
    power, value, slope = 1.0, 0.0, 0.0
    for m in range(len(a)):
        product = a[m] * b[m] * power
        slope += (2 * m + 1) * product
        value += product * correlation
        power *= correlation * correlation
    return value, slope / scale if scale > 0.0 else a[0] * b[0]


@kernel
def dense(
    q, theta, variances_x, variances_y, kinds, coefficients_x, coefficients_y, widths, weights, biases, of_outputs, out
):
    """out (I, J) = the tangent kernel of the output of dense layers, or the covariance of outputs if `of_outputs`.

    q, theta (I, J): of the first hidden layer. variances_x (L, I), variances_y (L, J): of all hidden layers.
    kinds (L,): RELU or TANH. coefficients_x (L, I, M), coefficients_y: of TANH. widths (L,): units. weights, biases
    (L,): variances of an entry of the following layer.
    """
    layers = len(widths)
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            covariance, tangent = q[i, j], theta[i, j]
            for layer in range(layers):
                # covariances of the layer's outputs and of their derivatives, then the next layer's kernel
                scale = math.sqrt(variances_x[layer, i] * variances_y[layer, j])
                if kinds[layer] == 0:
                    value, slope = _relu(covariance, scale)
                else:
                    value, slope = _series(covariance, scale, coefficients_x[layer, i], coefficients_y[layer, j])
                inner = widths[layer] * value
                tangent = inner + 1.0 + weights[layer] * widths[layer] * slope * tangent
                covariance = weights[layer] * inner + biases[layer]
            out[i, j] = covariance if of_outputs else tangent


@kernel
def patches(gram, codes_x, codes_y, variance_x, variance_y, weight, bias, value, slope):
    """One position of a first convolution with ReLUs: value (I, J) = E[f f], slope (I, J) = E[f' f'] (gram + 1).

    gram (U, V): inner products of the different patches. codes_x (I,), codes_y (J,): the patch that x and y have there.
    variance_x (U,), variance_y (V,): of the different patches. weight, bias: variances of an entry.
    """
    # each pair of different patches once
    values, slopes = np.empty(gram.shape, np.float32), np.empty(gram.shape, np.float32)
    for u in range(gram.shape[0]):
        for v in range(gram.shape[1]):
            scale = math.sqrt(variance_x[u] * variance_y[v])
            mean, derivative = _relu(weight * gram[u, v] + bias, scale)
            values[u, v] = mean
            slopes[u, v] = derivative * (gram[u, v] + 1.0)
    # then by the patches of x and y
    for i in range(len(codes_x)):
        for j in range(len(codes_y)):
            value[i, j] = values[codes_x[i], codes_y[j]]
            slope[i, j] = slopes[codes_x[i], codes_y[j]]


@kernel
def gathered(value, slope, taps, filters, weight, bias, q, theta):
    """q, theta (I, J) of a unit that sees some positions of a convolution of `filters` filters: value, slope (P, I, J).

    taps: indices of the positions, -1 for padding. weight, bias: variances of an entry of this unit.
    """
    q[:] = 0.0
    theta[:] = 0.0
    for p in taps:
        if p >= 0:
            for i in range(q.shape[0]):
                for j in range(q.shape[1]):
                    q[i, j] += value[p, i, j]
                    theta[i, j] += slope[p, i, j]
    for i in range(q.shape[0]):
        for j in range(q.shape[1]):
            inner = filters * q[i, j]
            theta[i, j] = inner + 1.0 + weight * filters * theta[i, j]
            q[i, j] = weight * inner + bias


@kernel
def rectified(q, theta, variance_x, variance_y, value, slope):
    """value (I, J) = E[f f], slope (I, J) = E[f' f'] theta of ReLUs at covariance q (I, J)."""
    for i in range(q.shape[0]):
        for j in range(q.shape[1]):
            mean, derivative = _relu(q[i, j], math.sqrt(variance_x[i] * variance_y[j]))
            value[i, j] = mean
            slope[i, j] = derivative * theta[i, j]


@kernel
def mirrored(square):
    """Copy the upper triangle of square (N, N) to the lower one."""
    for i in range(square.shape[0]):
        for j in range(i):
            square[i, j] = square[j, i]
