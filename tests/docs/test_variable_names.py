"""Names: variables are nouns and not participles, classes and functions mean one thing, docstrings name a result."""

import ast
import re
from collections import Counter
from pathlib import Path

import pytest

import pharos

SOURCE = Path(pharos.__file__).parent

PARTICIPLES = {"alike", "asked", "asking", "chosen", "following", "found", "given", "kept", "known", "likely", "met"}
PARTICIPLES |= {"paid", "reached", "said", "seeing", "seen", "taken", "together", "told"}

# Keywords and fields that callers write, and rules, whose variables are part of the fingerprint of their state spaces.
LICENSED = {
    "agents/registry.py": {"given"},
    "benchmark/verification.py": {"found"},
    "environments/base.py": {"likely"},
    "environments/imported.py": {"likely", "paid"},
    "environments/worlds/game_2048.py": {"found", "likely", "paid"},
    "environments/mini_grid/mini_grid_empty.py": {"reached", "taken"},
    "errors.py": {"found", "known"},
    "exporters.py": {"chosen"},
    "hardness/report.py": {"kept"},
    "mdp/actions.py": {"chosen"},
    "observations/context.py": {"seen"},
}


@pytest.fixture(scope="module")
def nodes_of():
    """The nodes of the syntax tree of each file of the library."""
    files = {path.relative_to(SOURCE).as_posix(): path for path in sorted(SOURCE.rglob("*.py"))}
    return {file: list(ast.walk(ast.parse(path.read_text(encoding="utf-8")))) for file, path in files.items()}


def variables(nodes: list[ast.AST]) -> set[str]:
    """Names that a file binds: by assignments, loops, comprehensions, fields and parameters."""
    names = set()
    for node in nodes:
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            names.add(node.id)
        elif isinstance(node, ast.arg):
            names.add(node.arg)
    return names


def test_no_variable_is_named_by_a_participle(nodes_of):
    participles = {file: variables(nodes) & PARTICIPLES for file, nodes in nodes_of.items()}
    unlicensed = {file: names - LICENSED.get(file, set()) for file, names in participles.items()}
    assert not any(unlicensed.values()), (
        f"rename these variables to nouns: { {f: n for f, n in unlicensed.items() if n} }"
    )
    assert {file: names for file, names in participles.items() if names} == LICENSED


def test_a_class_name_means_one_thing_in_the_whole_library(nodes_of):
    names = Counter(node.name for nodes in nodes_of.values() for node in nodes if isinstance(node, ast.ClassDef))
    assert [name for name, count in names.items() if count > 1] == []


# Files and folders whose functions share their names with no function elsewhere, commands excepted.
ONE_MEANING = ("statistics.py", "regret.py", "system/threads.py", "policies/losses.py", "hardness/representation/")
ONE_MEANING += ("observations/classes.py", "observations/tangent.py")
ONE_MEANING += ("study/aliasing.py", "study/prediction_figures.py", "study/profiles.py")
DOCUMENTED = {"regret": {"regret.py", "plots/regret.py"}}  # of two packages, by the same word


def test_a_function_name_means_one_thing(nodes_of):
    files = {}
    for file, (module, *_) in nodes_of.items():
        for node in module.body:
            if isinstance(node, ast.FunctionDef) and node.name[0] != "_" and not file.startswith("cli/"):
                files.setdefault(node.name, set()).add(file)
    shared = {name: own for name, own in files.items() if len(own) > 1 and any(f.startswith(ONE_MEANING) for f in own)}
    assert shared == DOCUMENTED


# "What a checkpoint keeps." is a predicate without a subject, and says nothing in an IDE's list.
RIDDLES = re.compile(r"(What|How|Where|When|Who|Whose|Which|Those|That of|Of|As|Until|Everything|It|They|Them)\b")


def test_docstrings_begin_with_a_noun_or_a_verb(nodes_of):
    riddles = [
        (file, getattr(node, "name", ""))
        for file, nodes in nodes_of.items()
        for node in nodes
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef))
        and RIDDLES.match(ast.get_docstring(node) or "")
    ]
    assert riddles == [  # text of rules, which is part of the fingerprint of their state spaces
        ("environments/worlds/game_2048.py", "room"),
        ("environments/worlds/taxi.py", "parts_of"),
    ]
