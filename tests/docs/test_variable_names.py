"""Variables are named after what they hold: a noun of the field, not a participle."""

import ast
from pathlib import Path

import pharos

SOURCE = Path(pharos.__file__).parent

PARTICIPLES = {"asked", "found", "given", "kept", "known", "seen", "taken", "told"}

# Keywords and fields that callers write, and rules, whose variables are part of the fingerprint of their state spaces.
LICENSED = {
    "agents/hyperparameters.py": {"given"},
    "environments/worlds/game_2048.py": {"found"},
    "environments/mini_grid/mini_grid_empty.py": {"taken"},
    "errors.py": {"found", "known"},
    "hardness/report.py": {"kept"},
    "leaderboard/verification.py": {"found"},
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
