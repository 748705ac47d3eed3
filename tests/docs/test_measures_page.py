"""docs/hardness-measures.md has an entry for every measure of a report, and its witnesses exist."""

import re
from pathlib import Path

import pytest

from pharos import hardness

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "hardness-measures.md").read_text()
ENTRIES = dict(re.findall(r"^### (\w+)\n(.*?)(?=^##|\Z)", PAGE, re.MULTILINE | re.DOTALL))
BUILT_IN = [name for name, measure in hardness.measures().items() if measure.version is not None]


@pytest.mark.parametrize("name", BUILT_IN)
def test_every_measure_has_definition_source_cost_and_witness(name):
    assert name in ENTRIES, f"docs/hardness-measures.md has no entry `### {name}`: write one like those around it"
    entry = ENTRIES[name]
    for part in ("**Source.**", "**Witness.**"):
        assert part in entry, f"docs/hardness-measures.md, `### {name}`: no {part}"
    assert hardness.measures()[name].definition
    assert hardness.measures()[name].source


def test_the_page_describes_no_measure_that_is_not_there():
    assert set(ENTRIES) <= set(BUILT_IN)


def test_witnesses_are_files_of_tests():
    named = re.findall(r"`(test_\w+\.py)`", PAGE)
    assert len(named) >= len(BUILT_IN) / 2
    for name in named:
        file = ROOT / "tests" / "hardness" / name
        assert file.exists(), f"docs/hardness-measures.md names {name} as a witness: write tests/hardness/{name}"
        assert "def test_" in file.read_text(), name
