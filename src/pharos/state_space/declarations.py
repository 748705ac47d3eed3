"""What `check_environment` demands of the declarations of a class: attributes, variables, start states, layers."""

import contextlib
import json
import numbers
import operator
from collections.abc import Iterator, Sequence
from typing import Any

from pharos.drawing import ground_of, shape_of
from pharos.environments import Environment, Layer, start_distribution
from pharos.errors import ParameterError, RuleError, UnknownName

SPRITE_LETTERS = set(".#123456789")


def check_declarations(env: Environment) -> None:
    """RuleError where an attribute, the parameters, the variables or the start states are not as the contract says."""
    cls = type(env)
    whose = cls.__name__
    parameters = getattr(cls, "__dataclass_params__", None)
    if parameters is None or not parameters.frozen or "__dataclass_params__" not in vars(cls):
        raise RuleError(f"{whose} is no frozen dataclass; decorate it with @dataclass(frozen=True, kw_only=True)")
    name = getattr(env, "name", None)
    if not isinstance(name, str) or not name:
        raise RuleError(f"{whose}.name is {name!r}; expected the name that users type, a text")
    actions = getattr(env, "actions", None)
    if (
        not isinstance(actions, tuple)
        or not actions
        or not all(isinstance(action, str) and action for action in actions)
        or len(set(actions)) < len(actions)
    ):
        raise RuleError(f"{whose}.actions is {actions!r}; expected a tuple of different names, at least one")
    for attribute in ("version", "max_episode_steps"):
        value = getattr(env, attribute)
        if not isinstance(value, numbers.Integral) or isinstance(value, bool) or value < 1:
            raise RuleError(f"{env}: {attribute} is {value!r}; expected an integer of at least 1")
    _ = env.has_chance  # which looks at `outcomes`
    try:
        again = cls(**json.loads(json.dumps(env.parameters, allow_nan=False)))
    except (TypeError, ValueError) as error:
        raise RuleError(
            f"{env}: its parameters do not survive JSON ({error}); expected numbers, texts, None and tuples of these"
        ) from error
    if again != env:
        raise RuleError(
            f"{env}: read back from JSON it is {again}; expected an equal instance (JSON turns tuples into lists: "
            f"turn them back in validate, with object.__setattr__)"
        )
    try:
        components = env.components
        starts = start_distribution(env)
        again_starts = start_distribution(env)
    except ParameterError as error:
        raise RuleError(str(error)) from error
    if len(env.variables()) != len(components.variables):
        raise RuleError(f"{env}: variables() declares {len(env.variables())} names; expected the same at every call")
    if starts[0] != again_starts[0] or (starts[1] != again_starts[1]).any():
        raise RuleError(f"{env}: initial_states() differs from call to call; expected always the same")


def check_layers(env: Environment, notes: list[str]) -> None:
    """RuleError where a layer or the grid is not as the contract says; a note where there are no layers."""
    whose = type(env).__name__
    if not isinstance(env.layers, dict) or not all(isinstance(name, str) for name in env.layers):
        raise RuleError(f"{whose}.layers is {env.layers!r}; expected a dict of name -> Layer")
    if not env.layers:
        notes.append("it declares no layers: it cannot be drawn, and has no image observations")
        return
    for name, layer in env.layers.items():
        _check_layer(f"{whose}.layers[{name!r}]", name, layer)
    motion = env.motion_layers
    names = set(motion) if isinstance(motion, dict) else set()
    if bool(names) != env.has_motion or names & set(env.layers):
        raise RuleError(
            f"{whose}.motion_layers is {motion!r}; expected a dict of name -> Layer, with other names than layers, "
            f"where the class defines draw_motion, and {{}} elsewhere"
        )
    for name, layer in motion.items():
        _check_layer(f"{whose}.motion_layers[{name!r}]", name, layer)
    for place, look in (("look", env.look), ("look.scenery", env.look.scenery)):
        if look is not None:
            with _named(f"{whose}.{place}.ground"):
                ground_of(look.ground)
    try:
        rows, columns = env.grid()
        fits = operator.index(rows) >= 1 and operator.index(columns) >= 1
    except (TypeError, ValueError, NotImplementedError):
        fits = False
    if not fits:
        raise RuleError(
            f"{env}: it has layers but grid() does not give (rows, columns); expected two integers, at least 1"
        )


def _check_layer(where: str, name: object, layer: object) -> None:
    """RuleError where a layer, which a message calls `where`, is not as the contract says."""
    if not isinstance(name, str) or not isinstance(layer, Layer):
        raise RuleError(f"{where} is {layer!r}; expected a Layer")
    glyphs = layer.glyph if isinstance(layer.glyph, tuple) else (layer.glyph,)
    if not glyphs or not all(isinstance(glyph, str) and len(glyph) == 1 for glyph in glyphs):
        raise RuleError(f"{where}.glyph is {layer.glyph!r}; expected one character, or a tuple of them")
    colors: Sequence[Any] = layer.color if isinstance(layer.color[0], tuple) else (layer.color,)
    for color in colors:
        if len(color) != 3 or not all(isinstance(part, int) and 0 <= part <= 255 for part in color):
            raise RuleError(f"{where}.color has {color!r}; expected (red, green, blue), 0 to 255")
    if len(colors) not in (1, len(glyphs)):
        raise RuleError(
            f"{where} has {len(glyphs)} glyphs and {len(colors)} colors; expected one color for all, or one for each"
        )
    with _named(f"{where}.shape"):
        shape_of(name, layer)
    if layer.sprite is not None:
        _check_sprites(f"{where}.sprite", layer.sprite, len(glyphs))


@contextlib.contextmanager
def _named(whose: str) -> Iterator[None]:
    """A name that nobody paints is a breach of the contract."""
    try:
        yield
    except UnknownName as error:
        raise RuleError(f"{whose}: {error}") from None


def _check_sprites(whose: str, sprite: Any, num_values: int) -> None:
    sprites = sprite if sprite and isinstance(sprite[0], tuple) else (sprite,)
    for rows in sprites:
        if not rows or len(set(map(len, rows))) != 1 or not rows[0] or set("".join(rows)) - SPRITE_LETTERS:
            raise RuleError(f"{whose} has {rows!r}; expected rows of equal length of the letters . # 1-9")
    if len(sprites) not in (1, num_values):
        raise RuleError(
            f"{whose} has {len(sprites)} sprites for {num_values} values; expected one for all, or one for each"
        )
