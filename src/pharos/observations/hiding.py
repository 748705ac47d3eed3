"""Hidden parts of an observation: names that the options `hide` and `seen_first` take."""

from collections.abc import Collection, Sequence

from pharos.errors import ParameterError


def hidden_names(
    hide: str | Sequence[str], what: str, choices: Collection[str], also: Collection[str] = (), option: str = "hide"
) -> set[str]:
    """The names that `hide` has, a sequence or a text with commas.

    Args:
        what: whose they are, such as "vector of breakout".
        choices: what can be hidden, as a message lists it. also: further names.
        option: in whose value they stand.
    Raises:
        ParameterError: one of them cannot be hidden, or they are no names; the message says what can.
    """
    names = [name.strip() for name in hide.split(",") if name.strip()] if isinstance(hide, str) else hide
    if not isinstance(names, Sequence) or not all(isinstance(name, str) for name in names):
        raise ParameterError(f"{what}: {option} is {hide!r}; expected names, some of {', '.join(choices)}")
    for name in names:
        if name not in choices and name not in also:
            raise ParameterError(f"{what}: there is no {name!r} to hide; expected some of {', '.join(choices)}")
    return set(names)
