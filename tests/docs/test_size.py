"""No package outgrows the limit that docs/decisions/size.md gives it."""

import importlib.util
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs/decisions/size.md"
ROOM = 1.05


@pytest.fixture(scope="module")
def size():
    spec = importlib.util.spec_from_file_location("size", ROOT / "scripts/size.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def limits():
    """Package -> limit, the last column of the page's first table."""
    table = PAGE.read_text().split("\n| sum ")[0]
    rows = re.findall(r"^\| ([^|]+) \|.*\| ([\d,]+) \|$", table, flags=re.MULTILINE)
    return {package: int(limit.replace(",", "")) for package, limit in rows}


def outgrown(lines, limits):
    """What is wrong with packages of so many code lines, and what to do about it, a line each."""
    absent = [
        f"{package}: a line | {package} | | {lines[package]} | LIMIT |"
        for package in sorted(lines.keys() - limits.keys())
    ]
    over = [p for p in sorted(lines.keys() & limits.keys()) if lines[p] > ROOM * limits[p]]
    return absent + [f"{p}: {lines[p]} code lines, limit {limits[p]}: drop a variant, or raise the limit" for p in over]


@pytest.mark.slow
def test_no_package_outgrows_its_limit(size):
    lines = size.lines_by_package()
    assert sum(lines.values()) > 10_000
    assert not outgrown(lines, limits()), f"{PAGE.relative_to(ROOT)} needs a change"
    assert not limits().keys() - lines.keys(), "the page has limits of packages that are gone"


@pytest.mark.long
def test_annotations_that_are_plain_any_become_fewer(size):
    count = sum(size.plain_any(size.tree_of(path)) for paths in size.files_of(ROOT).values() for path in paths)
    limit = int(re.search(r"At most (\d+) annotations are plain `Any`", PAGE.read_text())[1])
    assert limit / ROOM <= count <= limit, f"{count} plain `Any`: give a type, or lower the limit of {PAGE.name}"


def test_a_package_may_outgrow_its_limit_by_a_twentieth():
    assert not outgrown({"mdp": 105}, {"mdp": 100})
    assert outgrown({"mdp": 106}, {"mdp": 100}) == [
        "mdp: 106 code lines, limit 100: drop a variant, or raise the limit"
    ]
    assert "| mdp | | 3 | LIMIT |" in outgrown({"mdp": 3}, {})[0]


def test_a_code_line_is_neither_blank_nor_comment_nor_docstring(size):
    head = '"""A file\n\nof two."""\n\n# a comment\n'
    code = 'X = """two\nlines"""\n\n\ndef f():\n    "Text."\n    return (1,\n\n            2)  # two\n'
    assert size.code_lines(head) == 0 and size.code_lines(head + code) == 2 + 1 + 2
