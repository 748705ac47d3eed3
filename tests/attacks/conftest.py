"""What attacks count is printed at the end, whatever process counted it."""

import pytest


@pytest.fixture
def count(record_property):
    """count("120 damaged files: ..."): a line at the end of the tests."""
    return lambda line: record_property("attacks", line)


def pytest_terminal_summary(terminalreporter):
    """The lines."""
    lines = [line for report in terminalreporter.stats.get("passed", []) for _, line in report.user_properties]
    if lines:
        terminalreporter.section("attacks")
        terminalreporter.write_line("\n".join(lines))
