"""Prints the size of the library: code lines by package, and what makes a reader open more files than one.

python scripts/size.py                  this checkout
python scripts/size.py --root FOLDER    another one, such as an older commit unpacked there
python scripts/size.py --walk           the files that one state passes from its rules to its regret, in the pharos
                                        that is imported

A code line is neither blank, nor a comment, nor of a docstring. The limits stand in docs/decisions/size.md.
"""

import argparse
import ast
import gc
import io
import statistics
import sys
import tempfile
import tokenize
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

ROOT = Path(__file__).parents[1]
LOOSE = "(files of no package)"
MANY_PARAMETERS = 7
RECORDS = ("decisions", "evidence", "studies")  # folders of docs
SILENT = {
    *(tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT),
    *(tokenize.ENCODING, tokenize.ENDMARKER),
}
FUNCTION = ast.FunctionDef | ast.AsyncFunctionDef


def code_lines(text: str) -> int:
    """Return how many lines of a file are code."""
    lines: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in SILENT:
            lines.update(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Module | ast.ClassDef | FUNCTION) and ast.get_docstring(node, clean=False) is not None:
            lines.difference_update(range(node.body[0].lineno, node.body[0].end_lineno + 1))
    return len(lines)


def files_of(root: Path) -> dict[str, list[Path]]:
    """Return the Python files of each package of a checkout."""
    source, packages = root / "src/pharos", {}
    for path in sorted(source.rglob("*.py")):
        parts = path.relative_to(source).parts
        packages.setdefault(parts[0] if len(parts) > 1 else LOOSE, []).append(path)
    return packages


def lines_by_package(root: Path = ROOT) -> dict[str, int]:
    """Return the code lines of each package of a checkout."""
    return {package: sum(map(code_lines, map(text_of, paths))) for package, paths in files_of(root).items()}


def text_of(path: Path) -> str:
    return path.read_text(encoding="utf-8")


def tree_of(path: Path) -> ast.Module:
    return ast.parse(text_of(path))


def public_names(tree: ast.Module) -> int:
    """Return the length of `__all__`, 0 where there is none."""
    lists = [
        node.value for node in tree.body if isinstance(node, ast.Assign) and "__all__" in ast.unparse(node.targets)
    ]
    return sum(len(ast.literal_eval(each)) for each in lists)


