"""The small convolution and the linear layer behind it, on pictures that repeat themselves, of W networks.

A patch is a pixel with its eight neighbours. Pictures of worlds have few different ones at a pixel: in a minibatch of
128 Breakouts of 24 x 8 there are four. So the pictures of a minibatch are put into groups by their patch at each pixel
p, and the two layers and their gradients are computed once for each group g, not for each picture:

    h_g = max(0, patch_g K + k),   z_b = c + sum_p W_p h_g(b, p),   dz_g = sum of dz_b over b in g
    dW_p = sum_g h_g dz_g,   dh_g = W_p' dz_g if h_g > 0,   dK = sum_g patch_g dh_g

A patch that is met at several pixels is convolved once, as the sum of what each of its nine colours gives at its place.
There are few colours, so K is applied to each of them once a place. It is the same sum in another order, not an
approximation.

Cost: with G groups at all pixels together 3 * 16 G outputs multiplications, in place of 3 * 16 B pixels outputs.
"""

import numpy as np
from numba import float32, uint64

from pharos.kernels.kernel_cache import kernel

FILTERS = 16
PATCH_PLACES = 9  # pixels of a patch
COLOUR_BITS = 7  # of a key, for the colour at one place
COLOURS = 127  # that fit into seven bits, beside what is outside
RECENT = 1024  # entries for patches that have been convolved
SCATTER = 0x9E3779B97F4A7C15


@kernel
def _is_alike(one, pixel, other, at, channels, pixels):
    """Whether a pixel of one picture has the colour of one of another. pictures: (C pixels,)."""
    for c in range(channels):
        if one[uint64(c * pixels + pixel)] != other[uint64(c * pixels + at)]:
            return False
    return True


@kernel
def patch_keys(pictures, shape, keys, colours):
    """keys (pixels, B) int64: equal if patches are. pictures (B, C pixels), shape (C, H, W).

    Seven bits for the number of each of nine colours. colours (COLOURS + 1, C): written, 0 for what is outside.
    Return how many there are, or -1 if they are more than COLOURS. Then all keys differ.
    """
    channels, height, width = shape
    pixels, count = height * width, 0
    colours[0] = 0.0
    origin = np.empty((COLOURS + 1, 2), np.int64)  # (picture, pixel) of each colour, by its number
    codes, rows = np.zeros((height + 2, width + 2), np.int64), np.empty((height + 2, width), np.int64)
    for b in range(len(pictures)):
        picture, code = pictures[b], 0
        for y in range(height):
            for x in range(width):
                pixel = y * width + x
                if code == 0 or not _is_alike(picture, pixel, picture, pixel - 1, channels, pixels):
                    code = 1
                    while code <= count and not _is_alike(
                        picture, pixel, pictures[origin[code, 0]], origin[code, 1], channels, pixels
                    ):
                        code += 1
                    if code > COLOURS:
                        keys[:] = np.arange(keys.size).reshape(keys.shape)
                        return -1
                    if code > count:
                        count, origin[code, 0], origin[code, 1] = code, b, pixel
                        for c in range(channels):
                            colours[code, c] = picture[c * pixels + pixel]
                codes[y + 1, x + 1] = code
        for y in range(height + 2):
            for x in range(width):
                rows[y, x] = codes[y, x] | codes[y, x + 1] << COLOUR_BITS | codes[y, x + 2] << 2 * COLOUR_BITS
        for y in range(height):
            for x in range(width):
                keys[y * width + x, b] = (
                    rows[y, x] | rows[y + 1, x] << 3 * COLOUR_BITS | rows[y + 2, x] << 6 * COLOUR_BITS
                )
    return count


@kernel
def _grouped(keys, members, samples, slots):
    """Put B pictures into groups by their keys (B,) at a pixel. Return the number of groups.

    members (B,): the group of each picture. samples: a picture of each group.
    slots: (keys, groups) of a hash table, all -1 before and after, and (B,) indices of it that are in use.
    """
    slot_keys, slot_groups, used = slots
    mask, count = uint64(len(slot_keys) - 1), 0
    for b in range(len(keys)):
        slot = (uint64(keys[b]) * uint64(SCATTER)) >> uint64(40) & mask
        while slot_groups[slot] >= 0 and slot_keys[slot] != keys[b]:
            slot = (slot + uint64(1)) & mask
        if slot_groups[slot] < 0:
            slot_keys[slot], slot_groups[slot] = keys[b], count
            samples[count], used[count] = b, slot
            count += 1
        members[b] = slot_groups[slot]
    for i in range(count):
        slot_groups[used[i]] = -1
    return count


