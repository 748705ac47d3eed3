"""The generated pages of the site: one for each environment, the reference of the API, tutorials, lists of pages.

Each function returns name -> text, or bytes of a picture, in the order of the navigation.
"""

import base64
import contextlib
import importlib
import inspect
import io
import itertools
import json
import re
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import pharos
from pharos import benchmark
from pharos.benchmark.charts import frontier_text
from pharos.benchmark.contents import number
from pharos.cli.list import list_, rules_of
from pharos.environments import classes, make
from pharos.interaction.registration import ids_of

DOCS = Path(__file__).parents[1] / "docs"
BOARD = "<!-- The site has the board of baselines here: scripts/site_pages.py. -->"
MORE = {  # pages that say more of a class
    **dict.fromkeys(("frozen_lake", "taxi", "cliff_walking", "blackjack"), "worlds.md#toy-text"),
    **{"sliding_tiles": "worlds.md#sliding-tiles", "pocket_cube": "worlds.md#pocket-cube"},
    **{"sokoban": "worlds.md#sokoban", "mini_grid": "worlds.md#minigrid", "river_swim": "worlds.md#river-swim"},
    **dict.fromkeys(("mini_grid_empty", "mini_grid_rooms"), "worlds.md#colosseums-grids"),
    **dict.fromkeys(("deep_sea", "catch", "memory_chain", "umbrella_chain", "discounting_chain"), "worlds.md#bsuite"),
    **dict.fromkeys(("endless_sea", "corner_grid"), "worlds.md#chains-rivers-and-seas"),
    "delayed_choice": "worlds.md#delayed-choice",
    "game_2048": "worlds.md#2048",
}
CHANGES = {  # class -> version of the rules -> what changed
    "breakout": {
        1: "Never released. The paddle's edge sent the ball straight back, so that some walls could not be cleared.",
        2: "The paddle's edge sends the ball one column back ([why](../decisions/0004-breakout-edges.md)).",
    }
}
COUNTED = {  # instance -> states, and the page that tells how they were counted, where its values were never computed
    "sliding_tiles/3x4": (239_500_800, "worlds.md"),
    **{f"pocket_cube/{name}": (3_674_160, "worlds.md") for name in ("half", "quarter", "half-4", "quarter-4")},
    "game_2048/3x3": (48_713_519, "worlds.md"),
    "game_2048/3x3-to-256": (7_270_259, "worlds.md"),
    "mini_grid/key-corridor-s5r3": (5_582_592, "worlds.md"),
    "mini_grid/key-corridor-s6r3": (16_844_288, "worlds.md"),
    "freeway/25x13-speed1": (3_001_973, "evidence/paper-grid.md"),
    "breakout/20x10x1-3rows": (923_305_259, "evidence/performance.md"),
    "breakout/30x10x1-3rows": (1_083_934_871, "evidence/performance.md"),
}
NOT_COMPUTED = {  # instance -> why its values are not there
    "breakout/20x10x1-3rows": "V\\* is 3.580966, within 2.2e-8: 1,328 s, and 10.4 GiB of memory beside mapped files "
    "([performance](../evidence/performance.md)). The uniform and the worst policy were not solved",
    "breakout/30x10x1-3rows": "V\\* is 2.212515, within 4.5e-9 ([performance](../evidence/performance.md)). The "
    "uniform and the worst policy were not solved",
    "sliding_tiles/3x4": "enumerated once ([302 s of a processor, 5.8 GB of files](../large-runs.md)), not solved",
    "game_2048/3x3": "541,821,326 possible outcomes, 33 minutes to enumerate. Undiscounted, the optimum is worth "
    "5,468.49 ([2048](../evidence/worlds.md#2048)). The uniform and the worst policy were not solved",
    **{
        f"game_2048/3x3-to-{target}": f"tens of millions of states with up to 16 outcomes. The optimum wins "
        f"with probability {chance} ([2048](../evidence/worlds.md#2048)). The uniform and the worst policy were not "
        "solved"
        for target, chance in ((512, 0.736774), (1024, 0.011338))
    },
}
LIVE = {  # page -> the explorer that it shows
    "explorer.md": ("assets/explorer/frozen_lake.html", "Explorer of a slippery lake", "52rem"),
    "index.md": ("assets/explorer/frozen_lake-8x8.html", "Explorer of frozen_lake/8x8", "36rem"),
}
MARK = "<!-- The site has it live here: scripts/site_pages.py, explorer. -->"
POLICIES = ("optimal", "uniform", "worst")
VALUES = (
    "You read values at the start, of the optimal, the uniformly random and the worst policy. *Discounted*: by 0.99, "
    "without a limit. *Of an episode*: undiscounted, of as many steps as its limit. There is a dash if states, actions "
    "and steps multiply to more than 10^10: then it was not computed. Each is within 1e-6, rounded to six digits."
)
UNKNOWN = "–"
VALUES_HEAD = (
    "| instance | states | limit | V\\*, discounted | uniform | worst | V\\* of an episode | uniform | worst |\n"
    "|---|--:|--:|--:|--:|--:|--:|--:|--:|"
)
PACKAGES = {  # page of the reference -> (title, module)
    "pharos": ("pharos", "pharos"),
    "environments": ("pharos.environments", "pharos.environments"),
    "state_space": ("pharos.state_space", "pharos.state_space"),
    "mdp": ("pharos.mdp", "pharos.mdp"),
    "solvers": ("pharos.solvers", "pharos.solvers"),
    "hardness": ("pharos.hardness", "pharos.hardness"),
    "observations": ("pharos.observations", "pharos.observations"),
    "interaction": ("pharos.interaction", "pharos.interaction"),
    "policies": ("pharos.policies", "pharos.policies"),
    "agents": ("pharos.agents", "pharos.agents"),
    "training": ("pharos.training", "pharos.training"),
    "benchmark": ("pharos.benchmark", "pharos.benchmark"),
    "study": ("pharos.study", "pharos.study"),
    "prediction": ("pharos.prediction", "pharos.prediction"),
    "plots": ("pharos.plots", "pharos.plots"),
    "importers": ("pharos.importers", "pharos.importers"),
    "exporters": ("pharos.exporters", "pharos.exporters"),
    "bisimulation": ("pharos.bisimulation", "pharos.bisimulation"),
    "errors": ("pharos.errors", "pharos.errors"),
}


