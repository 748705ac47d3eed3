"""Names: variables are nouns and not participles, a class name means one thing, docstrings say what is returned."""

import ast
import re
from collections import Counter
from pathlib import Path

import pharos

SOURCE = Path(pharos.__file__).parent

PARTICIPLES = {"asked", "found", "given", "kept", "known", "seen", "taken", "told"}
PARTICIPLES |= {
    "alike",
    "asking",
    "chosen",
    "following",
    "likely",
    "met",
    "paid",
    "reached",
    "said",
    "seeing",
    "together",
}

# Keywords and fields that callers write, and rules, whose variables are part of the fingerprint of their state spaces.
LICENSED = {
    "agents/hyperparameters.py": {"given"},
    "environments/base.py": {"likely"},
    "environments/imported.py": {"likely", "paid"},
    "environments/worlds/game_2048.py": {"found", "likely", "paid"},
    "environments/mini_grid/mini_grid_empty.py": {"reached", "taken"},
    "errors.py": {"found", "known"},
    "exporters.py": {"chosen"},
    "hardness/report.py": {"kept"},
    "leaderboard/verification.py": {"found"},
    "mdp/actions.py": {"chosen"},
    "observations/context.py": {"seen"},
}


def variables(path: Path) -> set[str]:
    """Names that a file binds: by assignments, loops, comprehensions, fields and parameters."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            names.add(node.id)
        elif isinstance(node, ast.arg):
            names.add(node.arg)
    return names


def test_no_variable_is_named_by_a_participle():
    participles = {}
    for path in sorted(SOURCE.rglob("*.py")):
        file = path.relative_to(SOURCE).as_posix()
        if names := variables(path) & PARTICIPLES:
            participles[file] = names
    assert participles == LICENSED


def test_a_class_name_means_one_thing_in_the_whole_library():
    names = Counter(
        node.name
        for path in SOURCE.rglob("*.py")
        for node in ast.parse(path.read_text(encoding="utf-8")).body
        if isinstance(node, ast.ClassDef)
    )
    assert [name for name, count in names.items() if count > 1] == []


# "What a checkpoint keeps." is a predicate without a subject, and says nothing in an IDE's list.
RIDDLES = re.compile(r"(What|How|Where|When|Who|Whose|Which|Those|That of|Of|As|Until|Everything|It|They|Them)\b")


def test_docstrings_begin_with_a_noun_or_a_verb():
    riddles = []
    for path in sorted(SOURCE.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)):
                docstring = ast.get_docstring(node) or ""
                if RIDDLES.match(docstring):
                    riddles.append((path.relative_to(SOURCE).as_posix(), getattr(node, "name", "")))
    assert riddles == [  # text of rules, which is part of the fingerprint of their state spaces
        ("environments/worlds/game_2048.py", "room"),
        ("environments/worlds/taxi.py", "parts_of"),
    ]