@kernel(fastmath={"contract"})
def _apply(kernel, colours, count, table):
    """table (9, COLOURS + 1, 16): K (9 C, 16) at each place of a patch times no colour and the first `count` ones."""
    for place in range(PATCH_PLACES):
        for code in range(count + 1):
            row = table[place, code]
            row[:] = 0.0
            for c in range(colours.shape[1]):
                value = colours[code, c]
                if value != 0.0:
                    weights = kernel[c * PATCH_PLACES + place]
                    for f in range(FILTERS):
                        row[f] += value * weights[f]


@kernel
def _code(key, place):
    """The number of the colour at a place of a patch. key: uint64."""
    return key >> uint64(COLOUR_BITS * place) & uint64(COLOURS)


@kernel
def _convolve_colours(key, table, bias, hidden):
    """hidden (16,) = max(0, patch K + k) of a patch by its key. table: of `_apply`."""
    codes = uint64(key)
    t0, t1, t2 = table[0, _code(codes, 0)], table[1, _code(codes, 1)], table[2, _code(codes, 2)]
    t3, t4, t5 = table[3, _code(codes, 3)], table[4, _code(codes, 4)], table[5, _code(codes, 5)]
    t6, t7, t8 = table[6, _code(codes, 6)], table[7, _code(codes, 7)], table[8, _code(codes, 8)]
    for f in range(FILTERS):
        total = bias[f] + t0[f] + t1[f] + t2[f] + t3[f] + t4[f] + t5[f] + t6[f] + t7[f] + t8[f]
        hidden[f] = max(total, float32(0.0))


@kernel(fastmath={"contract"})
def _convolve(picture, neighbours, kernel, bias, part, hidden):
    """The same bits, of a patch by the indices (9 C,) of its neighbours in the picture, beyond its end if none.

    part (16,): what one place gives.
    """
    for f in range(FILTERS):
        hidden[f] = bias[f]
    for place in range(PATCH_PLACES):
        part[:] = 0.0
        for k in range(place, len(neighbours), PATCH_PLACES):
            value = picture[neighbours[k]] if neighbours[k] < len(picture) else float32(0.0)
            if value != 0.0:
                row = kernel[k]
                for f in range(FILTERS):
                    part[f] += value * row[f]
        for f in range(FILTERS):
            hidden[f] += part[f]
    for f in range(FILTERS):
        hidden[f] = max(hidden[f], float32(0.0))


@kernel
def _live(values, at):
    """Write to `at` the indices of the values (n,) other than 0. Return their number."""
    count = 0
    for k in range(len(values)):
        at[count] = k
        count += values[k] != 0.0
    return count


@kernel(fastmath={"contract"})
def _combine(factors, rows, at, count, out):
    """out (outputs,) = the sum of factors times rows (n, outputs) over the `count` first indices `at`."""
    out[:] = 0.0
    blocks = count // 4 * 4
    for k in range(0, blocks, 4):
        a0, a1, a2, a3 = factors[at[k]], factors[at[k + 1]], factors[at[k + 2]], factors[at[k + 3]]
        r0, r1, r2, r3 = rows[at[k]], rows[at[k + 1]], rows[at[k + 2]], rows[at[k + 3]]
        for j in range(len(out)):
            out[j] += a0 * r0[j] + a1 * r1[j] + a2 * r2[j] + a3 * r3[j]
    for k in range(blocks, count):
        factor, row = factors[at[k]], rows[at[k]]
        for j in range(len(out)):
            out[j] += factor * row[j]


@kernel
def _spread(products, members, total):
    """Add products (G, outputs) of groups to total (B, outputs) of their members (B,)."""
    for b in range(len(members)):
        row, target = products[uint64(members[b])], total[b]
        for j in range(len(row)):
            target[j] += row[j]


@kernel
def _sum_members(dy, members, dz):
    """dz (G, outputs) = the sum of dy (B, outputs) over the members of each group."""
    dz[:] = 0.0
    for b in range(len(members)):
        row, target = dy[b], dz[uint64(members[b])]
        for j in range(len(row)):
            target[j] += row[j]


