"""No test fails because a machine is slow: the one limit of waiting stands in `patience.py`, Hypothesis has none."""

import re
from pathlib import Path

from hypothesis import HealthCheck, settings

from patience import PATIENCE

TESTS = Path(__file__).parents[1]
LIMIT = re.compile(
    r"""timeout["']?[=:]\s*[\d.]+|\b(wait|join|alarm)\([1-9][\d.]*\)|deadline=|HealthCheck\."""
    r"""|ITIMER_REAL, (?!PATIENCE|0)\w+"""
)
OWN = {
    "benchmark/test_entries.py": ["ITIMER_REAL, 1e"],  # of the reading of an entry, which is what is tested
    "benchmark/test_profiles.py": ["timeout=0.2"],  # of an agent that hangs, which is what is tested
    "benchmark/test_jax_agents.py": ['timeout": 0.5'],  # as below
    "conftest.py": ["deadline=", "HealthCheck."],
    "study/test_study_execution.py": ["timeout=0.5"],  # of runs that never end, which is what is tested
}


def limits_in(text):
    return sorted({match[0] for match in LIMIT.finditer(text)})


def test_a_limit_is_found():
    assert limits_in("run(x, timeout=30); p.wait(60); {'timeout': 5}") == ["timeout': 5", "timeout=30", "wait(60)"]
    assert limits_in("signal.setitimer(signal.ITIMER_REAL, SECONDS)") == ["ITIMER_REAL, SECONDS"]
    assert not limits_in("run(x, timeout=PATIENCE); p.wait(); p.join(timeout=rng.uniform(1, 2))")


def test_tests_have_no_limits_of_their_own():
    found = {
        str(path.relative_to(TESTS)): limits_in(path.read_text())
        for path in TESTS.rglob("*.py")
        if path != Path(__file__)
    }
    assert PATIENCE >= 600
    assert {name: limits for name, limits in found.items() if set(limits) - set(OWN.get(name, ()))} == {}


def test_examples_and_what_draws_them_may_take_any_time():
    assert settings().deadline is None and HealthCheck.too_slow in settings().suppress_health_check
