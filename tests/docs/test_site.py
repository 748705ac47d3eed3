"""The documentation site: pages say what is so, links lead somewhere, tutorials run; `make docs` builds it strictly."""

import contextlib
import dataclasses
import importlib
import io
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from patience import PATIENCE
from pharos.environments import class_called, named_instances
from pharos.environments.built_in import BUILT_IN
from pharos.explorer.pages import MOST_POSITIONS

ROOT = Path(__file__).parents[2]
DOCS, SCRIPTS = ROOT / "docs", ROOT / "scripts"
BLOCK = re.compile(r"^```python\n(.*?)^```\n(?:```text\n(.*?)^```\n)?", re.MULTILINE | re.DOTALL)
TUTORIALS = sorted((DOCS / "tutorials").glob("*.ipynb"))


@pytest.fixture(scope="module")
def scripts():
    """Imports a script."""
    sys.path.insert(0, str(SCRIPTS))
    yield importlib.import_module
    sys.path.remove(str(SCRIPTS))


def links_of(text):
    """Targets in the prose of a page."""
    prose = re.sub(r"^```.*?^```$|`[^`\n]*`", "", text, flags=re.MULTILINE | re.DOTALL)
    return re.findall(r"\]\(([^)\s]+)\)", prose) + re.findall(r'src="([^"]+)"', prose)


def anchors_of(text):
    """What a page can be entered at: its headings, as the site and code hosts number them."""
    titles = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    plain = [re.sub(r"`|\*|\[|\]\([^)]*\)", "", title).lower() for title in titles]
    return {re.sub(r"[^\w\- ]", "", title).replace(" ", "-") for title in plain}


PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(DOCS.rglob("*.md"))]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_links_of_pages_lead_somewhere(page):
    for link in links_of(page.read_text()):
        path, _, anchor = link.partition("#")
        if "://" in path or path.startswith("mailto:"):
            continue
        target = page.parent / path if path else page
        is_left_out = (ROOT / "PKG-INFO").exists() and path.endswith("runs.parquet")  # of a source distribution
        assert target.exists() or is_left_out, link
        if anchor and target.suffix == ".md":
            assert anchor in anchors_of(target.read_text()), link


@pytest.mark.long
def test_the_code_of_the_first_page_prints_what_it_says():
    name, namespace, compared = "start.md", {}, 0
    for code, expected in BLOCK.findall((DOCS / name).read_text()):
        with contextlib.redirect_stdout(io.StringIO()) as printed:
            exec(compile(code, name, "exec"), namespace)
        assert printed.getvalue() == expected
        compared += bool(expected)
    assert compared >= 6


