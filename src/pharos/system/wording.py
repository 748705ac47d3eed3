"""Texts of counts, names and errors in messages and tables, and the templates of pages."""

import traceback
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from pharos.errors import MissingExtra, PharosError

if TYPE_CHECKING:
    import jinja2


def pluralize(count: int, one: str, several: str | None = None) -> str:
    """A count and its noun: "1 run", "1,200 runs", "2 classes"."""
    return f"{count:,} {one if count == 1 else several or one + 's'}"


def capped(value: object, most: int = 200) -> str:
    """A value in one line, cut after so many characters: what a message quotes."""
    text = " ".join(str(value).split())
    return text if len(text) <= most else f"{text[: most - 3]}..."


def in_words(name: str) -> str:
    """A name as prose spells it: `normalized_regret` is "normalised regret"."""
    return name.replace("_", " ").replace("normalized", "normalised")


def in_one_line(error: BaseException) -> str:
    """An error in one line, with its type unless it is one of pharos."""
    try:
        text = " ".join(str(error).split())
    except Exception:  # of a class of the user's own
        text = "an error that cannot be printed"
    return text if isinstance(error, PharosError) else f"{type(error).__name__}: {text}"


def line_in(error: BaseException, file: str | None) -> str:
    """The last line of a file in the traceback of an error, such as " (FILE, line 12)", or empty if there is none."""
    frames = [each for each in traceback.extract_tb(error.__traceback__) if file and each.filename == file]
    return f" ({Path(frames[-1].filename).name}, line {frames[-1].lineno})" if frames else ""


def latex_text(text: str) -> str:
    """Text as LaTeX prints it: its special letters escaped."""
    special = {
        "\\": "textbackslash",
        "~": "textasciitilde",
        "^": "textasciicircum",
        "<": "textless",
        ">": "textgreater",
    }
    return "".join(
        f"\\{special[letter]}{{}}" if letter in special else f"\\{letter}" if letter in "&%$#_{}" else letter
        for letter in text
    )


# Templates ------------------------------------------------------------------------------------------------------------


@cache
def templates(package: str, page: str) -> "jinja2.Environment":
    """The templates of Jinja2 in the folder `templates` of a package: what is filled in is escaped.

    A name that is not there is an error.

    Args:
        page: that is made of them, for the error.
    Raises:
        MissingExtra: Jinja2 is not installed.
    """
    try:
        import jinja2
    except ImportError as error:
        raise MissingExtra(page, "jinja2", "study") from error
    return jinja2.Environment(
        loader=jinja2.PackageLoader(package),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        keep_trailing_newline=True,
    )
