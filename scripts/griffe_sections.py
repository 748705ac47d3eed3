"""Lets the reference read our docstrings: a section begins on the next line, and Cost and Source are paragraphs."""

import re

import griffe

SECTIONS = r"Args|Attributes|Returns|Raises|Cost|Source|Sources"


class Sections(griffe.Extension):
    """Puts an empty line before each section."""

    def on_instance(self, *, obj: griffe.Object, **_) -> None:
        if obj.docstring is None:
            return
        text = re.sub(rf"\n(?=(?:{SECTIONS}):)", "\n\n", obj.docstring.value)
        text = re.sub(
            rf"^(?!(?:{SECTIONS}):)(\S[^\n]*)\n(?=    \S)", r"\1\n\n", text, flags=re.MULTILINE
        )  # lists of ours
        text = re.sub(
            r"^\S+\n(?:[├│└].*\n)+", r"```text\n\g<0>```\n", text, flags=re.MULTILINE
        )  # a tree keeps its lines
        text = re.sub(r"(?<=\b[VQ])\*", r"\\*", text)  # V*, which is no emphasis
        text = re.sub(r"^(Cost|Sources?): ", r"**\1.** ", text, flags=re.MULTILINE)
        obj.docstring.value = re.sub(r"^(Returns|Raises): *(?=\S)", r"\1:\n    ", text, flags=re.MULTILINE)
