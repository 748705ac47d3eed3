"""Language of pages and docstrings, counted: the counts may only move towards their aims.

Run it as a script to see the counts of files or folders: python tests/docs/test_language.py docs/start.md src/pharos
"""

import ast
import json
import re
import sys
from collections import defaultdict
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SOURCE = ROOT / "src" / "pharos"

# Counts per 1,000 words: present limit, aim. A limit is lowered (raised, for you and if) whenever its count allows it.
LIMITS = {
    ("guides", "semicolons"): (1, 5),
    ("guides", "that of"): (0.3, 0.5),
    ("evidence", "semicolons"): (3, 5),
    ("evidence", "that of"): (0.4, 0.5),
    ("docstrings", "where"): (0.4, 2),
    ("docstrings", "that of"): (0.2, 0.5),
    ("docstrings", "semicolons"): (3.8, 5),
}
AT_LEAST = {("guides", "you"): (13, 6), ("docstrings", "if"): (8, 3)}
SHARED_NAMES = {"functions": (11, 0), "constants": (23, 0)}  # names in two files or more: present limit, aim

PATTERNS = {
    "semicolons": re.compile(";"),
    "you": re.compile(r"\b(?:you|your|yours|yourself)\b", re.I),
    "that of": re.compile(r"\b(?:that|those) of\b", re.I),
    "where": re.compile(r"\bwhere\b", re.I),
    "if": re.compile(r"\bif\b", re.I),
}
FORMULA = re.compile(r"[=<>+*/^|][^.;:]{0,80}\s\(?where\b", re.I)  # "= r + gamma v, where v is"

# Code, output, quoted messages, addresses and markup, none of which is the prose of a page.
NOT_PROSE = re.compile(
    r"\A---\n.*?\n---\n|^ *(```|~~~).*?^ *\1|<!--.*?-->|<style.*?</style>|<script.*?</script>|</?[a-zA-Z][^<>]*>"
    r"|&#?\w+;|``.+?``|`[^`]+`|\$\$.+?\$\$|\$[^$\n]+\$|(?<=\])\([^)\s]+\)|\"[^\"\n]*\"",
    re.S | re.M,
)


