"""What rules are filed under: the same in every process, another one whenever something that they reach has changed."""

import os
import subprocess
import sys

import pytest

from pharos import build, make

RULES = '''
from dataclasses import dataclass
from pharos import Environment

class Table:
    """Something that prints its address."""
    def __init__(self, moves):
        self.moves, self.itself = moves, self

MOVES = {"left": -1, "right": 1}
STOPS = {"left", "stay", "nowhere"}
TABLE = Table((2, 3))

@dataclass(frozen=True, kw_only=True)
class Line(Environment):
    name = "line"
    actions = ("left", "right", "stay")

    def variables(self):
        return {"place": range(9)}

    def initial_state(self):
        return (4,)

    def transition(self, state, action, out):
        word = self.actions[action]
        step = MOVES[word] * TABLE.moves[0] if word not in STOPS else MOVES.get(word, 0)
        out[0] = min(max(state[0] + step, 0), 8)

    def is_terminal(self, state):
        return state[0] == 8

    def reward(self, state, action, next_state):
        return 1.0 if next_state[0] == 8 else 0.0
'''

PRINTED = """
import sys
from pharos import make
from pharos.rules.compiler import fingerprint_of_rules
print(fingerprint_of_rules(make(sys.argv[1]), ("transition", "is_terminal")))
"""


def fingerprint(folder, rules=RULES, hash_seed="0"):
    folder.mkdir(exist_ok=True)
    file = folder / "line.py"
    file.write_text(rules)
    command = [sys.executable, "-B", "-c", PRINTED, f"{file}:Line"]
    environment = {**os.environ, "PYTHONHASHSEED": hash_seed}
    return subprocess.run(command, check=True, capture_output=True, text=True, env=environment).stdout


@pytest.mark.long
def test_rules_with_dictionaries_sets_and_objects_have_the_same_text_in_every_process(tmp_path):
    assert fingerprint(tmp_path, hash_seed="1") == fingerprint(tmp_path, hash_seed="2")


@pytest.mark.long
@pytest.mark.parametrize("change", (('"right": 1', '"right": 2'), ('"nowhere"', '"right"'), ("(2, 3)", "(1, 3)")))
def test_other_contents_are_other_rules(change, tmp_path):
    assert fingerprint(tmp_path / "one") != fingerprint(tmp_path / "other", RULES.replace(*change))


@pytest.mark.long
def test_rules_with_dictionaries_are_enumerated_interpreted(tmp_path):
    (tmp_path / "line.py").write_text(RULES)
    with pytest.warns(RuntimeWarning, match="Numba cannot compile its rules"):
        space = build(make(f"{tmp_path / 'line.py'}:Line"), tmp_path / "space", progress=False)
    assert sorted(space.states(slice(None)).ravel().tolist()) == list(range(9))
