"""docs/how-it-works.md, "Where a change goes": a toy of each kind, added to a copy of the package by its lines."""

import ast
import re
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

import pharos
from pharos.agents import agents

SOURCE = Path(pharos.__file__).parent
ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "how-it-works.md").read_text()

WORLD = '''
from dataclasses import dataclass

from pharos.environments.base import Environment


@dataclass(frozen=True, kw_only=True)
class Corridor(Environment):
    """Walk to the right end of a corridor."""

    name = "corridor"
    actions = ("left", "right")

    def variables(self):
        return {"cell": range(5)}

    def initial_state(self):
        return (0,)

    def transition(self, state, action, out):
        out[0] = min(max(state[0] + 2 * action - 1, 0), 4)

    def is_terminal(self, state):
        return state[0] == 4

    def reward(self, state, action, next_state):
        return 1.0 if next_state[0] == 4 else 0.0
'''
MEASURE = '''
def num_pairs(mdp):
    """Number of states times number of actions."""
    return float(mdp.num_states * mdp.num_actions)
'''
OBSERVATION = '''
import numpy as np
from gymnasium import spaces

from pharos.observations.observation import Observation


class Halves(Observation):
    """Half of each variable."""

    name = "halves"

    def __init__(self, env):
        self.env = env
        self.space = spaces.Box(0.0, 100.0, (env.components.size.size,), np.float32)

    def __call__(self, states):
        return (np.asarray(states) / 2).astype(np.float32)
'''
AGENT = '''
import numpy as np

from pharos.agents.agent import TableBasedAgent


class AlwaysRight:
    """Learns at its fiftieth step that the last action is best."""

    def __init__(self, mdp):
        self.mdp, self.steps, self.episodes, self.sum_of_returns = mdp, 0, 0, 0.0

    def learn(self, steps):
        self.steps += steps

    def policy_table(self):
        return np.full(self.mdp.num_states, (self.mdp.num_actions - 1) * (self.steps >= 50))

    def state(self):
        return {"steps": np.array(self.steps)}

    def restore(self, state):
        self.steps = int(state["steps"])


class AlwaysRightAgent(TableBasedAgent):
    def table(self, run):
        return AlwaysRight(run.task.mdp)


ALWAYS_RIGHT = AlwaysRightAgent(name="always_right", title="Always right")
'''
RING = '''
import numpy as np

from pharos.mdp.dynamics import Dynamics
from pharos.mdp.table import Table


class Ring(Dynamics):
    """States in a ring: action a goes steps[a] states on, wherever it is executed."""

    operations, mass, is_deterministic, has_ends = 0, 1.0, True, False

    def __init__(self, num_states, steps):
        self.num_states, self.num_actions, self.steps = num_states, len(steps), np.array(steps)

    def deterministic_table(self):
        return ((np.arange(self.num_states)[:, None] + self.steps) % self.num_states).astype(np.int32)

    @property
    def table(self):
        return Table(self.deterministic_table())

    @property
    def for_kernels(self):
        return self.table.for_kernels

    def expected(self, x, states=slice(None)):
        return self.table.expected(x, states)

    def entries(self, states, actions):
        return self.table.entries(states, actions)

    def sample(self, states, actions, rng):
        return (states + self.steps[actions]) % self.num_states

    def _restricted_to(self, states):
        return self.table.restricted_to(states)

    def merged(self, classes, representatives):
        return self.table.merged(classes, representatives)

    def arrays(self):
        return self.table.arrays()

    def part(self, start, stop):
        return self.table.part(start, stop)
'''
FILES = {
    "environments/worlds/corridor.py": WORLD,
    "hardness/num_pairs.py": MEASURE,
    "observations/halves.py": OBSERVATION,
    "agents/always_right.py": AGENT,
    "mdp/ring.py": RING,
}
# File -> (a line of it, which new lines follow; empty: at the end), new lines
LINES = {
    "environments/built_in.py": ("BUILT_IN = (", '    BuiltIn("corridor", "Corridor"),'),
    "hardness/registry.py": (
        "",
        """
from pharos.hardness.num_pairs import num_pairs
register("num_pairs", lambda problem: num_pairs(problem.mdp), definition="S times A", source="ours", version=1)""",
    ),
    "observations/observation.py": ("_BUILT_IN = {", '    "halves": "halves:Halves",'),
    "agents/registry.py": ("", "from pharos.agents.always_right import ALWAYS_RIGHT\nregister(ALWAYS_RIGHT)"),
}
USE = """
from dataclasses import replace

import numpy as np
import pharos
from pharos import environments, hardness
from pharos.training import load_agent

assert environments.Corridor().name == "corridor" and "corridor" in pharos.list_environments()
mdp = pharos.build("corridor", progress=False).mdp(gamma=0.9)
assert hardness.report(mdp, ["num_pairs"])["num_pairs"].value == 10.0
assert pharos.observe(pharos.make("corridor"), "halves")([[3]]).tolist() == [[1.5]]
runs = pharos.train_many("always_right", "corridor", seeds=[0, 1], steps=100, evaluation_interval=25, out="runs")
(one, other) = runs
assert type(one.agent).__name__ == "AlwaysRight" and one.agent is not other.agent
assert [row["value"] for row in one.curve] == [0.0, 0.0, 1.0, 1.0, 1.0], one.curve
assert one.config["agent"] == "always_right" and one.config["observation"] == "index"
alone = pharos.train("always_right", "corridor", steps=100, out="alone")
assert alone.result["final_value"] == 1.0 and load_agent("alone")[1].tolist() == [1] * 5

from pharos.mdp.ring import Ring

ring = Ring(6, (1, -1))
table = pharos.TabularMDP.from_arrays(ring.deterministic_table(), np.eye(6)[:, :2], gamma=0.9)
one, other = (pharos.value_iteration(mdp) for mdp in (table, replace(table, dynamics=ring)))
assert (one.v == other.v).all() and one.v.max() > 1.0, (one.v, other.v)
print("used")
"""


