"""docs/how-it-works.md: the files and functions that it names are there, and its code prints what it says."""

import contextlib
import io
import re
import sys
import types
from pathlib import Path

import pytest

import pharos

PAGE = Path(__file__).parents[2] / "docs" / "how-it-works.md"
SOURCE = Path(pharos.__file__).parent
BLOCK = re.compile(r"^```(python|text)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
REFERENCE = re.compile(r"`((?:\w+/)*\w+\.py)`(?:: (`\w+`(?:, `\w+`)*))?")


def test_the_files_and_functions_that_the_page_names_are_there():
    references = REFERENCE.findall(PAGE.read_text())
    assert len(references) > 30
    for file, names in references:
        places = [SOURCE / file, PAGE.parents[1] / file, *SOURCE.glob(f"*/{file}")]
        found = [place for place in places if place.exists()]
        assert found, file
        text = found[0].read_text()
        for name in re.findall(r"\w+", names):
            assert re.search(rf"^\s*(def|class) {name}\b", text, re.MULTILINE), f"{file}: {name}"


def test_the_folders_that_the_page_names_are_there():
    for folder in re.findall(r"`(\w+)/`", PAGE.read_text()):
        assert (SOURCE / folder / "__init__.py").exists(), folder


@pytest.mark.slow
def test_the_code_prints_what_the_page_says(monkeypatch, tmp_path):
    module = types.ModuleType("how_it_works_page")
    monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setenv("PHAROS_CACHE_DIR", str(tmp_path))
    printed, compared = "", 0
    for kind, text in BLOCK.findall(PAGE.read_text()):
        if kind == "python":
            assert printed == "", "an output that the page does not show"
            with contextlib.redirect_stdout(io.StringIO()) as output:
                exec(compile(text, str(PAGE), "exec"), vars(module))
            printed = output.getvalue()
        else:
            assert printed == text
            printed, compared = "", compared + 1
    assert compared == 9
