"""The names that scripts and notebooks rely on, what importing pharos loads, and which part may import which."""

import ast
import functools
import importlib
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import pharos

SOURCE = Path(pharos.__file__).parent
ROOT = Path(__file__).parents[2]
PACKAGES = sorted(path.parent.name for path in SOURCE.glob("*/__init__.py"))

CONTRACT = (
    ("pharos", "make list_environments check_environment Environment build load StateSpace"),
    ("pharos", "TabularMDP sticky_actions random_actions value_iteration evaluate_policy Solution"),
    ("pharos.hardness", "diameter Interval"),
    ("pharos.leaderboard", "submit verify board read"),  # as pharos.benchmark was called for single runs
    ("pharos.validation", "predict regret_predictor published outcomes unseen_classes"),  # now prediction and study
    ("pharos.experiments", "RunConfig evaluate_agent train_configs"),  # as pharos.training was called
)

HEAVY = ("numba", "scipy", "pandas", "matplotlib", "torch", "rich", "typer", "stable_baselines3")

# A part imports only what stands before it, at the top of a file and inside of functions alike.
ORDER = (
    *("errors", "system", "statistics", "regret", "ranks", "kernels", "environments", "drawing", "rules"),
    *("state_space", "mdp", "solvers"),
    *("hardness", "importers", "exporters", "observations", "interaction", "policies", "agents", "training"),
    *("prediction", "plots", "sb3_env", "bisimulation", "explorer"),
    *("study", "benchmark"),
    *("cli", "__main__"),
    *("experiments", "leaderboard", "validation"),
)

# The two rooms on top of everything: only the command line and former names import them, and neither the other.
TOP = {"study", "benchmark"}
USERS_OF_TOP = {"cli", "leaderboard", "validation"}

# Its modules are its names: each is a part of its own.
WITHOUT_FACADE = {"system"}

# These never meet, though one stands before the other: a solver knows tables, and neither games nor agents.
STRANGERS = {
    "solvers": {"environments", "state_space"},
    "hardness": {"environments", "state_space"},
    "environments": {"kernels"},
}

# Imports that look ahead, each by name.
LICENSED = {
    ("state_space/store.py", "mdp"): "StateSpace.mdp makes the MDP of a space",
}


@pytest.mark.parametrize(("module", "names"), CONTRACT)
def test_the_names_of_the_contract_are_there(module, names):
    for name in names.split():
        assert hasattr(importlib.import_module(module), name), name


def test_what_is_listed_is_what_is_announced():
    assert dir(pharos) == sorted(pharos.__all__)
    assert [name for name in dir(pharos) if not hasattr(pharos, name)] == []


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


@pytest.mark.long
def test_measures_and_training_load_sparse_matrices_where_they_use_them():
    code = "import sys, pharos.training, pharos.hardness.registry; print('scipy.sparse' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


@pytest.mark.long
def test_former_names_need_no_extra_that_they_did_not_need():
    code = "import sys; sys.modules['yaml'] = None; from pharos.validation import predict\n"
    code += "from pharos.leaderboard import verify, submit; print(predict.__name__, verify.__name__)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "predict verify"


def test_every_part_has_its_place_in_the_order():
    parts = {path.stem for path in SOURCE.iterdir() if path.suffix == ".py" or (path / "__init__.py").exists()}
    assert parts - set(ORDER) <= {"__init__"}


@pytest.mark.long
def test_imports_point_to_what_comes_before():
    upward, used = set(), set()
    for path, name, _ in imports():
        if before(part_of(path), name.split(".")[1]):
            continue
        if (path, name.split(".")[1]) in LICENSED:
            used.add((path, name.split(".")[1]))
        else:
            upward.add(f"{path}: {name}")
    assert upward == set()
    print("licensed:", *(f"{path} imports {part}: {LICENSED[path, part]}" for path, part in sorted(used)))
    assert used == set(LICENSED), "a licence that nobody needs"


@pytest.mark.long
def test_nothing_stands_on_study_and_benchmark():
    found = [(path, name) for path, name, _ in imports() if path != "__init__.py"]  # whose names load late
    users = {(path, name) for path, name in found if name.split(".")[1] in TOP}
    below = {(path, name) for path, name in users if part_of(path) not in {*USERS_OF_TOP, name.split(".")[1]}}
    assert {f"{path}: {name}" for path, name in below if (path, name.split(".")[1]) not in LICENSED} == set()
    assert {part_of(path) for path, _ in users} >= TOP | USERS_OF_TOP


