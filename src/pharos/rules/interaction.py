"""Makers of the kernels of interaction: they call the rules of one class on states that are rows of int64.

As in exploration.py, the variables that the inner functions take from their makers are constants for Numba: the rules;
`Parameters`, the class of `self` in rules; A actions of at most K outcomes. `ranges` (2, D) int64: lowest and highest
value of each component.

A kernel for one environment takes a branch a K + k, outcome k of action a, which `outcome_one` draws before; a kernel
for many draws it itself. Without chance K is 1, so a branch is an action. Branch -1 - a is action a without effect.
"""

from typing import NamedTuple

import numpy as np
from numba import int64

from pharos.kernels.stepping import SAME_STEP, drawn_start, executed_action, has_no_effect, uniform_number
from pharos.rules.compiler import CompiledRules, Compiler, Constructor, Function

Advances = tuple[Function, Function]  # `advance` and `stay`, of `advance_functions`


class InteractionKernels(NamedTuple):
    """Compiled kernels that step and draw; see the makers below."""

    step_one: Function
    outcome_one: Function
    step_and_draw_one: Function
    step_many: Function
    is_terminal_one: Function
    mark_available: Function | None
    draw_simple: Function
    draw_complex: Function
    draw_planes: Function


def interaction(
    compiler: Compiler, rules: CompiledRules, Parameters: Constructor, A: int, K: int = 1, L: int = 0
) -> InteractionKernels:
    """The kernels of a class of environments with A actions of at most K outcomes.

    L: how many layers `draw` has, if the planes of `draw_motion` are to follow; else 0.
    """
    chance = ("probability",) * (K > 1)
    step, drawing = compiler.calling("transition", "is_terminal", "reward", *chance), compiler.calling("draw")
    if L:
        drawing = compiler.calling("draw", "draw_motion")
        rules = {**rules, "draw": draw_all_function(drawing, rules, L)}
    advances = advance_functions(step, rules, K)
    outcome = compiler.calling("transition", *chance)
    drawn_outcome = drawn_outcome_function(outcome, rules, K)
    draw_flat = draw_flat_function(drawing, rules)
    stepped = compiler.calling(*(rule for rule in rules if rule != "draw_motion" or L))
    return InteractionKernels(
        step_one=step_one_kernel(step, Parameters, advances),
        outcome_one=outcome_one_kernel(outcome, Parameters, drawn_outcome),
        step_and_draw_one=step_and_draw_one_kernel(stepped, Parameters, advances, draw_flat),
        step_many=step_many_kernel(step, Parameters, advances, drawn_outcome, A, K),
        is_terminal_one=is_terminal_one_kernel(compiler.calling("is_terminal"), rules, Parameters),
        mark_available=mark_available_kernel(compiler, rules, Parameters) if "is_available" in rules else None,
        draw_simple=draw_simple_kernel(drawing, rules, Parameters, draw_flat),
        draw_complex=draw_complex_kernel(drawing, rules, Parameters),
        draw_planes=draw_planes_kernel(drawing, rules, Parameters),
    )


