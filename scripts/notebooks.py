"""Executes the tutorials, docs/tutorials/*.ipynb, and keeps what their cells print and draw in them.

python scripts/notebooks.py                          all of them, in place
python scripts/notebooks.py study own-loop           these
python scripts/notebooks.py --check study            compare what is printed with what is kept; 1 where it differs

No Jupyter is needed: a cell is Python, and its last expression is shown. What is drawn by matplotlib is kept as PNG.
"""

import ast
import base64
import contextlib
import io
import json
import linecache
import sys
import types
import warnings
from pathlib import Path

FOLDER = Path(__file__).parents[1] / "docs" / "tutorials"


def executed(document: dict, name: str) -> dict:
    """The notebook with the outputs of its cells, all run in one fresh namespace."""
    module = types.ModuleType(f"tutorial_{name.replace('-', '_')}")
    sys.modules[module.__name__] = module
    cells = []
    for number, entry in enumerate(document["cells"], start=1):
        if entry["cell_type"] != "code":
            cells.append(entry)
            continue
        source = "".join(entry["source"])
        outputs = outputs_of(source, f"<{name}, cell {number}>", vars(module))
        cells.append(
            {**entry, "execution_count": sum(each["cell_type"] == "code" for each in cells) + 1, "outputs": outputs}
        )
    return {**document, "cells": cells}


def outputs_of(source: str, file: str, namespace: dict) -> list[dict]:
    """Run a cell; what it printed, its last expression, and its figures."""
    linecache.cache[file] = (len(source), None, source.splitlines(keepends=True), file)
    tree = ast.parse(source)
    last = tree.body.pop() if tree.body and isinstance(tree.body[-1], ast.Expr) else None
    value = None
    with contextlib.redirect_stdout(io.StringIO()) as printed, warnings.catch_warnings():
        warnings.simplefilter("error")
        exec(compile(tree, file, "exec"), namespace)
        if last is not None:
            value = eval(compile(ast.Expression(last.value), file, "eval"), namespace)
    outputs = []
    if printed.getvalue():
        text = printed.getvalue().splitlines(keepends=True)
        outputs.append({"output_type": "stream", "name": "stdout", "text": text})
    if value is not None:
        data = {"text/plain": repr(value).splitlines(keepends=True)}
        outputs.append({"output_type": "display_data", "metadata": {}, "data": data})
    return outputs + figures()


def figures() -> list[dict]:
    """The open figures, which are closed."""
    pyplot = sys.modules.get("matplotlib.pyplot")
    found = []
    for number in pyplot.get_fignums() if pyplot else ():
        picture = io.BytesIO()
        pyplot.figure(number).savefig(picture, format="png", dpi=110, bbox_inches="tight", metadata={"Software": None})
        pyplot.close(number)
        data = {"image/png": base64.b64encode(picture.getvalue()).decode(), "text/plain": ["<Figure>"]}
        found.append({"output_type": "display_data", "metadata": {}, "data": data})
    return found


def printed_by(document: dict) -> list[str]:
    """The texts of all outputs, a picture being just that."""
    outputs = [output for entry in document["cells"] for output in entry.get("outputs", ())]
    return ["".join(output.get("text") or output["data"]["text/plain"]) for output in outputs]


def main() -> int:
    """Execute what is named."""
    import matplotlib

    matplotlib.use("agg")
    names = [name for name in sys.argv[1:] if not name.startswith("--")]
    differing = []
    for path in sorted(FOLDER.glob("*.ipynb")):
        if names and path.stem not in names:
            continue
        kept = json.loads(path.read_text(encoding="utf-8"))
        done = executed(kept, path.stem)
        if "--check" not in sys.argv:
            path.write_text(json.dumps(done, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
        elif printed_by(done) != printed_by(kept):
            differing.append(path.stem)
            print(path.stem, *printed_by(done), "is not what is kept:", *printed_by(kept), sep="\n", file=sys.stderr)
    return 1 if differing else 0


if __name__ == "__main__":
    sys.exit(main())
