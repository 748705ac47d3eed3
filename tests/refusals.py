"""What a call is refused with, and calls that fail."""

import os
from collections.abc import Callable

import pytest


def refusal(error: type[Exception], call: Callable, *arguments, **options) -> str:
    """Return the one line with which a call is refused."""
    with pytest.raises(error) as caught:
        call(*arguments, **options)
    message = str(caught.value)
    assert message and "\n" not in message
    return message


def failing(error: BaseException | int, after: int = 0, call: Callable | None = None) -> Callable:
    """Return a function that fails whatever it is given, once it was `call` for the first `after` times.

    error: what it fails with; an error of the system if it is a number.
    """
    left = after

    def fails(*arguments, **options):
        nonlocal left
        left -= 1
        if left >= 0:
            return call(*arguments, **options)
        raise OSError(error, os.strerror(error)) if isinstance(error, int) else error

    return fails