@pytest.mark.slow
def test_one_of_each_kind_is_added_by_the_lines_of_the_page(tmp_path):
    copy = tmp_path / "pharos"
    shutil.copytree(SOURCE, copy, ignore=shutil.ignore_patterns("__pycache__"))
    for file, text in FILES.items():
        assert f"its file in `{Path(file).parent.as_posix()}/`" in PAGE
        (copy / file).write_text(textwrap.dedent(text))
    for file, (before, line) in LINES.items():
        assert f"`{file}`" in PAGE
        add(copy / file, before, line)
    command = [sys.executable, "-c", USE]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.stdout.strip() == "used", done.stderr


def test_the_page_names_a_command_that_tests_each_kind():
    table = PAGE.partition("| what is new |")[2].partition("\n\n")[0].splitlines()[2:]
    assert len(table) == len(FILES)
    for row in table:
        (tests,) = re.findall(r"`pytest (tests/[\w/.]+)", row.rsplit("|", 2)[1])
        assert (ROOT / tests).exists(), row


def test_the_page_of_agents_has_a_row_with_every_name():
    table = (ROOT / "docs" / "agents.md").read_text().partition("\n## Agents\n")[2].partition("\n\n- ")[0]
    missing = [name for name in agents() if f"`{name}`" not in table]
    assert not missing, f"docs/agents.md: the table of agents has no row for {missing}"


def add(file, before, line):
    """Add a line after the one that begins with `before`; at the end of the file if that is empty."""
    lines = file.read_text().splitlines()
    index = next(i for i, each in enumerate(lines) if each.startswith(before)) + 1 if before else len(lines)
    file.write_text("\n".join([*lines[:index], line, *lines[index:], ""]))


@pytest.mark.long
def test_no_file_outside_of_agents_compares_with_the_name_of_an_agent():
    compared = set()
    for file in sorted(SOURCE.rglob("*.py")):
        if file.relative_to(SOURCE).parts[0] == "agents":
            continue
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.Compare | ast.Match):
                names = {each.value for each in ast.walk(node) if isinstance(each, ast.Constant)}
                if names & agents().keys():
                    compared.add(f"{file.relative_to(SOURCE)}:{node.lineno}")
    assert compared == set()


def test_a_comparison_with_the_name_of_an_agent_is_seen():
    for text in ("agent == 'dqn'", "agent in ('a2c', 'x')", "match agent:\n    case 'ppo':\n        pass"):
        (node,) = [each for each in ast.walk(ast.parse(text)) if isinstance(each, ast.Compare | ast.Match)]
        assert {each.value for each in ast.walk(node) if isinstance(each, ast.Constant)} & agents().keys()