# Environments ---------------------------------------------------------------------------------------------------------


def environments() -> dict[str, str]:
    """A page for each class, and one that shows them all."""
    stored = json.loads((DOCS / "environments.json").read_text())
    gallery = rows_of((DOCS / "worlds.md").read_text().partition("## Pictures\n")[2])
    pages = {f"environments/{name}.md": page_of(cls, stored, gallery.get(name, "")) for name, cls in classes().items()}
    cards = [card_of(cls, stored, gallery.get(name, "")) for name, cls in classes().items()]
    index = (
        "# Environments\n\nEvery state of these can be enumerated, so the optimum, the hardness and the regret of your "
        "agent are numbers. Each is a class with parameters. The named instances are known from the paper, Gymnasium, "
        "MiniGrid and bsuite. If you want your own: [adding an environment](../adding-an-environment.md).\n\n"
        '<div class="cards" markdown="0">\n' + "\n".join(cards) + "\n</div>\n"
    )
    return {"environments/index.md": index, "environments/values.md": values_of_all(stored), **pages}


def values_of_all(stored: Mapping[str, dict]) -> str:
    """One table of every named instance."""
    known = {name: row for name, numbers in stored.items() if (row := values_row(name, numbers))}
    return "\n".join(
        [
            "# Values of every instance",
            "",
            f"{VALUES} Instances whose values were not computed for this page are listed below. The same in JSON: "
            "[environments.json](../environments.json).",
            "",
            VALUES_HEAD,
            *known.values(),
            "",
            "## Without values",
            "",
            "Use `pharos solve` to compute them, [as far as memory and disk go](../evidence/performance.md).",
            "",
            "| instance | states | why |",
            "|---|---|---|",
            *(
                f"| {page_link(name)} | {states_of(name, stored[name])} | {NOT_COMPUTED[name]} |"
                for name in stored
                if name not in known
            ),
            "",
        ]
    )


def page_link(name: str) -> str:
    """An instance, as a link to the page of its class."""
    return f"[`{name}`]({name.split('/')[0]}.md)"


def states_of(name: str, numbers: Mapping) -> str:
    """How many states an instance has, as far as that is known."""
    if "num_states" in numbers:
        return f"{numbers['num_states']:,}"
    if name in COUNTED:
        states, page = COUNTED[name]
        return f"{states:,} ([counted](../{page}))"
    return f"more than {numbers['more_than']:,}, not enumerated" if numbers else "not enumerated"


def values_row(name: str, numbers: Mapping) -> str | None:
    """The values of an instance, as a row; None where they are not known."""
    if "num_states" not in numbers:
        return None
    found = [numbers.get(kind, {}).get(policy) for kind in ("discounted", "episode") for policy in POLICIES]
    texts = (UNKNOWN if value is None else f"{value + 0.0:.6g}" for value in found)
    return f"| {page_link(name)} | {numbers['num_states']:,} | {numbers['episode_limit']:,} | {' | '.join(texts)} |"