@pytest.mark.long
def test_strangers_never_meet():
    met = {(part_of(path), name.split(".")[1]) for path, name, _ in imports()}
    assert {(part, other) for part, others in STRANGERS.items() for other in others} & met == set()


def test_nobody_imports_another_packages_modules():
    """`from pharos.mdp import TabularMDP`, an announced name; never `from pharos.mdp.tabular import TabularMDP`."""
    inside = set()
    for path, name, is_announced in imports():
        part = name.split(".")[1]
        if part == part_of(path) or not (SOURCE / part).is_dir() or is_announced or path == "__init__.py":
            continue
        inside.add(f"{path}: {name}")
    assert inside == set()


@pytest.mark.slow
@pytest.mark.parametrize("package", PACKAGES)
def test_a_package_has_what_it_announces(package):
    module = importlib.import_module(f"pharos.{package}")
    files = {path.stem for path in (SOURCE / package).glob("*.py")}
    assert [name for name in announced(package) if not hasattr(module, name) and name not in files] == []


def part_of(path: str) -> str:
    """The part of pharos that a file belongs to."""
    return path.split("/")[0].removesuffix(".py")


def before(part: str, other: str) -> bool:
    """Whether `part` may import `other`."""
    return part == "__init__" or ORDER.index(other) <= ORDER.index(part)


@functools.cache
def imports() -> list[tuple[str, str, bool]]:
    """(file, what it imports of pharos, whether its package announces that); those for type checkers included."""
    files = {file.relative_to(SOURCE).as_posix(): file.read_text() for file in sorted(SOURCE.rglob("*.py"))}
    found = [(path, *each) for path, text in files.items() for each in imports_of(path, text)]
    return [(path, name, public) for path, name, public in found if name.split(".")[1] in ORDER]


def imports_of(path: str, text: str) -> list[tuple[str, bool]]:
    """(what the text of a file imports of pharos, whether its package announces that), however it is written: at the
    top or in a function, relatively, as an attribute of pharos, or by a name for `import_module`."""
    found = []
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            found += [(alias.name, alias.name.count(".") < 2) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            above = ["pharos", *path.split("/")][: -node.level] if node.level else []
            module = ".".join([*above, *filter(None, [node.module])])
            parts = module.split(".")[1:]  # a package may announce modules, as kernels does
            found += [(f"{module}.{alias.name}", is_announced([*parts, alias.name])) for alias in node.names]
        elif isinstance(node, ast.Attribute) and ast.unparse(node.value) == "pharos":
            found.append((f"pharos.{node.attr}", True))
        elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith("import_module"):
            name = node.args[0].value if isinstance(node.args[0], ast.Constant) else ""
            found.append((name, is_announced(name.split(".")[1:])))
    return [(name, public) for name, public in found if name.startswith("pharos.")]


def is_announced(parts: list[str]) -> bool:
    """Whether a name below pharos, such as mdp.TabularMDP, is a package, or what a package announces."""
    return len(parts) < 2 or parts[0] in WITHOUT_FACADE or parts[1] in announced(parts[0])


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("import pharos.mdp", ("pharos.mdp", True)),
        ("from pharos import mdp", ("pharos.mdp", True)),
        ("from pharos.mdp import TabularMDP", ("pharos.mdp.TabularMDP", True)),
        ("from pharos.mdp.tabular import TabularMDP", ("pharos.mdp.tabular.TabularMDP", False)),
        ("def f():\n    import pharos.mdp.tabular", ("pharos.mdp.tabular", False)),
        ("from ..mdp import TabularMDP", ("pharos.mdp.TabularMDP", True)),
        ("from ..mdp.tabular import TabularMDP", ("pharos.mdp.tabular.TabularMDP", False)),
        ("from .. import mdp", ("pharos.mdp", True)),
        ("import pharos\npharos.study.run()", ("pharos.study", True)),
        ("importlib.import_module('pharos.mdp.tabular')", ("pharos.mdp.tabular", False)),
    ],
)
def test_an_import_is_seen_however_it_is_written(line, expected):
    assert imports_of("solvers/values.py", line) == [expected]


@functools.cache
def announced(package: str) -> frozenset[str]:
    """Names of a package for users and for other packages, read from its text."""
    file = SOURCE / package / "__init__.py"
    return frozenset().union(*lists_of(file.read_text())) if file.exists() else frozenset()


