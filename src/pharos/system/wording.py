"""How messages and tables say numbers, names and errors."""

from pharos.errors import PharosError


def many(count: int, one: str, several: str | None = None) -> str:
    """A count and its noun: "1 run", "1,200 runs", "2 classes"."""
    return f"{count:,} {one if count == 1 else several or one + 's'}"


def in_words(name: str) -> str:
    """A name as prose spells it: `normalized_regret` is "normalised regret"."""
    return name.replace("_", " ").replace("normalized", "normalised")


def in_one_line(error: BaseException) -> str:
    """An error as pharos says it, or with its type."""
    text = " ".join(str(error).split())
    return text if isinstance(error, PharosError) else f"{type(error).__name__}: {text}"


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
