"""The names that scripts and notebooks rely on, what importing pharos loads, and which part may import which."""

import ast
import importlib
import subprocess
import sys
from pathlib import Path

import pytest

import pharos

SOURCE = Path(pharos.__file__).parent

CONTRACT = (
    ("pharos", "make list_environments check_environment Environment build load StateSpace"),
    ("pharos", "TabularMDP sticky_actions random_actions value_iteration evaluate_policy Solution"),
    ("pharos.hardness", "diameter Interval"),
)

HEAVY = ("numba", "scipy", "pandas", "matplotlib", "torch", "rich", "typer", "stable_baselines3")

# A file imports, at its top, only what stands before it. Inside of functions `make` and `StateSpace` look ahead.
ORDER = (
    *(
        "errors",
        "paths",
        "storage",
        "kernels",
        "environments",
        "drawing",
        "rules",
        "state_space",
        "mdp",
        "solvers",
        "hardness",
    ),
    *("importers", "exporters", "observations", "interaction", "agents", "experiments", "plots", "study"),
    *("sb3_env", "bisimulation", "cli", "__main__"),
)

# These may never meet, not even inside of a function.
STRANGERS = {
    "solvers": {"environments", "state_space", "observations", "interaction"},
    "hardness": {"environments", "state_space", "observations", "interaction"},
    "mdp": {"observations", "interaction", "solvers", "hardness"},
    "state_space": {"solvers", "hardness", "observations", "interaction"},
    "environments": {"state_space", "mdp", "solvers", "hardness", "observations", "interaction", "kernels"},
}


@pytest.mark.parametrize(("module", "names"), CONTRACT)
def test_the_names_of_the_contract_are_there(module, names):
    for name in names.split():
        assert hasattr(importlib.import_module(module), name), name


def test_every_announced_name_is_listed():
    assert set(pharos.__all__) <= set(dir(pharos))


def test_a_name_that_does_not_exist_is_an_attribute_error():
    with pytest.raises(AttributeError, match="module 'pharos' has no attribute 'bild'"):
        pharos.bild  # noqa: B018


@pytest.mark.parametrize(
    "command", ("import pharos", "import pharos; pharos.list_environments(); pharos.make('breakout')")
)
def test_importing_pharos_loads_nothing_heavy(command):
    code = f"{command}\nimport sys\nprint([name for name in {HEAVY} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_every_part_has_its_place_in_the_order():
    parts = {path.stem for path in SOURCE.iterdir() if path.suffix == ".py" or (path / "__init__.py").exists()}
    assert parts - set(ORDER) <= {"__init__"}


@pytest.mark.parametrize("path", sorted(SOURCE.rglob("*.py")), ids=lambda path: path.relative_to(SOURCE).as_posix())
def test_imports_point_to_what_comes_before(path):
    part = path.relative_to(SOURCE).parts[0].removesuffix(".py")
    if part == "__init__":
        return
    tree = ast.parse(path.read_text())
    place = ORDER.index(part)
    at_the_top = {name for name in imported_parts(tree.body) if name != part}
    assert {name for name in at_the_top if ORDER.index(name) > place} == set()
    everywhere = imported_parts(list(ast.walk(tree))) - type_checking_parts(tree)
    assert everywhere & STRANGERS.get(part, set()) == set()


def imported_parts(nodes) -> set[str]:
    """Which parts of pharos these statements import."""
    found = set()
    for node in nodes:
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            names = [f"{node.module}.{alias.name}" if node.module == "pharos" else node.module for alias in node.names]
        found |= {name.split(".")[1] for name in names if name.startswith("pharos.")}
    return found & set(ORDER)


def type_checking_parts(tree: ast.Module) -> set[str]:
    """What is imported for type checkers alone."""
    blocks = [node for node in tree.body if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"]
    return {part for block in blocks for part in imported_parts(block.body)}
