"""docs/adding-an-environment.md: its code runs as printed, and prints what it says."""

import contextlib
import io
import re
import sys
import types
from pathlib import Path

import pytest

from pharos.environments import catalog
from pharos.system import storage
from pharos.system.compiling import private_folder

PAGE = Path(__file__).parents[2] / "docs" / "adding-an-environment.md"
BLOCK = re.compile(r"^```(python|text)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def blocks():
    return [(match[1], match[2]) for match in BLOCK.finditer(PAGE.read_text())]


@pytest.fixture
def page(monkeypatch, tmp_path):
    """A module to run the page in, away from the user's cache (but for compiled rules) and from the list of
    environments."""
    module = types.ModuleType("tutorial_page")
    monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setattr(catalog, "_REGISTERED", {})
    (tmp_path / "compiled").symlink_to(private_folder(storage.cache_directory()))
    monkeypatch.setenv("PHAROS_CACHE_DIR", str(tmp_path))
    return module


@pytest.mark.slow
def test_the_code_prints_what_the_page_says(page):
    printed, compared = "", 0
    for kind, text in blocks():
        if kind == "python":
            assert printed == "", "an output that the page does not show"
            with contextlib.redirect_stdout(io.StringIO()) as output:
                exec(compile(text, str(PAGE), "exec"), vars(page))
            printed = output.getvalue()
        else:
            assert printed == text
            printed, compared = "", compared + 1
    assert compared == 4


@pytest.mark.parametrize("name", ("Coins", "Ladder"))
def test_the_class_has_fewer_than_40_lines(name):
    code = next(text for _, text in blocks() if f"class {name}(Environment)" in text)
    written = [line for line in code.splitlines() if line.strip() and not line.startswith(("from", "import"))]
    assert len(written) < 40


@pytest.mark.slow
def test_the_class_of_the_page_is_made_from_a_file(tmp_path, monkeypatch):
    import pharos

    monkeypatch.setattr(catalog, "_REGISTERED", {})
    (tmp_path / "coins.py").write_text(blocks()[0][1])
    env = pharos.make(f"{tmp_path / 'coins.py'}:Coins", size=3)
    assert env.parameters == {"size": 3}
    assert pharos.check_environment(env).complete