def rows_of(text: str) -> dict[str, str]:
    """Class -> its row, of the gallery."""
    return {cls: row for row, cls in re.findall(r"^(\| \*\*(\w+)\*\* .*)$", text, re.MULTILINE)}


def animations(section: str) -> list[tuple[str, str]]:
    """(instance, file), of the pictures that move in a section of the gallery."""
    return re.findall(r"!\[([^]]+)\]\((gallery/[^)]+\.gif)\)", section)


def described(cls) -> dict:
    """What `pharos list NAME --json` says."""
    answer = io.StringIO()
    with contextlib.redirect_stdout(answer):
        list_(cls.name).say(json=True)
    return json.loads(answer.getvalue())


def card_of(cls, stored: Mapping[str, dict], section: str) -> str:
    """A cell of the list of environments, in HTML: the pages are beside it."""
    own = {name: numbers for name, numbers in stored.items() if name.split("/")[0] == cls.name}
    states = [numbers.get("num_states", COUNTED.get(name, (0,))[0]) for name, numbers in own.items()]
    states = [number for number in states if number]
    moving = animations(section)
    picture = f'<a href="{cls.name}.html"><img src="../{moving[0][1]}" alt="{cls.name}"></a>' if moving else ""
    span = " to ".join(f"{number:,}" for number in dict.fromkeys((min(states), max(states)))) if states else "many"
    first = described(cls)["description"]
    title = f'<a href="{cls.name}.html"><b>{cls.__name__}</b></a>'
    return f"<div>{picture}<p>{title}</p><p>{first}</p><p>{span} states</p></div>"


def page_of(cls, stored: Mapping[str, dict], section: str) -> str:
    """The page of a class."""
    facts = described(cls)
    first_id = next(iter(ids_of(cls)))
    counts = {name: stored.get(name, {}).get("num_states", 1 << 62) for name in facts["instances"]}
    smallest = max(counts, key=lambda name: (-counts[name], name)) if counts else cls.name
    lines = [f"# {cls.__name__}", "", facts["description"], ""]
    if moving := animations(section):
        pictures = [f'![{name}, played optimally](../{file}){{ .pixels title="{name}" }}' for name, file in moving]
        played = ", ".join(f"`{name}`" for name, _ in moving)
        lines += [" ".join(pictures), "", f"*The optimal policy of {played}.*", ""]
    lines += [
        "```python",
        "import gymnasium, pharos",
        "",
        f'env = gymnasium.make("{first_id}")  # to step',
        f'space = pharos.build("{smallest}")  # every state',
        "pharos.value_iteration(space.mdp(gamma=0.99)).value_at_start",
        "```",
        "",
        "## Rules",
        "",
        *rules_table(cls),
        "",
        f"**Actions**, in the order of their numbers: {', '.join(f'`{name}`' for name in facts['actions'])}.",
        "",
        "## Parameters",
        "",
        "| parameter | default | values | meaning |",
        "|---|---|---|---|",
    ]
    for name, entry in facts["parameters"].items():
        lines.append(f"| `{name}` | `{cell(entry['default'])}` | {cell(entry['values'])} | {cell(entry['meaning'])} |")
    lines += ["", *instances(cls, stored), "## What agents see", "", observations(section), ""]
    lines += ["## Versions", "", *versions(cls), ""]
    if cls.name in MORE:
        lines += [f"More of this class, and where its numbers come from: [worlds one by one](../{MORE[cls.name]}).", ""]
    return "\n".join(lines)


def cell(value) -> str:
    """Text for a cell of a table."""
    text = "none" if value is None else str(value).lower() if isinstance(value, bool) else str(value)
    return text.replace("|", r"\|").replace("\n", " ")


def rules_table(cls) -> list[str]:
    """The rules of a class: paragraphs, and a table of entries such as *State* and *Reward*."""
    lines: list[str] = []
    for titled, group in itertools.groupby(rules_of(cls)[1:], lambda block: bool(block[0])):
        if titled:
            lines += ["| | |", "|---|---|", *(f"| **{title}** | {cell(text)} |" for title, text in group), ""]
        else:
            lines += [line for _, text in group for line in (text, "")]
    return lines[:-1]