@kernel
def _parts(row, offsets, neighbours, pixels, outputs):
    """Kernel (9 C, 16), its bias (16,), weight (16 pixels, outputs) and its bias (outputs,) as views of a row (P,)."""
    kernel = row[offsets[0] : offsets[0] + neighbours * FILTERS].reshape(neighbours, FILTERS)
    weight = row[offsets[2] : offsets[2] + pixels * FILTERS * outputs].reshape(pixels * FILTERS, outputs)
    return kernel, row[offsets[1] : offsets[1] + FILTERS], weight, row[offsets[3] : offsets[3] + outputs]


@kernel
def forward(parameters, offsets, shape, indices, x, y, memory):
    """y (W, B, outputs) = max(0, z) of pictures x, for each row of parameters (W, P).

    offsets: of kernel, its bias, weight and its bias in a row. shape: (C, H, W). indices (pixels, 9 C): of neighbours
    in a picture. x (W, pitch): B pictures of C H W numbers from 0 to 255 each, one after another.
    memory, written for `backward`: (begins (W, pixels + 1), the first group of each pixel; samples, owners, codes (W, B
    pixels), a picture of each group, the group whose patch is the same, and the key; hidden (W, B pixels, 16);
    members (W, pixels, B), the group of each picture, counted from the pixel's first; counts (W,) and colours (W,
    COLOURS + 1, C) of `patch_keys`).
    """
    begins, samples, owners, codes, hidden, members, counts, colours = memory
    number, pixels, outputs, size = y.shape[1], len(indices), y.shape[2], shape[0] * len(indices)
    keys, products = np.empty((pixels, number), np.int64), np.empty((number, outputs), np.float32)
    room = 2
    while room < 2 * number:
        room *= 2
    slots = np.empty(room, np.int64), np.full(room, -1, np.int64), np.empty(number, np.int64)
    recent_keys, recent, live = np.empty(RECENT, np.int64), np.empty(RECENT, np.int64), np.empty(FILTERS, np.uint64)
    table, part = np.empty((PATCH_PLACES, COLOURS + 1, FILTERS), np.float32), np.empty(FILTERS, np.float32)
    for i in range(len(parameters)):
        pictures, total = x[i, : number * size].reshape(number, size), y[i]
        kernel, of_kernel, weight, bias = _parts(parameters[i], offsets, indices.shape[1], pixels, outputs)
        kernel = kernel * float32(1 / 255)
        counts[i] = patch_keys(pictures, shape, keys, colours[i])
        _apply(kernel, colours[i], counts[i], table)
        total[:], recent[:] = bias, -1
        first = 0
        for p in range(pixels):
            end = first + _grouped(keys[p], members[i, p], samples[i, first:], slots)
            begins[i, p + 1] = end
            for g in range(first, end):
                key = keys[p, samples[i, g]]
                slot = (uint64(key) * uint64(SCATTER)) >> uint64(54)
                if recent[slot] >= 0 and recent_keys[slot] == key:
                    owners[i, g] = recent[slot]
                    hidden[i, g] = hidden[i, recent[slot]]
                else:
                    owners[i, g] = recent[slot] = g
                    recent_keys[slot], codes[i, g] = key, key
                    if counts[i] < 0:
                        _convolve(pictures[samples[i, g]], indices[p], kernel, of_kernel, part, hidden[i, g])
                    else:
                        _convolve_colours(key, table, of_kernel, hidden[i, g])
            w = weight[p * FILTERS : (p + 1) * FILTERS]
            for g in range(first, end):
                _combine(hidden[i, g], w, live, _live(hidden[i, g], live), products[g - first])
            _spread(products, members[i, p], total)
            first = end
        for b in range(number):
            for j in range(outputs):
                total[b, j] = max(total[b, j], float32(0.0))