@pytest.mark.long
@pytest.mark.parametrize("name", [path.stem for path in TUTORIALS])
def test_tutorials_print_what_they_show(name):
    done = subprocess.run(
        [sys.executable, str(SCRIPTS / "notebooks.py"), "--check", name],
        **{"capture_output": True, "text": True, "timeout": PATIENCE, "env": {**os.environ, "MPLBACKEND": "agg"}},
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.long
@pytest.mark.parametrize("path", TUTORIALS, ids=lambda path: path.stem)
def test_tutorials_run_as_scripts(path, tmp_path):
    """Saved as a file, without a guard, they print what the notebooks show."""
    cells = [cell for cell in json.loads(path.read_text())["cells"] if cell["cell_type"] == "code"]
    (tmp_path / "script.py").write_text("\n\n".join("".join(cell["source"]) for cell in cells))
    done = subprocess.run(
        [sys.executable, "script.py"],
        **{"cwd": tmp_path, "capture_output": True, "text": True, "timeout": PATIENCE},
        env={**os.environ, "MPLBACKEND": "agg"},
    )
    assert done.returncode == 0 and "Traceback" not in done.stderr, done.stderr
    shown = [output for cell in cells for output in cell["outputs"] if output.get("name") == "stdout"]
    assert done.stdout == "".join("".join(output["text"]) for output in shown)


FRAGMENTS = {"format.md", "large-runs.md"}  # the first is run by test_format_page.py
SCRIPTS_OF_PAGES = [page for page in PAGES if BLOCK.search(page.read_text()) and page.name not in FRAGMENTS]
LAKE_STUDY = """
name: lakes
steps: 200
evaluations: 2
seeds: 2
hardness: {measures: [diameter]}
blocks: [{environments: [frozen_lake/4x4], agents: [q_learning]}]
"""
FEWER = ((r"steps=[\d_]+", "steps=600"), (r"learn\([\d_]+\)", "learn(300)"), (r"range\(64\)", "range(3)"))
BEFORE = {
    "benchmark.md": "from pharos import benchmark\ntask = benchmark.load_suite().core[0].name\n"
    "benchmark.run('random', out='results/mine', seeds=[0], tasks=[task])\n",
    "importing.md": "import numpy as np\nimport pharos\nP, R = [np.eye(2), np.eye(2)[[1, 0]]], np.eye(2)\n",
    "benchmark-rules.md": "import pharos\npharos.train('q_learning', 'frozen_lake/4x4', steps=200, out='runs/lake')\n",
    "regret.md": "import pharos\npharos.train('dqn', 'frozen_lake/4x4', steps=200, random=0.1, out='runs/dqn-0')\n",
}


@pytest.mark.long
@pytest.mark.parametrize("page", SCRIPTS_OF_PAGES, ids=lambda page: page.name)
def test_the_code_of_a_page_runs_as_a_script(page, tmp_path):
    """Saved as a file, without a guard; with what the page says is there already, and fewer steps of training."""
    shutil.copy(ROOT / "tests/data/bridge/freeway_10_fs30.npz", tmp_path)
    (tmp_path / "lakes.yaml").write_text(LAKE_STUDY)
    code = "\n\n".join(block for block, _ in BLOCK.findall(page.read_text()))
    for pattern, less in FEWER:
        code = re.sub(pattern, less, code)
    (tmp_path / "script.py").write_text(BEFORE.get(page.name, "") + code)
    done = subprocess.run(
        [sys.executable, "script.py"],
        **{"cwd": tmp_path, "capture_output": True, "text": True, "timeout": PATIENCE},
        env={**os.environ, "MPLBACKEND": "agg", "PHAROS_CACHE_DIR": str(tmp_path / "cache")},
    )
    assert done.returncode == 0 and "Traceback" not in done.stderr, done.stderr


def test_there_are_tutorials_and_all_have_been_executed():
    assert len(TUTORIALS) >= 5
    for path in TUTORIALS:
        notebook = json.loads(path.read_text())
        assert notebook["nbformat"] == 4
        counts = [cell["execution_count"] for cell in notebook["cells"] if cell["cell_type"] == "code"]
        assert counts == list(range(1, len(counts) + 1)), path.name


def test_stored_numbers_of_environments_are_of_todays_rules(scripts):
    numbers = scripts("environment_numbers")
    stored = json.loads(numbers.FILE.read_text())
    for name, entry in stored.items():
        assert name in named_instances(), f"{name}: python scripts/environment_numbers.py"
        for part, value in numbers.key_of(name).items():
            assert entry[part] == value, f"{name}: python scripts/environment_numbers.py {name}"
    for name in ("simple_grid/4x4-decoy", "frozen_lake/4x4"):
        assert numbers.numbers_of(name, 1000) == stored[name]


def test_every_named_instance_has_values_or_a_reason_why_not(scripts):
    stored = json.loads((DOCS / "environments.json").read_text())
    without = {name for name in named_instances() if "discounted" not in stored.get(name, {})}
    assert without == set(scripts("site_pages").NOT_COMPUTED)
    assert all(stored[name]["more_than"] for name in without)


def test_each_of_the_two_games_has_an_instance_for_a_page_of_the_explorer():
    stored = json.loads((DOCS / "environments.json").read_text())
    for game in ("breakout", "freeway"):
        sizes = [
            entry["num_states"] for name, entry in stored.items() if name.startswith(game) and "num_states" in entry
        ]
        assert min(sizes) <= MOST_POSITIONS


def test_stored_values_are_in_order():
    for name, entry in json.loads((DOCS / "environments.json").read_text()).items():
        for kind in ("discounted", "episode"):
            if kind in entry:
                value = entry[kind]
                assert value["worst"] <= value["uniform"] + 2e-6 <= value["optimal"] + 4e-6, name


def test_every_environment_has_a_page(scripts):
    pages = scripts("site_pages").environments()
    for name in (entry.name for entry in BUILT_IN):
        cls = class_called(name)
        page = pages[f"environments/{name}.md"]
        for heading in ("Rules", "Parameters", "Named instances", "What agents see", "Versions"):
            assert f"\n## {heading}\n" in page, (name, heading)
        paragraphs = page.count("\n| **")
        assert paragraphs >= 3, f"the docstring of {name} needs paragraphs such as State, Actions, Reward, Ends, Source"
        for instance in cls.instances:
            assert f"| `{name}/{instance}` |" in page
        assert f"{name}.html" in pages["environments/index.md"]


@pytest.mark.slow
def test_no_cell_of_the_numbers_is_empty_and_what_was_not_enumerated_says_so(scripts):
    pages = scripts("site_pages").environments()
    for page in pages.values():
        for line in page.partition("## Named instances")[2].partition("\n## ")[0].splitlines():
            assert not line.startswith("|") or all(cell.strip() for cell in line.split("|")[1:-1]), line
    values = pages["environments/values.md"]
    stored = json.loads((DOCS / "environments.json").read_text())
    assert all(values.count(f"[`{name}`]") == 1 for name in stored)


def test_counts_of_the_site_are_those_of_the_docs_and_of_what_was_enumerated(scripts):
    stored = json.loads((DOCS / "environments.json").read_text())
    for name, (states, page) in scripts("site_pages").COUNTED.items():
        assert f"{states:,}" in (DOCS / page).read_text(), name
        assert stored[name].get("num_states", states) == states, name
        assert stored[name].get("more_than", 0) < states, name


def test_worlds_on_the_page_for_newcomers_are_there():
    """Code in the right columns: an instance or a class, with parameters that it has."""
    spans = re.findall(r"`([a-z0-9_]+(?:/[\w-]+)?)((?: \w+=[\w.]+)*)`", (DOCS / "coming-from.md").read_text())
    worlds = {entry.name for entry in BUILT_IN}
    checked = [(name, words) for name, words in spans if name.split("/")[0] in worlds]
    assert len(checked) > 30
    for name, words in checked:
        assert name in worlds or name in named_instances(), name
        fields = {field.name for field in dataclasses.fields(class_called(name.split("/")[0]))}
        assert set(re.findall(r"(\w+)=", words)) <= fields, (name, words)


def test_the_reference_has_every_published_name_once(scripts):
    pages = scripts("site_pages").reference()
    text = "\n".join(pages.values())
    homes = re.findall(r"^::: (\S+)$", text, re.MULTILINE)
    assert len(homes) == len(set(homes)) > 150
    assert "heading: pharos.value_iteration" in pages["api/pharos.md"]


def test_faults_of_a_built_site_are_found(scripts, tmp_path):
    (tmp_path / "there.html").write_text('<h1 id="top"></h1>')
    page = tmp_path / "page.html"
    page.write_text('<a href="there.html#top"></a><img src="data:,x"><a href="https://elsewhere.org"></a>')
    faults = scripts("build_site").faults
    assert faults(tmp_path) == []
    wrongs = ('<a href="gone.html">', '<a href="there.html#gone">', '<script src="https://elsewhere.org/x.js">')
    run_together = ("<p>one of\n- <code>this</code>;\n- that</p>", "<p>Error ├── Lost</p>", "V<em>(s) - Q</em>(s)")
    for wrong in (*wrongs, *run_together):
        page.write_text(wrong)
        assert len(faults(tmp_path)) == 1, wrong


def test_a_list_right_below_a_paragraph_is_one_on_the_site(scripts):
    text = "One of\n- this;\n  and more\n- that.\n\n```\na\n- b\n```\n\n- c\n"
    staged = scripts("build_site").relinked(text, Path("docs/a.md"), "a.md")
    assert staged == text.replace("of\n-", "of\n\n-")