def lists_of(text: str) -> tuple[set[str], set[str]]:
    """(names for users, `__all__`; names for other packages: what else it imports of its own, and the words of a string
    `_shared`)."""
    lists = {"__all__": set(), "_shared": set()}
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Assign) and (name := ast.unparse(node.targets[0])) in lists:
            value = ast.literal_eval(node.value)
            lists[name] |= {*(value.split() if isinstance(value, str) else value)}
        elif isinstance(node, ast.ImportFrom) and re.match(r"pharos\.(?!system$)", node.module or ""):
            lists["_shared"] |= {
                name for alias in node.names if not (name := alias.asname or alias.name).startswith("_")
            }
    return lists["__all__"], lists["_shared"] - lists["__all__"]


@pytest.mark.parametrize("package", PACKAGES)
def test_a_package_publishes_something(package):
    assert package in WITHOUT_FACADE or any(lists_of((SOURCE / package / "__init__.py").read_text()))


def test_what_pages_for_users_name_is_public():
    """`hardness.diameter(` and `from pharos.training import Task` in a page: both are in `__all__`."""
    folders = [ROOT / "docs" / folder for folder in (".", "tutorials", "examples", "studies", "tuning")]
    pages = [ROOT / "README.md", *(path for folder in folders for path in folder.glob("*.*"))]
    hidden, seen = set(), 0
    for page in pages:
        if page.suffix not in (".md", ".ipynb", ".py") or page.name == "how-it-works.md":
            continue
        for package, name in names_in(page.read_text()):
            public, shared = lists_of((SOURCE / package / "__init__.py").read_text())
            seen += name in public
            if name in shared:
                hidden.add(f"{page.name}: {package}.{name}")
    assert not hidden and seen > 50


def names_in(text: str) -> list[tuple[str, str]]:
    """(package, name) of what a page takes from packages of pharos, in code of any language."""
    found = [each for each in re.findall(r"\b(\w+)\.(\w+)\b", text) if each[0] in PACKAGES]
    for package, names in re.findall(r"from pharos\.(\w+) import ([\w, ]+)", text):
        found += [(package, name.split()[0]) for name in names.split(",") if package in PACKAGES]
    return found


# Types ----------------------------------------------------------------------------------------------------------------


SCRIPT = """
env = pharos.make("frozen_lake/4x4")
space = pharos.build(env)
mdp = pharos.sticky_actions(space.mdp(gamma=0.99), 0.25)
solution = pharos.value_iteration(mdp)
reveal_type(env)  # Environment
reveal_type(space)  # StateSpace
reveal_type(mdp)  # TabularMDP
reveal_type(solution.value_at_start)  # float
reveal_type(pharos.hardness.diameter(mdp))  # Interval
reveal_type(pharos.train("q_learning", env, steps=100))  # TrainingResult
reveal_type(pharos.make_vec(env, 4))  # VectorEnv
"""


@pytest.mark.long
def test_every_public_name_has_a_type_for_checkers(tmp_path):
    api = pytest.importorskip("mypy.api")
    names = [name for name in pharos.__all__ if name != "__version__"]
    parts = [name for name in names if hasattr(getattr(pharos, name), "__path__")]
    names += [f"{part}.{name}" for part in parts for name in getattr(pharos, part).__all__]
    assert len(names) > 200
    script, refused = tmp_path / "script.py", "pharos.value_iteration(space)\n"
    script.write_text("import pharos\n" + "".join(f"reveal_type(pharos.{name})\n" for name in names) + SCRIPT + refused)
    options = (
        "--follow-imports=silent",
        "--no-error-summary",
        f"--cache-dir={tmp_path}",
        f"--config-file={os.devnull}",
    )
    lines = [line.partition(f"{script}:")[2] for line in api.run([str(script), *options])[0].splitlines()]
    types = [line.partition("Revealed type is ")[2] for line in lines if "Revealed type" in line]
    expected = [line.partition("# ")[2] for line in SCRIPT.splitlines() if "# " in line]
    untyped = [name for name, kind in zip(names, types[: len(names)], strict=True) if kind in ("", '"Any"')]
    assert not untyped
    for kind, ending in zip(types[len(names) :], expected, strict=True):
        assert kind.endswith(f'{ending}"'), kind
    assert [line for line in lines if "error:" in line and "[arg-type]" in line and "StateSpace" in line]