def parameters(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Return how many parameters a caller may give."""
    given = function.args
    names = [each.arg for each in (*given.posonlyargs, *given.args, *given.kwonlyargs)]
    return len(names) - (names[:1] in (["self"], ["cls"]))


def plain_any(tree: ast.Module) -> int:
    """Return how many parameters, results and variables are annotated as `Any`, with nothing around it."""
    annotations = (
        note for node in ast.walk(tree) for note in (getattr(node, "annotation", None), getattr(node, "returns", None))
    )
    return sum(isinstance(note, ast.Name) and note.id == "Any" for note in annotations)


def circles(root: Path) -> list[list[str]]:
    """Return groups of modules that import each other: at the top of a file, in functions, or for types."""
    paths = {module_of(path, root): path for paths in files_of(root).values() for path in paths}
    place = {name: i for i, name in enumerate(paths)}
    arrows = [(place[name], place[to]) for name, path in paths.items() for to in imported_by(tree_of(path), paths)]
    graph = coo_array((np.ones(len(arrows)), tuple(zip(*arrows, strict=True))), shape=(len(paths), len(paths)))
    groups: dict[int, list[str]] = {}
    for name, label in zip(paths, connected_components(graph, connection="strong")[1], strict=True):
        groups.setdefault(label, []).append(name)
    return [group for group in groups.values() if len(group) > 1]


def module_of(path: Path, root: Path) -> str:
    name = ".".join(path.relative_to(root / "src").with_suffix("").parts)
    return name.removesuffix(".__init__")


def imported_by(tree: ast.Module, paths: dict[str, Path]) -> Iterator[str]:
    """Yield the modules of pharos that a file imports by absolute names, packages left out: they are lists of names."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [each.name for each in node.names]
        elif isinstance(node, ast.ImportFrom) and not node.level:
            names = [node.module or "", *(f"{node.module}.{each.name}" for each in node.names)]
        else:
            continue
        yield from (name for name in names if name in paths and paths[name].stem != "__init__")


def pages_for_users(root: Path) -> list[Path]:
    """Return the pages of the site but its records: decisions, what was measured, designs of studies."""
    docs = root / "docs"
    inside = {path: path.relative_to(docs).parts[0] for path in sorted(docs.rglob("*.md"))}
    return [path for path, folder in inside.items() if folder not in RECORDS]


def rows(root: Path) -> dict[str, str]:
    """Return the figures of a checkout, worded."""
    files = [path for paths in files_of(root).values() for path in paths]
    lines = {path: code_lines(text_of(path)) for path in files}
    trees = {path: tree_of(path) for path in files}
    nodes = [node for tree in trees.values() for node in ast.walk(tree)]
    long = [node for node in nodes if isinstance(node, FUNCTION) and parameters(node) > MANY_PARAMETERS]
    published = [public_names(trees[path]) for path in sorted((root / "src/pharos").glob("*/__init__.py"))]
    largest = max(lines, key=lines.__getitem__)
    groups = circles(root)
    tests = sum(code_lines(text_of(path)) for path in (root / "tests").rglob("*.py"))
    return {
        "code lines": f"{sum(lines.values()):,}",
        "files": f"{len(files)}",
        "code lines of a file, median": f"{statistics.median(lines.values()):.0f}",
        "code lines of a file, largest": f"{lines[largest]} ({largest.relative_to(root / 'src/pharos').as_posix()})",
        "public names of packages (`__all__`)": f"{sum(published)}",
        f"functions of more than {MANY_PARAMETERS} parameters": f"{len(long)}",
        "annotations that are plain `Any`": f"{sum(map(plain_any, trees.values()))}",
        "circles of imports (modules in them)": f"{len(groups)} ({sum(map(len, groups))})",
        "code lines of tests": f"{tests:,}",
        "lines of docs for users": f"{sum(len(text_of(path).splitlines()) for path in pages_for_users(root)):,}",
    }


def walk() -> tuple[list[str], list[str]]:
    """Return the files of which functions are called or compiled while a lake is built, solved and evaluated; and while
    Q-learning is trained on it, too. What runs as a file is loaded does not count.
    """
    import pharos

    source, passed = Path(pharos.__file__).parent, set()

    def note(frame, event, _):
        code, above = frame.f_code, frame.f_back
        if event != "call" or not code.co_filename.startswith(str(source)) or not code.co_flags & 1:
            return  # a flag of functions, which bodies of modules and classes lack
        while above is not None and not above.f_code.co_filename.startswith("<frozen importlib"):
            above = above.f_back
        if above is None and not code.co_name.startswith("<") and code.co_name != "__getattr__":
            passed.add(Path(code.co_filename))

    def compiled():
        from numba.core.dispatcher import Dispatcher

        kernels = [each.py_func for each in gc.get_objects() if isinstance(each, Dispatcher) and each.overloads]
        files = {Path(kernel.__code__.co_filename) for kernel in kernels}
        return {path for path in files if path.is_relative_to(source)}

    with tempfile.TemporaryDirectory() as folder:
        sys.setprofile(note)
        try:
            mdp = pharos.build(pharos.make("frozen_lake/8x8"), folder, progress=False).mdp(gamma=0.99)
            pharos.evaluate_policy(mdp, pharos.value_iteration(mdp).policy)
            to_values = passed | compiled()
            pharos.train("q_learning", "frozen_lake/8x8", steps=2000)
        finally:
            sys.setprofile(None)
    both = (to_values, passed | compiled())
    return tuple(sorted(path.relative_to(source).as_posix() for path in paths) for paths in both)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", type=Path, default=ROOT)
    parser.add_argument("--walk", action="store_true")
    arguments = parser.parse_args()
    if arguments.walk:
        to_values, to_regret = walk()
        print(f"to values, {len(to_values)} files:", *to_values)
        print(f"with training, {len(to_regret)} files:", *sorted(set(to_regret) - set(to_values)))
        return
    root = arguments.root.resolve()
    print("| package | code lines |\n|---|---|")
    for package, count in lines_by_package(root).items():
        print(f"| {package} | {count:,} |")
    print("\n| what | size |\n|---|---|")
    for name, figure in rows(root).items():
        print(f"| {name} | {figure} |")


if __name__ == "__main__":
    main()