def prose_of_page(path: Path) -> str:
    """Text of a Markdown page, or of the Markdown cells of a notebook, as a reader speaks it."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".ipynb":
        cells = [cell["source"] for cell in json.loads(text)["cells"] if cell["cell_type"] == "markdown"]
        text = "\n\n".join("".join(cell) for cell in cells)
    return NOT_PROSE.sub(" x ", text)


def prose_of_module(path: Path) -> str:
    """Docstrings of a module, of its classes and of its functions, without code in them."""
    kinds = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    nodes = [node for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))) if isinstance(node, kinds)]
    return re.sub(r"``.+?``|`[^`]+`", " x ", "\n\n".join(ast.get_docstring(node) or "" for node in nodes), flags=re.S)


def counts_of(text: str) -> dict[str, int]:
    """Number of words of a text, and of each pattern in it."""
    counts = {name: len(pattern.findall(text)) for name, pattern in PATTERNS.items()}
    counts["where"] -= len(FORMULA.findall(text))
    return counts | {"words": len(re.findall(r"[A-Za-z][\w'-]*", text))}


def files_of(group: str) -> list[Path]:
    if group == "docstrings":
        return sorted(SOURCE.rglob("*.py"))
    if group == "evidence":
        return sorted((ROOT / "docs" / "evidence").glob("*.md"))
    pages = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").glob("*.md")]
    return sorted(pages) + sorted((ROOT / "docs" / "tutorials").glob("*.ipynb"))


def rates_of(files: list[Path]) -> dict[str, float]:
    """Counts per 1,000 words of some files together."""
    texts = [prose_of_module(path) if path.suffix == ".py" else prose_of_page(path) for path in files]
    counts = counts_of("\n\n".join(texts))
    words = max(counts.pop("words"), 1)
    return {name: round(1000 * count / words, 2) for name, count in counts.items()} | {"words": words}


def shared_names() -> dict[str, dict[str, list[str]]]:
    """Files of each top-level function (commands excepted) and each constant that two files or more define."""
    files = {"functions": defaultdict(list), "constants": defaultdict(list)}
    for path in files_of("docstrings"):
        file = path.relative_to(SOURCE).as_posix()
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.FunctionDef) and node.name[0] != "_" and not file.startswith("cli/"):
                files["functions"][node.name].append(file)
            for target in _targets(node):
                for name in ast.walk(target):
                    if isinstance(name, ast.Name) and re.fullmatch(r"_?[A-Z][A-Z0-9_]*", name.id) and len(name.id) > 1:
                        files["constants"][name.id].append(file)
    return {
        kind: {name: sorted(set(own)) for name, own in sorted(names.items()) if len(set(own)) > 1}
        for kind, names in files.items()
    }


def _targets(node: ast.stmt) -> list[ast.expr]:
    return node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []


@pytest.fixture(scope="module")
def rates():
    return {group: rates_of(files_of(group)) for group in ("guides", "evidence", "docstrings")}


@pytest.mark.parametrize(("group", "name"), LIMITS, ids=" ".join)
def test_a_count_only_falls(rates, group, name):
    limit, aim = LIMITS[group, name]
    count = rates[group][name]
    assert count <= limit, f"{name} in {group}: {count} per 1,000 words, at most {limit} (aim: below {aim})"


@pytest.mark.parametrize(("group", "name"), AT_LEAST, ids=" ".join)
def test_a_count_only_rises(rates, group, name):
    limit, aim = AT_LEAST[group, name]
    count = rates[group][name]
    assert count >= limit, f"{name} in {group}: {count} per 1,000 words, at least {limit} (aim: above {aim})"


@pytest.mark.parametrize("kind", SHARED_NAMES)
def test_names_that_several_files_define_only_become_fewer(kind):
    names, (limit, aim) = shared_names()[kind], SHARED_NAMES[kind]
    assert len(names) <= limit, f"{len(names)} {kind} in two files or more, at most {limit} (aim: {aim}): {names}"


def test_code_and_formulas_are_not_counted(tmp_path):
    (tmp_path / "page.md").write_text(
        'You see `a; b` and "c; d"; e&nbsp;f.\n```\nfor (;;) you\n```\n[g](h;i), $x;y$ that of j.', encoding="utf-8"
    )
    counts = counts_of(prose_of_page(tmp_path / "page.md"))
    assert (counts["semicolons"], counts["you"], counts["that of"]) == (1, 1, 1)
    (tmp_path / "module.py").write_text(
        '"""v = r + g w, where w is x. Zero where y; 1 if `where`."""', encoding="utf-8"
    )
    counts = counts_of(prose_of_module(tmp_path / "module.py"))
    assert (counts["where"], counts["if"], counts["semicolons"]) == (1, 1, 1)


def main(paths: list[str]) -> None:
    """Print the counts of each file, worst last, and of all; without paths: of each group, and shared names."""
    arguments = [Path(path) for path in paths]
    files = [f for path in arguments for f in (sorted(path.rglob("*.*")) if path.is_dir() else [path])]
    files = [file for file in files if file.suffix in (".md", ".ipynb", ".py")]
    rows = {str(file): rates_of([file]) for file in files} if paths else {}
    rows = dict(sorted(rows.items(), key=lambda row: row[1]["semicolons"] * row[1]["words"]))
    rows |= (
        {"all": rates_of(files)} if paths else {g: rates_of(files_of(g)) for g in ("guides", "evidence", "docstrings")}
    )
    print(*(f"{name:>10}" for name in ("words", *PATTERNS)))
    for file, rates in rows.items():
        print(*(f"{rates[name]:>10}" for name in ("words", *PATTERNS)), file)
    if not paths:
        for kind, names in shared_names().items():
            print(len(names), kind, "in two files or more:", *(f"{name} ({len(own)})" for name, own in names.items()))


if __name__ == "__main__":
    main(sys.argv[1:])
