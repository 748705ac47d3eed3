"""What the library says of numbers reads well at one, too; and in one spelling."""

import ast
import re
from pathlib import Path

import pytest

import pharos
from pharos.mdp import TabularMDP
from pharos.study.status import Status
from pharos.system.wording import in_words, pluralize


@pytest.mark.parametrize(
    ("count", "said"), [(0, "0 runs"), (1, "1 run"), (2, "2 runs"), (1234, "1,234 runs"), (10**6, "1,000,000 runs")]
)
def test_one_is_singular(count, said):
    assert pluralize(count, "run") == said


def test_irregular_nouns_are_given():
    assert (pluralize(1, "class", "classes"), pluralize(3, "class", "classes")) == ("1 class", "3 classes")


def test_one_run_one_state_and_one_action_are_singular():
    assert "1 state, 1 action," in repr(TabularMDP.from_arrays([[0]], [[1.0]]))
    assert "of 1 run finished" in str(Status("one", "studies/one", 1, 0, 0, 0, {}))


def test_names_are_spelt_as_prose_is():
    assert in_words("normalized_regret") == "normalised regret"


@pytest.mark.long
def test_prose_of_source_and_pages_has_one_spelling():
    source, docs = Path(pharos.__file__).parent, Path(__file__).parents[2] / "docs"
    prose = {path: path.read_text() for pattern in ("*.md", "*.ipynb") for path in docs.rglob(pattern)}
    prose |= {path: path.read_text() for path in source.rglob("*.html.j2")}
    for path in source.rglob("*.py"):
        texts = (node.value for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Constant))
        prose[path] = "\n".join(text for text in texts if isinstance(text, str) and " " in text)
    assert len(prose) > 200
    for path, text in prose.items():
        words = re.sub(r"^```.*?^```$|`[^`\n]*`", "", text, flags=re.MULTILINE | re.DOTALL)
        assert not re.search(r"(?<![\w.\"'])normaliz(ed|es?|ing|ation)(?![\w\"'(])", words, re.IGNORECASE), path
