"""Scripts of benchmarks/ as modules, for tests of what they compute with."""

import importlib.util
from pathlib import Path

FOLDER = Path(__file__).parent.parent / "benchmarks"


def benchmark(name):
    """The script benchmarks/<name>.py, imported."""
    specification = importlib.util.spec_from_file_location(f"benchmark_{name}", FOLDER / f"{name}.py")
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module