def advance_functions(compiler: Compiler, rules: CompiledRules, K: int) -> Advances:
    """(advance, stay): one checked step by the rules, and one step by an action without effect."""
    transition, is_terminal, reward = rules["transition"], rules["is_terminal"], rules["reward"]

    @compiler.inlined
    def move_by_action(self, state, branch, next_state):
        transition(self, state, branch, next_state)

    @compiler.inlined
    def move_by_outcome(self, state, branch, next_state):
        transition(self, state, branch // K, branch % K, next_state)

    @compiler.inlined
    def reward_of_pair(self, state, action, next_state, outcome):
        return float(reward(self, state, action, next_state))

    @compiler.inlined
    def reward_of_outcome(self, state, action, next_state, outcome):
        return float(reward(self, state, action, next_state, outcome))

    move, earned = (move_by_action, reward_of_pair) if K == 1 else (move_by_outcome, reward_of_outcome)

    @compiler.inlined
    def advance(self, ranges, state, branch, next_state):
        """Write the successor of `state`; return the reward and 0 (goes on), 1 (terminal) or 2 + i (component i left
        its range).
        """
        for i in range(len(state)):
            next_state[i] = state[i]
        move(self, state, branch, next_state)
        for i in range(len(state)):
            if next_state[i] < ranges[0, i] or next_state[i] > ranges[1, i]:
                return 0.0, 2 + i
        return earned(self, state, branch // K, next_state, branch % K), int64(is_terminal(self, next_state))

    @compiler.inlined
    def stay(self, state, action, next_state):
        """The same of an action without effect: the successor is the state."""
        for i in range(len(state)):
            next_state[i] = state[i]
        return earned(self, state, action, next_state, -1), int64(0)

    return advance, stay


def drawn_outcome_function(compiler: Compiler, rules: CompiledRules, K: int) -> Function:
    """Function that draws an outcome by a number from 0 to 1."""
    if K > 1:
        probability = rules["probability"]

    @compiler.inlined
    def only_outcome(self, state, action, u):
        return 0, 1.0

    @compiler.inlined
    def drawn_outcome(self, state, action, u):
        """(outcome, its probability): the first one with which the probabilities so far are more than u in [0, 1)."""
        number, p, total = 0, 0.0, 0.0
        for outcome in range(K):
            chance = float(probability(self, state, action, outcome))
            if chance > 0.0 and total <= u:  # else an earlier outcome is drawn
                number, p = outcome, chance
                total += chance
        return number, p

    return only_outcome if K == 1 else drawn_outcome


def outcome_one_kernel(compiler: Compiler, Parameters: Constructor, drawn_outcome: Function) -> Function:
    """Kernel that draws the outcome of one step of one environment."""

    @compiler.kernel
    def outcome_one(parameters, state, action, u):
        """(outcome, its probability) of `action` in `state`, by a number u in [0, 1)."""
        return drawn_outcome(Parameters(*parameters), state, action, u)

    return outcome_one


def step_one_kernel(compiler: Compiler, Parameters: Constructor, advances: Advances) -> Function:
    """Kernel of one step of one environment."""
    advance, stay = advances

    @compiler.kernel
    def step_one(parameters, ranges, scale, state, branch, next_state, vector):
        """One step: `advance`, and vector[i] = (next_state[i] - low[i]) * scale[i] if `vector` has room (0 entries:
        not wanted).
        """
        self = Parameters(*parameters)
        if branch < 0:
            value, code = stay(self, state, -1 - branch, next_state)
        else:
            value, code = advance(self, ranges, state, branch, next_state)
        if len(vector) > 0:
            for i in range(len(state)):
                vector[i] = (next_state[i] - ranges[0, i]) * scale[i]
        return value, code

    return step_one


def draw_all_function(compiler: Compiler, rules: CompiledRules, L: int) -> Function:
    """Function that draws a state, and behind its planes the planes of its motion."""
    draw, draw_motion = rules["draw"], rules["draw_motion"]

    @compiler.inlined
    def draw_all(self, state, planes):
        """planes (L + M, rows, columns) uint8, zero."""
        draw(self, state, planes[:L])
        draw_motion(self, state, planes[L:])

    return draw_all


def draw_flat_function(compiler: Compiler, rules: CompiledRules) -> Function:
    """Function that draws a simple image, a pixel for each cell."""
    draw = rules["draw"]

    @compiler.inlined
    def draw_flat(self, state, shades, image):
        """image[l] = shades[l, value of layer l], a pixel for each cell; image (L, rows, columns) uint8, zero."""
        draw(self, state, image)
        layers, rows, columns = image.shape
        for layer in range(layers):
            plane = image[layer].reshape(rows * columns)
            only = shades[layer, 1]
            if only == shades[layer, 255]:  # one kind of thing: no table, so that the loop is vectorized
                for i in range(rows * columns):
                    plane[i] = only if plane[i] != 0 else 0
            else:
                for i in range(rows * columns):
                    plane[i] = shades[layer, plane[i]]

    return draw_flat


def step_and_draw_one_kernel(
    compiler: Compiler, Parameters: Constructor, advances: Advances, draw_flat: Function
) -> Function:
    """Kernel of one step of one environment, and its image."""
    advance, stay = advances

    @compiler.kernel
    def step_and_draw_one(parameters, ranges, state, branch, next_state, shades, image):
        """One step: `advance`, and the simple image of the successor, a pixel for each cell, on planes of their own.

        shades (L, 256) uint8 as in `draw_simple`; image (L, rows, columns) uint8, zero.
        """
        self = Parameters(*parameters)
        if branch < 0:
            value, code = stay(self, state, -1 - branch, next_state)
        else:
            value, code = advance(self, ranges, state, branch, next_state)
        if code <= 1:
            draw_flat(self, next_state, shades, image)
        return value, code

    return step_and_draw_one


def step_many_kernel(
    compiler: Compiler, Parameters: Constructor, advances: Advances, drawn_outcome: Function, A: int, K: int
) -> Function:
    """Kernel of one step of many environments."""
    advance, stay = advances

    @compiler.kernel
    def step_many(parameters, setting, batch, first, last):
        """One step of environments first .. last - 1; return -1, or i * D + c if component c of environment i left
        its range.

        An environment that has `ended` is reset instead (the mode DISABLED never comes here with one); in the mode
        SAME_STEP it is reset at once, and `final` gets its last state. See `kernels.stepping` for Setting and Batch.
        """
        ranges, scale, chance, limit, mode, first_previous, starts, cumulative = setting
        rng, actions, states, previous, elapsed, ended, rewards, terminated, truncated, executed, final = batch[:11]
        vector, probabilities = batch[11:]
        self = Parameters(*parameters)
        length = states.shape[1]
        next_state = np.empty(length, np.int64)
        for i in range(first, last):
            rewards[i], terminated[i], truncated[i], executed[i] = 0.0, False, False, -1
            if K > 1:
                probabilities[i] = 1.0
            # executed action and its outcome, unless the episode is over
            restart = ended[i]
            if not restart:
                action = executed_action(actions[i], previous[i], chance, A, rng, i)
                if has_no_effect(chance, rng, i):
                    value, code = stay(self, states[i], action, next_state)
                    if K > 1:
                        probabilities[i] = chance[4]
                else:
                    branch = action
                    if K > 1:  # nothing is drawn if an action has one outcome
                        outcome, p = drawn_outcome(self, states[i], action, uniform_number(rng, i))
                        probabilities[i] = p * (1.0 - chance[4])
                        branch = action * K + outcome
                    value, code = advance(self, ranges, states[i], branch, next_state)
                if code > 1:
                    executed[i] = action
                    return i * length + code - 2
                # the episode after this step; in SAME_STEP an end is left at once
                rewards[i] = value
                previous[i] = executed[i] = action
                elapsed[i] += 1
                terminated[i] = code == 1
                truncated[i] = elapsed[i] >= limit
                ended[i] = terminated[i] or truncated[i]
                restart = mode == SAME_STEP and ended[i]
                for c in range(length):
                    states[i, c] = next_state[c]
                    if restart:
                        final[i, c] = next_state[c]
            # reset to a start state
            if restart:
                k = drawn_start(cumulative, rng, i)
                for c in range(length):
                    states[i, c] = starts[k, c]
                previous[i], elapsed[i], ended[i] = first_previous, 0, False
            if len(vector) > 0:
                for c in range(length):
                    vector[i, c] = (states[i, c] - ranges[0, c]) * scale[c]
        return -1

    return step_many


def is_terminal_one_kernel(compiler: Compiler, rules: CompiledRules, Parameters: Constructor) -> Function:
    """Kernel of the truth whether one state is terminal."""
    is_terminal = rules["is_terminal"]

    @compiler.kernel
    def is_terminal_one(parameters, state):
        """Whether `state` is terminal."""
        return bool(is_terminal(Parameters(*parameters), state))

    return is_terminal_one


def mark_available_kernel(compiler: Compiler, rules: CompiledRules, Parameters: Constructor) -> Function:
    """Kernel of the sets of actions of many states."""
    is_available, is_terminal = rules["is_available"], rules["is_terminal"]

    @compiler.calling("is_available", "is_terminal").kernel
    def mark_available(parameters, states, out):
        """out[n, a] = whether a is available in states[n]; all are in terminal states."""
        self = Parameters(*parameters)
        for n in range(len(states)):
            ended = is_terminal(self, states[n])
            for a in range(out.shape[1]):
                out[n, a] = ended or is_available(self, states[n], a)

    return mark_available


def draw_simple_kernel(
    compiler: Compiler, rules: CompiledRules, Parameters: Constructor, draw_flat: Function
) -> Function:
    """Kernel of the simple images of many states."""
    draw = rules["draw"]

    @compiler.kernel
    def draw_simple(parameters, states, first, last, planes, shades, covering, out):
        """out[n, l] = shades[l, value of layer l], each cell enlarged to a square, for states first .. last - 1.

        planes (L, rows, columns) uint8 is room to draw; shades (L, 256) uint8; out (N, L or 1, rows k, columns k)
        uint8, zero. With `covering`, all layers go to one plane and later ones cover earlier ones.
        """
        self = Parameters(*parameters)
        layers, rows, columns = planes.shape
        size = out.shape[2] // rows
        for n in range(first, last):
            # a pixel for each cell: drawn on the image itself
            if size == 1 and not covering:
                draw_flat(self, states[n], shades, out[n])
                continue
            # otherwise on planes, then enlarged, later layers over earlier ones
            planes[:] = 0
            draw(self, states[n], planes)
            for layer in range(layers):
                target = 0 if covering else layer
                for row in range(rows):
                    for column in range(columns):
                        shade = shades[layer, planes[layer, row, column]]
                        if shade > 0:
                            for y in range(row * size, (row + 1) * size):
                                for x in range(column * size, (column + 1) * size):
                                    out[n, target, y, x] = shade

    return draw_simple


def draw_complex_kernel(compiler: Compiler, rules: CompiledRules, Parameters: Constructor) -> Function:
    """Kernel of the complex images of many states."""
    draw = rules["draw"]

    @compiler.kernel
    def draw_complex(parameters, states, first, last, planes, picture, top, left, sprite, place, color, keep, out):
        """Lay the sprites of states first .. last - 1 on the ground, later layers over earlier ones.

        picture (height, width, C) uint8: the ground; top (rows + 1,), left (columns + 1,): edges of the cells in
        pixels. sprite (L, rows, 256): number of the sprite of a value of a layer in a row, -1 for none; place (sprites,
        heights, widths): index of its first pixel, for a cell of this height and width, in color (P, C) uint8,
        premultiplied, and keep (P,) uint16: how much of the ground stays, of 256.
        """
        self = Parameters(*parameters)
        layers, rows, columns = planes.shape
        channels = picture.shape[2]
        for n in range(first, last):
            planes[:] = 0
            draw(self, states[n], planes)
            out[n] = picture
            for layer in range(layers):
                for row in range(rows):
                    for column in range(columns):
                        # a sprite, blended with the pixels below it
                        value = planes[layer, row, column]
                        if value == 0 or sprite[layer, row, value] < 0:
                            continue
                        height = top[row + 1] - top[row]
                        width = left[column + 1] - left[column]
                        pixel = place[sprite[layer, row, value], height, width]
                        for y in range(top[row], top[row + 1]):
                            for x in range(left[column], left[column + 1]):
                                stays = keep[pixel]
                                for channel in range(channels):
                                    ground = int64(out[n, y, x, channel]) * stays >> 8
                                    out[n, y, x, channel] = color[pixel, channel] + ground
                                pixel += 1

    return draw_complex


def draw_planes_kernel(compiler: Compiler, rules: CompiledRules, Parameters: Constructor) -> Function:
    """Kernel of the planes that `draw` writes, for many states."""
    draw = rules["draw"]

    @compiler.kernel
    def draw_planes(parameters, states, planes):
        """planes (N, L, rows, columns) uint8, zero, get the drawings of states (N, D)."""
        self = Parameters(*parameters)
        for i in range(len(states)):
            draw(self, states[i], planes[i])

    return draw_planes
