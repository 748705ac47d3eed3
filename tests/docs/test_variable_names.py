"""Names: variables are nouns and not participles, a class name means one thing, docstrings say what is returned."""

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
    "agents/hyperparameters.py": {"given"},
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
    assert {file: names for file, names in participles.items() if names} == LICENSED


def test_a_class_name_means_one_thing_in_the_whole_library(nodes_of):
    names = Counter(node.name for nodes in nodes_of.values() for node in nodes if isinstance(node, ast.ClassDef))
    assert [name for name, count in names.items() if count > 1] == []


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
