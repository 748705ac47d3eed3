"""Keys for actions when playing, in the terminal and on the page."""

ARROWS = {"up": "w", "left": "a", "down": "s", "right": "d"}  # action -> letter


def keys_of(actions: tuple[str, ...]) -> dict[str, int]:
    """Key -> action: arrows and w a s d for directions, space for staying, and the digits for all."""
    keys: dict[str, int] = {}
    for number, action in enumerate(actions):
        if number < 9:
            keys[str(number + 1)] = number
        direction = next(
            (name for name in ARROWS if action.lower() == name or action.lower().endswith(f" {name}")), None
        )
        if direction is not None:
            keys.setdefault(direction, number)
            keys.setdefault(ARROWS[direction], number)
        elif action.lower() in ("stay", "noop", "wait", "fire", "none"):
            keys.setdefault("space", number)
    return keys
