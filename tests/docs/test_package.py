"""What is published: one version, metadata, links that work on the index, and the other project of that name."""

import ast
import importlib
import importlib.util
import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import jinja2
import pytest
import yaml

import pharos
from pharos import errors
from pharos.system import lazy

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
README = (ROOT / "README.md").read_text()


def test_every_file_that_says_the_version_says_the_same():
    assert "version" in PROJECT["dynamic"]
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text())["version"] == pharos.__version__
    assert f'version = "{pharos.__version__}"' in (ROOT / "conda/meta.yaml").read_text()
    released = re.findall(r"^## (\S+)(?: - \d{4}-\d\d-\d\d)?$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert released[:2] == ["Unreleased", pharos.__version__]


@pytest.fixture(scope="module")
def recipe():
    """The recipe of conda, rendered as conda does: Jinja2, then YAML."""
    text = jinja2.Template((ROOT / "conda/meta.yaml").read_text(), undefined=jinja2.StrictUndefined)
    return yaml.safe_load(text.render(PYTHON="python"))


def test_the_conda_recipe_has_the_dependencies_of_the_core_and_no_others(recipe):
    required = {re.sub(r"(?<=\w)(?=[<>=])", " ", requirement, count=1) for requirement in PROJECT["dependencies"]}
    found = {requirement.removeprefix("python-") for requirement in recipe["requirements"]["run"]}
    assert found == required | {f"python {PROJECT['requires-python']}"}
    optional = [r for extra in PROJECT["optional-dependencies"].values() for r in extra]
    for requirement in recipe["requirements"]["run_constrained"]:
        assert requirement.replace("pytorch", "torch").replace(" ", "") in optional, requirement


def test_the_conda_recipe_builds_what_the_project_says(recipe):
    (build,) = tomllib.loads((ROOT / "pyproject.toml").read_text())["build-system"]["requires"]
    assert build.replace(">=", " >=") in recipe["requirements"]["host"]
    scripts = [f"{name} = {target}" for name, target in PROJECT["scripts"].items()]
    assert (recipe["build"]["entry_points"], recipe["build"]["noarch"]) == (scripts, "python")
    assert recipe["package"] == {"name": PROJECT["name"], "version": pharos.__version__}
    assert recipe["about"]["license"] == PROJECT["license"] and recipe["about"]["summary"] == PROJECT["description"]
    assert recipe["about"]["home"] == PROJECT["urls"]["Repository"]
    assert (ROOT / "conda" / recipe["source"]["path"]).resolve() == ROOT.resolve()


def test_extras_name_this_distribution():
    own = [r for extra in PROJECT["optional-dependencies"].values() for r in extra if r.startswith("pharos")]
    assert own and all(requirement.startswith("pharos-rl[") for requirement in own)


def test_hints_name_the_extra_and_which_torch():
    assert "pip install 'pharos-rl[study]'" in str(errors.MissingExtra("plotting", "matplotlib", "study"))
    hint = str(errors.MissingExtra("the agent 'dqn'", "stable-baselines3", "agents"))
    assert "CUDA" in hint and "pip install torch --index-url https://download.pytorch.org/whl/cpu" in hint
    assert "\n" not in hint and "download.pytorch.org/whl/cpu" in README


def test_the_index_shows_links_that_lead_somewhere():
    pytest.importorskip("setuptools")  # which setup.py imports, and Python 3.12 does not bring
    spec = importlib.util.spec_from_file_location("description", ROOT / "setup.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    text = module.absolute(README, "https://host/project")
    targets = re.findall(r"\]\(([^)\s]+)\)", text) + re.findall(r'src="([^"]+)"', text)
    assert len(targets) > 15 and all(target.startswith(("https://", "#")) for target in targets)
    assert "https://host/project/raw/main/docs/images/breakout.gif" in targets
    assert "https://host/project/blob/main/docs/cli.md" in targets


@pytest.mark.parametrize("folder", [".github/workflows", ".github/ISSUE_TEMPLATE"])
def test_workflows_and_templates_are_yaml(folder):
    files = sorted((ROOT / folder).glob("*.yml"))
    assert files and all(isinstance(yaml.safe_load(file.read_text()), dict) for file in files)


def test_issue_templates_have_the_keys_that_forms_know():
    for file in (ROOT / ".github/ISSUE_TEMPLATE").glob("[!c]*.yml"):
        form = yaml.safe_load(file.read_text())
        assert set(form) <= {"name", "description", "title", "labels", "assignees", "body"}
        for field in form["body"]:
            assert set(field) <= {"type", "id", "attributes", "validations"}
            assert set(field["attributes"]) <= {"label", "description", "placeholder", "value", "render"}, file.name
            assert all(isinstance(value, str) for value in field["attributes"].values()), file.name


def test_workflows_and_recipes_name_no_package_index():
    files = [*(ROOT / ".github/workflows").glob("*.yml"), ROOT / "conda/meta.yaml"]
    for file in files:
        assert not re.search(r"pypi\.org|pythonhosted|download\.pytorch|--(extra-)?index-url", file.read_text()), file


def test_the_source_distribution_leaves_nothing_out_but_packed_runs():
    tracked = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True)
    if tracked.returncode:
        pytest.skip("not a checkout")
    text = (ROOT / "MANIFEST.in").read_text()
    manifest = text.split()
    assert re.findall("^recursive-exclude (.*)$", text, re.M) == ["docs/studies *runs.parquet curves.parquet"]
    always = {"MANIFEST.in", "README.md", "LICENSE", "pyproject.toml", "setup.py", "src"}
    top = {line.split("/")[0] for line in tracked.stdout.splitlines()}
    assert not top - set(manifest) - always


def test_the_other_project_in_the_same_folder_is_told(tmp_path, monkeypatch):
    assert lazy.conflict() is None
    (tmp_path / "__version__.py").write_text('__version__ = "0.2.0"\n')
    wrong = lazy.conflict(tmp_path)
    assert "pip uninstall pharos pharos-rl; pip install pharos-rl" in wrong and "\n" not in wrong

    monkeypatch.setattr(lazy, "conflict", lambda folder=None: wrong)  # this one came last
    spec = importlib.util.spec_from_file_location("came_last", pharos.__file__)
    with pytest.warns(UserWarning, match="another project"):
        spec.loader.exec_module(importlib.util.module_from_spec(spec))


def test_the_command_tells_where_the_other_project_came_last(tmp_path):
    code = """
import importlib, sys, types
from pathlib import Path
sys.modules["pharos"] = other = types.ModuleType("pharos")
other.__path__ = [FOLDER]
from pharos.system import lazy
from pharos.cli import main
importlib.import_module("pharos.cli.app").conflict = lambda: lazy.conflict(Path(OTHER))
main()
""".replace("FOLDER", repr(str(Path(pharos.__file__).parent))).replace("OTHER", repr(str(tmp_path)))
    (tmp_path / "__version__.py").touch()
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 1 and "another project" in done.stderr and done.stderr.count("\n") == 1, done.stderr
    assert not done.stdout


@pytest.mark.slow
def test_an_installation_and_a_home_that_cannot_be_written_to(tmp_path):
    """A file in place of the home, which nobody can write into, whoever the user is."""
    shutil.copytree(ROOT / "src/pharos", tmp_path / "src/pharos", ignore=shutil.ignore_patterns("__pycache__"))
    (tmp_path / "home").touch()
    cache = tmp_path / "cache"
    there = {name: value for name, value in os.environ.items() if not name.startswith(("NUMBA", "XDG", "PHAROS"))}
    there |= {"PYTHONPATH": str(tmp_path / "src"), "HOME": str(tmp_path / "home"), "TMPDIR": str(tmp_path)}
    there |= {"PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, "-m", "pharos", "solve", "frozen_lake", "size=150", "seed=0", "--json"]  # compiles
    named = subprocess.run(command, env=there | {"PHAROS_CACHE_DIR": str(cache)}, capture_output=True, text=True)
    assert named.returncode == 0, named.stderr
    assert all(line.startswith("pharos: compiling ") for line in named.stderr.splitlines()), named.stderr
    assert list((cache / "compiled").glob("kernels-*/*.nbc")) and list((cache / "spaces").iterdir())
    assert {path.suffix for path in (tmp_path / "src").rglob("*") if path.is_file()}.isdisjoint(
        {".nbi", ".nbc", ".pyc"}
    )
    code = "import pharos.rules.exploration; from pharos.system import storage; print(storage.cache_directory().parent)"
    nowhere = subprocess.run([sys.executable, "-c", code], env=there, capture_output=True, text=True)
    assert nowhere.stdout == f"{tmp_path}\n" and "set PHAROS_CACHE_DIR" in nowhere.stderr, nowhere.stderr
    assert not list(tmp_path.glob("pharos-*"))


@pytest.mark.long
def test_commands_run_in_an_installation_that_is_mounted_to_be_read(tmp_path):
    """In a mount namespace of its own, where this user may make one; without a home."""
    mounted = ["unshare", "-m", "bash", "-c", 'mount --bind "$0" "$0" && mount -o remount,ro,bind "$0" && exec "$@"']
    mounted.append(str(Path(pharos.__file__).parents[1]))
    if shutil.which("unshare") is None or subprocess.run([*mounted, "true"], capture_output=True).returncode:
        pytest.skip("no mount namespace for this user")
    there = {name: value for name, value in os.environ.items() if not name.startswith(("NUMBA", "XDG"))}
    there |= {"HOME": "/proc/nohome", "PHAROS_CACHE_DIR": str(tmp_path / "cache"), "MPLBACKEND": "agg"}
    lake = "frozen_lake/4x4"
    (tmp_path / "own.yaml").write_text(
        f"name: own\nsteps: 100\nblocks: [{{environments: [{lake}], agents: [q_learning]}}]"
    )
    for words in (
        *(f"solve {lake}", f"hardness {lake} --measures diameter", f"train {lake} --steps 100 --out run"),
        *(f"evaluate {lake} --policy run", "benchmark submit run --out it.safetensors"),
        "benchmark verify it.safetensors",
        *("study run own.yaml --workers 1", "study status own.yaml"),
    ):
        command = [*mounted, sys.executable, "-m", "pharos", *words.split()]
        done = subprocess.run(command, env=there, cwd=tmp_path, capture_output=True, text=True)
        assert done.returncode == 0 and "Traceback" not in done.stderr, (words, done.stderr)


def test_pages_say_how_to_install_what_is_not_released_yet():
    """The index has the package from the first release on, which the changelog then names."""
    if not re.search(r"^## \[?\d", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE):
        for page in ("README.md", "docs/start.md"):
            assert "Before the first release: `pip install .` in a clone" in (ROOT / page).read_text(), page


@pytest.mark.long
def test_files_that_docstrings_name_are_there():
    there = {path.name for path in ROOT.rglob("*.py")} | {"file.py", "my_file.py"}
    for path in (ROOT / "src").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
                assert {*re.findall(r"\b(\w+\.py)\b", ast.get_docstring(node) or "")} <= there, path


@pytest.mark.long
@pytest.mark.parametrize("folder", ["benchmarks", "scripts"])
def test_scripts_import_what_is_there(folder):
    absent = []
    for path in sorted((ROOT / folder).glob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "pharos":
                for name in node.names:
                    if not _is_there(node.module, name.name):
                        absent.append(f"{path.name}: {node.module}.{name.name}")
    assert not absent


def _is_there(module, name):
    """Whether a module has an attribute or a module of the name."""
    try:
        return hasattr(importlib.import_module(module), name) or bool(importlib.util.find_spec(f"{module}.{name}"))
    except ModuleNotFoundError:
        return False
