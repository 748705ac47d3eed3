"""What a call is refused with, and calls that fail."""

import os
from collections.abc import Callable
from typing import NoReturn

import pytest


def refusal(error: type[Exception], call: Callable, *arguments, **options) -> str:
    """Return the one line with which a call is refused."""
    with pytest.raises(error) as caught:
        call(*arguments, **options)
    message = str(caught.value)
    assert message and "\n" not in message
    return message


def failing(error: BaseException | int) -> Callable[..., NoReturn]:
    """Return a function that fails whatever it is given; with an error of the system, where `error` is its number."""

    def fails(*_, **__):
        raise OSError(error, os.strerror(error)) if isinstance(error, int) else error

    return fails
