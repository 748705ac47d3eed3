"""The Pharos Benchmark: frozen tasks that are known to the last state, agents on them, and scores with units.

A file is loaded when something in it is first used.
"""

from typing import TYPE_CHECKING

from pharos.system import lazy

if TYPE_CHECKING:
    from pharos.benchmark.results import AgentResults, baselines, read_results
    from pharos.benchmark.suite import BenchmarkTask, Ladder, Protocol, Suite, load_suite

__all__ = [
    "AgentResults",
    "BenchmarkTask",
    "Ladder",
    "Protocol",
    "Suite",
    "baselines",
    "load_suite",
    "read_results",
]
_shared = """
"""

__getattr__ = lazy.attributes(__name__)