def instances(cls, stored: Mapping[str, dict]) -> list[str]:
    """The table of named instances, with counts and values at the start."""
    ids = {name: gymnasium_id for gymnasium_id, name in ids_of(cls).items()}
    counted = ["| instance | Gymnasium id | states | terminal | depth |", "|---|---|--:|--:|--:|"]
    values, unknown = [VALUES_HEAD], []
    for instance in cls.instances:
        name = f"{cls.name}/{instance}"
        numbers = stored.get(name, {})
        start = f"| `{name}` | `{ids[name]}` |"
        if (row := values_row(name, numbers)) is None:
            counted.append(f"{start} {states_of(name, numbers)} | {UNKNOWN} | {UNKNOWN} |")
            unknown.append(f"- `{name}`: {NOT_COMPUTED[name]}.")
            continue
        parts = ("num_states", "num_terminal_states", "depth")
        counted.append(f"{start} " + " | ".join(f"{numbers[part]:,}" for part in parts) + " |")
        values.append(row)
    about = f"*Depth* is how far the farthest state is from the start. {VALUES}"
    absent = []
    if unknown:
        absent = ["Not computed for this page:", "", *unknown, ""]
    if len(values) > 1:
        absent = [*values, "", *absent]
    return ["## Named instances", "", *counted, "", about, "", *absent]


def observations(section: str) -> str:
    """The pictures of the gallery: what people and agents see."""
    if not section:
        return "The observations of every class: [observations](../observations.md)."
    pictures = section.split(" | ")[1].replace("](gallery/", "](../gallery/").split("<br>")
    about = (
        "From the left: the drawing for people, the complex image at its natural size and at 84 x 84 pixels, and the "
        "planes of the simple image, one for each layer, named in their order, after some steps of the optimal policy. "
        "[More](../observations.md).\n\n"
    )
    return about + "\n".join(f"- {each}" for each in pictures)


def versions(cls) -> list[str]:
    """The versions of the rules, and the Gymnasium ids that stand for them."""
    told = CHANGES.get(cls.name, {})
    lines = ["| rules | Gymnasium ids | |", "|---|---|---|"]
    for version in range(cls.version, 0, -1):
        ids = f"`-v{version - cls.first_version}`" if version >= cls.first_version else "none"
        lines.append(f"| version {version} | {ids} | {told.get(version, 'The first.')} |")
    return lines


# Reference ------------------------------------------------------------------------------------------------------------


def explorer() -> dict[str, str | bytes]:
    """Explorers as files: a small lake with what Q-learning has learnt there too soon; the lake of the home page."""
    with tempfile.TemporaryDirectory() as folder:
        run = pharos.train("q_learning", make("frozen_lake", slippery=True), steps=4000, seed=3, out=f"{folder}/run")
        pages: dict[str, str | bytes] = {}
        for page, target in (("explorer.md", run.folder), ("index.md", "frozen_lake/8x8")):
            file = pharos.explore(target, out=f"{folder}/page.html")
            pages[LIVE[page][0]] = Path(file).read_bytes()
    return pages


def live(page: str, text: str) -> str:
    """A page with its explorer in the place of the mark."""
    file, title, height = LIVE[page]
    frame = f'<iframe src="{file}" title="{title}" loading="lazy" class="live" style="height: {height}"></iframe>'
    return text.replace(MARK, f"{frame}\n\n[Open it alone]({file})")