@kernel(fastmath={"reassoc", "contract"})
def _dots(rows, vector, at, count, out):
    """out (n,) = rows (n, outputs) times a vector (outputs,) at the `count` first indices `at`, elsewhere 0."""
    out[:] = 0.0
    for k in range(0, count, 4):
        # up to three indices twice, at the end
        f0, f1, f2, f3 = at[k], at[min(k + 1, count - 1)], at[min(k + 2, count - 1)], at[min(k + 3, count - 1)]
        r0, r1, r2, r3 = rows[f0], rows[f1], rows[f2], rows[f3]
        s0, s1, s2, s3 = float32(0.0), float32(0.0), float32(0.0), float32(0.0)
        for j in range(len(vector)):
            s0 += r0[j] * vector[j]
            s1 += r1[j] * vector[j]
            s2 += r2[j] * vector[j]
            s3 += r3[j] * vector[j]
        out[f0], out[f1], out[f2], out[f3] = s0, s1, s2, s3


@kernel(fastmath={"contract"})
def _add_patch(picture, neighbours, dh, of_kernel):
    """Add a patch (9 C,) times dh (16,) to the gradient of the kernel (9 C, 16)."""
    for k in range(len(neighbours)):
        value = picture[neighbours[k]] if neighbours[k] < len(picture) else float32(0.0)
        if value != 0.0:
            row = of_kernel[k]
            for f in range(FILTERS):
                row[f] += value * dh[f]


@kernel
def _add_to_colours(key, dh, table):
    """Add dh (16,) of a patch to the gradient of the table of `_apply`, by its key."""
    for place in range(PATCH_PLACES):
        row = table[place, _code(uint64(key), place)]
        for f in range(FILTERS):
            row[f] += dh[f]


@kernel(fastmath={"contract"})
def _add_colours(table, colours, count, of_kernel):
    """Add to the gradient of the kernel (9 C, 16) what the gradient of the table of `_apply` gives."""
    for place in range(PATCH_PLACES):
        for code in range(1, count + 1):
            for c in range(colours.shape[1]):
                value, row = colours[code, c], of_kernel[c * PATCH_PLACES + place]
                if value != 0.0:
                    for f in range(FILTERS):
                        row[f] += value * table[place, code, f]


@kernel
def backward(parameters, gradients, offsets, shape, indices, x, dy, memory):
    """Write the gradients (W, P) of the four parameters. dy (W, B, outputs): of z, before the activation.

    Everything else as `forward` has it.
    """
    begins, samples, owners, codes, hidden, members, counts, colours = memory
    number, pixels, outputs, size = dy.shape[1], len(indices), dy.shape[2], shape[0] * len(indices)
    dz, dh = np.empty((number, outputs), np.float32), np.empty((number * pixels, FILTERS), np.float32)
    live, table = np.empty(max(number, FILTERS), np.uint64), np.empty((PATCH_PLACES, COLOURS + 1, FILTERS), np.float32)
    for i in range(len(parameters)):
        pictures = x[i, : number * size].reshape(number, size)
        weight = _parts(parameters[i], offsets, indices.shape[1], pixels, outputs)[2]
        of_kernel, of_its_bias, of_weight, of_bias = _parts(gradients[i], offsets, indices.shape[1], pixels, outputs)
        of_kernel[:], of_its_bias[:], of_bias[:] = 0.0, 0.0, 0.0
        for b in range(number):
            for j in range(outputs):
                of_bias[j] += dy[i, b, j]
        for p in range(pixels):
            first, end, rows = begins[i, p], begins[i, p + 1], slice(p * FILTERS, (p + 1) * FILTERS)
            dz_of = dz[: end - first]
            _sum_members(dy[i], members[i, p], dz_of)
            h, w, dw = hidden[i, first:end], weight[rows], of_weight[rows]
            for f in range(FILTERS):
                _combine(h[:, f], dz_of, live, _live(h[:, f], live), dw[f])
            for g in range(first, end):
                _dots(w, dz_of[g - first], live, _live(h[g - first], live), dh[g])
                if owners[i, g] != g:
                    dh[owners[i, g]] += dh[g]
        table[:, : counts[i] + 1] = 0.0
        for p in range(pixels):
            for g in range(begins[i, p], begins[i, p + 1]):
                if owners[i, g] == g:
                    for f in range(FILTERS):
                        of_its_bias[f] += dh[g, f]
                    if counts[i] < 0:
                        _add_patch(pictures[samples[i, g]], indices[p], dh[g], of_kernel)
                    else:
                        _add_to_colours(codes[i, g], dh[g], table)
        _add_colours(table, colours[i], counts[i], of_kernel)
        for k in range(len(of_kernel)):
            for f in range(FILTERS):
                of_kernel[k, f] *= float32(1 / 255)