def board(suite: benchmark.Suite, agents: Sequence[benchmark.AgentResults]) -> str:
    """Table of agents on a suite, the best core first: score of the core, frontiers, digest and seeds."""
    scores = {each.agent: benchmark.score(each, suite) for each in agents}
    axes = [ladder.axis for ladder in suite.ladders]
    heads = ["agent", "core", *(f"{ladder.axis} ({ladder.unit})" for ladder in suite.ladders), "seeds"]
    lines = ["| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
    for each in sorted(agents, key=lambda each: scores[each.agent].rank):
        own = scores[each.agent]
        frontiers = [frontier_text(own.axes[axis].frontier) if axis in own.axes else "–" for axis in axes]
        lines.append("| " + " | ".join([each.agent, number(own.core), *frontiers, str(len(each.seeds))]) + " |")
    return "\n".join([*lines, "", f"Suite {suite.name}, digest `{suite.digest}`."])


def baseline_board() -> str:
    """The board of the shipped baselines of v1."""
    if not benchmark.baselines("v1"):
        return "No baselines are shipped yet."
    return board(benchmark.load_suite("v1"), [benchmark.read_results(name) for name in benchmark.baselines("v1")])


def reference() -> dict[str, str]:
    """A page for each package, with an entry for every name that it publishes."""
    pages, lines = (
        {},
        ["# API", "", "In the order of the data flow. Import names from the package that the page says.", ""],
    )
    shown: dict[str, str] = {}  # where it is defined -> under which name it has its entry
    for page, (title, module_name) in PACKAGES.items():
        module = importlib.import_module(module_name)
        about = (module.__doc__ or "").strip()
        entries = []
        for name in published(module):
            value = getattr(module, name)
            home = home_of(value)
            if home is None:
                continue
            if home in shown:
                entries.append(f"## {title}.{name} {{ .doc-heading }}\n\nThe same as [`{shown[home]}`][{home}].\n")
                continue
            shown[home] = f"{title}.{name}"
            options = f"    options:\n      heading: {title}.{name}\n      toc_label: {name}\n"
            entries.append(f"::: {home}\n{options}")
        if page == "environments":
            worlds = ", ".join(f"[`{cls.__name__}`](../environments/{name}.md)" for name, cls in classes().items())
            about += f"\n\nThe classes, each with a page of its own: {worlds}."
        pages[f"api/{page}.md"] = f"# {title}\n\n{about}\n\n" + "\n".join(entries)
        lines.append(f"- [`{title}`]({page}.md): {first_sentence(about)}")
    return {"api/index.md": "\n".join(lines) + "\n", **pages}


def published(module) -> list[str]:
    """The names that have an entry: functions and classes."""
    names = getattr(module, "__all__", None)
    if names is None:  # a module of classes, such as errors
        names = [name for name, value in vars(module).items() if getattr(value, "__module__", "") == module.__name__]
    return [name for name in names if not name.startswith("_") and not inspect.ismodule(getattr(module, name))]


def home_of(value) -> str | None:
    """Where a function or class is defined; None for values."""
    value = inspect.unwrap(value) if callable(value) else value
    if not (inspect.isclass(value) or inspect.isfunction(value)):
        return None
    if not value.__module__.startswith("pharos"):
        return None
    return f"{value.__module__}.{value.__qualname__}"


def first_sentence(text: str) -> str:
    """Up to the first full stop."""
    return re.split(r"(?<=\.)\s", " ".join(text.split()), maxsplit=1)[0]


# Tutorials and decisions ----------------------------------------------------------------------------------------------


def tutorials(folder: Path) -> dict[str, str | bytes]:
    """Notebooks as pages, with what their cells print and draw."""
    pages: dict[str, str | bytes] = {}
    lines = ["# Tutorials", "", "Notebooks, executed by the tests. Each takes you a few minutes.", ""]
    for path in sorted(folder.glob("*.ipynb")):
        text, pictures = notebook(json.loads(path.read_text(encoding="utf-8")), path.stem)
        pages[f"tutorials/{path.stem}.md"] = text
        pages |= {f"tutorials/{name}": data for name, data in pictures.items()}
        title, about = re.match(r"# (.*)\n+((?:.+\n)+)", text).groups()  # the first paragraph
        lines.append(f"- [{title}]({path.stem}.md): {' '.join(about.split())}")
    return {"tutorials/index.md": "\n".join(lines) + "\n", **pages}


def notebook(document: dict, stem: str) -> tuple[str, dict[str, bytes]]:
    """(Markdown, pictures by name)."""
    parts, pictures = [], {}
    for entry in document["cells"]:
        source = "".join(entry["source"])
        if entry["cell_type"] == "markdown":
            parts.append(source)
            continue
        parts.append(f"```python\n{source}\n```")
        for output in entry["outputs"]:
            data = output.get("data", {})
            printed = "".join(output.get("text", data.get("text/plain", [])))
            if "image/png" in data:
                name = f"{stem}-{len(pictures) + 1}.png"
                pictures[name] = base64.b64decode("".join(data["image/png"]))
                parts.append(f"![what the cell draws]({name})")
            elif printed:
                parts.append(f"```text\n{printed.rstrip()}\n```")
    about = f"*This page is the notebook `docs/tutorials/{stem}.ipynb`.*"
    return "\n\n".join([*parts, about]) + "\n", pictures


def decisions(folder: Path) -> dict[str, str]:
    """The list of decisions, and their pages as they are."""
    texts = {path: path.read_text(encoding="utf-8") for path in sorted(folder.glob("*.md"))}
    lines = ["# Decisions", "", "Why things are as they are, and what was measured.", ""]
    lines += [f"- [{text.splitlines()[0].removeprefix('# ')}]({path.name})" for path, text in texts.items()]
    return {"decisions/index.md": "\n".join(lines) + "\n"}
