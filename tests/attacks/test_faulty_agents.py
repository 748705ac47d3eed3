"""Faulty agents in `benchmark run`, `train`, `tune` and studies: honest mistakes, crashes, hangs and leftovers, each by
the command line.

Each agent is one seed of a task, so that many faulty ones run in one command. What comes out of each is an error in one
line with agent, task and seed, a note, or a finished run; never a traceback, a run without an end, a fault without a
word, or harm to another run.
"""

import json
from dataclasses import replace
from textwrap import indent

import pytest

from attacks.damage import Tally
from command_line import process, run
from pharos.benchmark import BenchmarkTask, Protocol, Suite, write_suite
from pharos.benchmark.suite import digest_of_suite, frozen

pytestmark = pytest.mark.long

PROTOCOL = Protocol(steps=300, evaluations=3, seeds=2)
LAKE = BenchmarkTask("lake", "frozen_lake", {"size": 4}, "vector", chance={"random": 0.1})
HEAD = """
import copy, os, random, signal, sys, threading, time
import numpy as np

memory = []
A = 4

def always(action):
    return lambda seen: np.full(len(seen), action)

def play(env, steps, action=1):
    env.reset()
    for _ in range(steps):
        if any(env.step(action)[2:4]):
            env.reset()
"""

OUTCOMES = {"errors": "refused", "hangs": "refused", "notes": "warned", "harmless": "unchanged"}
HASTY, PATIENT = 15, 1500  # seconds after which a run is ended
SOUND = "play(env, steps)\nyield always(1)"
POLICY = "play(env, 250)\nyield {}"
LOOP = """
env.reset()
while True:
    try:
        {}
    except {}:
        env.reset()
    yield always(1)
"""

# An error in one line that has these words
ERRORS = {
    "returns a policy": ("return always(1)", "expected a generator"),
    "returns nothing": ("return None", "expected a generator"),
    "yields None": (POLICY.format("None"), "agent is None; expected a policy"),
    "yields a number": (POLICY.format("3"), "expected a policy"),
    "yields the class": (POLICY.format("dict"), "raised"),
    "one observation": (POLICY.format("lambda seen: 1 if seen[0] > 0.5 else 0"), "raised ValueError"),
    "one action": (POLICY.format("lambda seen: 1"), "answered with shape ()"),
    "a short answer": (POLICY.format("lambda seen: np.zeros(3, int)"), "answered with shape (3,)"),
    "a long answer": (POLICY.format("lambda seen: np.zeros(len(seen) + 1, int)"), "answered with shape"),
    "a column": (POLICY.format("lambda seen: np.zeros((len(seen), 1), int)"), "answered with shape"),
    "transposed": (POLICY.format("lambda seen: np.full((A, len(seen)), 0.25)"), "answered with shape (4,"),
    "float actions": (POLICY.format("lambda seen: np.ones(len(seen))"), "float64 for"),
    "bool actions": (POLICY.format("lambda seen: np.ones(len(seen), bool)"), "bool for"),
    "action A": (POLICY.format("always(A)"), "expected 0 to 3"),
    "action -1": (POLICY.format("always(-1)"), "expected 0 to 3"),
    "NaN": (POLICY.format("lambda seen: np.full((len(seen), A), np.nan)"), "NaN"),
    "infinity": (POLICY.format("lambda seen: np.full((len(seen), A), np.inf)"), "sum to inf"),
    "values": (POLICY.format("lambda seen: np.tile([-1.3, 0, 1, 2], (len(seen), 1))"), "answered -1.3, a float64"),
    "positive values": (POLICY.format("lambda seen: np.tile([3.0, 0, 1, 2], (len(seen), 1))"), "argmax"),
    "text": (POLICY.format("lambda seen: ['left'] * len(seen)"), "could not convert string"),
    "ragged": (POLICY.format("lambda seen: [[0.5, 0.5], [1.0]]"), "raised ValueError"),
    "objects": (POLICY.format("lambda seen: np.array([None] * len(seen))"), "lake, seed"),
    "samples actions": (
        POLICY.format("lambda seen: np.random.default_rng().integers(A, size=len(seen))"),
        "asked twice",
    ),
    "samples a little": (
        POLICY.format("lambda seen: np.where(np.random.rand(len(seen)) < 0.2, np.random.randint(A), 1)"),
        "return (N, A) probabilities",
    ),
    "dropout": (
        POLICY.format("lambda seen: (lambda p: p / p.sum(1)[:, None])(np.random.rand(len(seen), A))"),
        "dropout",
    ),
    "a table of another size": (POLICY.format("np.zeros(3, int)"), "lake, seed"),
    "the policy raises": (POLICY.format("lambda seen: {}['weights']"), "raised KeyError: 'weights', asked about"),
    "raises at once": ("raise RuntimeError('no idea')\nyield", "RuntimeError: no idea (mine.py, line"),
    "raises late": ("play(env, 250)\nraise RuntimeError('late')\nyield", "RuntimeError: late"),
    "raises of two lines": ("raise RuntimeError('one\\n  two\\x1b[31m')\nyield", "RuntimeError: one two\\x1b[31m"),
    "a long error": ("raise RuntimeError('x' * 10**6)\nyield", "xxx..."),
    "an error without text": ("raise ValueError\nyield", "ValueError (mine.py, line"),
    "a name that is not there": ("nothing\nyield", "NameError"),
    "division": ("1 / 0\nyield", "ZeroDivisionError"),
    "recursion": ("def f(): f()\nf()\nyield", "RecursionError"),
    "memory": ("raise MemoryError\nyield", "MemoryError"),
    "much memory": ("np.ones(1 << 50)\nyield", "MemoryError"),
    "StopIteration": ("next(iter(()))\nyield", "StopIteration"),
    "asserts": ("assert env is None, 'what'\nyield", "AssertionError: what"),
    "SystemExit": ("sys.exit('no data')\nyield", "SystemExit: no data (mine.py, line"),
    "SystemExit 0": ("sys.exit(0)\nyield", "SystemExit: 0"),
    "KeyboardInterrupt": ("raise KeyboardInterrupt\nyield", "KeyboardInterrupt"),
    "GeneratorExit": ("raise GeneratorExit\nyield", "GeneratorExit"),
    "an exception of its own": ("class Odd(BaseException): pass\nraise Odd('base')\nyield", "Odd: base"),
    "an exception that cannot be shown": (
        "class Odd(Exception):\n    def __str__(self): raise ValueError\nraise Odd\nyield",
        "lake, seed",
    ),
    "exit 0": ("os._exit(0)\nyield", "exit code 0"),
    "exit 3": ("os._exit(3)\nyield", "exit code 3"),
    "exit 75": ("os._exit(75)\nyield", "exit code 75"),
    "exit 78": ("os._exit(78)\nyield", "exit code 78"),
    "exit 255": ("os._exit(255)\nyield", "exit code 255"),
    "SIGSEGV": ("os.kill(os.getpid(), signal.SIGSEGV)\nyield", "SIGSEGV"),
    "SIGABRT": ("os.abort()\nyield", "SIGABRT"),
    "SIGKILL": ("os.kill(os.getpid(), signal.SIGKILL)\nyield", "SIGKILL; was there memory enough?"),
    "a null pointer": ("import ctypes\nctypes.string_at(0)\nyield", "SIGSEGV"),
    "yields for ever": ("while True: yield always(1)", "0 of its 300 steps were counted"),
    "yields for ever after some steps": (
        "play(env, 20)\nwhile True: yield always(1)",
        "policies in a row without a step",
    ),
    "options of reset": ("env.reset(options={'state': (0, 0)})\nyield always(1)", "reset has the options state"),
    "the state": ("_, info = env.reset()\ninfo['state']\nyield", "KeyError: 'state'"),
    "the index": ("env.reset()\nenv.step(0)[4]['index']\nyield", "KeyError: 'index'"),
    "an action that is not there": ("env.reset()\nenv.step(A)\nyield", "expected 0 to 3"),
    "an action that is an array": ("env.reset()\nenv.step(np.array([0, 1]))\nyield", "TypeError"),
    "steps before a reset": ("env.step(0)\nyield", "reset"),
    "four times the same": (
        "import gymnasium\ngymnasium.vector.SyncVectorEnv([lambda: env] * 4).reset(seed=seed)\nyield",
        "[env.copy] * 4",
    ),
    "a pickle": ("import pickle\npickle.dumps(env)\nyield", "cannot be pickled"),
    "steps of the inner environment": (
        "env.unwrapped.reset()\nplay(env.unwrapped, 99)\nyield always(1)",
        "0 of its 300",
    ),
}
# No end, without a step
HANGS = {
    "an endless loop": ("while True: pass\nyield", "took longer than"),
    "sleeps": ("time.sleep(10**6)\nyield", "took longer than"),
    "a lock": ("lock = threading.Lock()\nlock.acquire()\nlock.acquire()\nyield", "took longer than"),
}
# A note of this kind
NOTES = {
    "never yields": ("play(env, steps)\nyield from ()", "no policy"),
    "does nothing": ("yield from ()", "no policy"),
    "yields at the end": ("play(env, steps)\nyield always(1)", "late policy"),
    "yields after the budget": ("try:\n    play(env, 999)\nexcept BaseException:\n    yield always(1)", "late policy"),
    "never resets": (
        "env.reset()\nfor k in range(steps):\n    env.step(1)\n    if k % 50 == 0: yield always(1)",
        "steps after an end",
    ),
    "resets late": (
        "for k in range(steps):\n    if k % 99 == 0: env.reset()\n    env.step(1)\n    if k % 50 == 0: yield always(1)",
        "steps after an end",
    ),
    "the same seed": (
        "env.reset(seed=1)\nfor k in range(steps):\n    if any(env.step(1)[2:4]): env.reset(seed=1)\n"
        "    if k % 50 == 0: yield always(1)",
        "same seed",
    ),
    "stops early": ("play(env, 20)\nyield always(1)", "few steps"),
    "catches all": (LOOP.format("env.step(1)", "BaseException"), "steps after an end"),
    "catches all and goes on": (
        "env.reset()\nyield always(1)\nwhile True:\n    try:\n        env.step(1)\n    except:\n        env.reset()",
        "steps beyond the budget",
    ),
    "catches all in a function": (
        "def step():\n    try: return env.step(1)\n    except BaseException: return step2()\n"
        "def step2():\n    return None, 0.0, True, False, {}\n"
        "env.reset()\nyield always(1)\nwhile True:\n    if any(step()[2:4]): env.reset()",
        "steps beyond the budget",
    ),
}
# As a sound agent
HARMLESS = {
    "sound": SOUND,
    "catches exceptions": (
        "env.reset()\nwhile True:\n    try:\n        if any(env.step(1)[2:4]): env.reset()\n    except Exception:\n"
        "        env.reset()\n    yield always(1)"
    ),
    "half precision": POLICY.format("lambda seen: (np.tile([1/3, 1/3, 1/3, 0], (len(seen), 1))).astype(np.float16)"),
    "a list": POLICY.format("lambda seen: [1] * len(seen)"),
    "small integers": POLICY.format("lambda seen: np.ones(len(seen), np.int8)"),
    "a table": POLICY.format("np.ones(len(env._task.mdp.rewards), int)"),
    "yields each step": "for _ in range(steps):\n    play(env, 1)\n    yield always(1)",
    "a thread that stays": "threading.Thread(target=time.sleep, args=(9**9,)).start()\n" + SOUND,
    "a daemon": "threading.Thread(target=time.sleep, args=(9**9,), daemon=True).start()\n" + SOUND,
    "a process that stays": "import subprocess\nsubprocess.Popen(['sleep', '600'])\n" + SOUND,
    "a fork that comes back": "if os.fork() == 0:\n    env.budget.limit = 1\n" + SOUND,
    "changes the directory": "os.makedirs('x', exist_ok=True)\nos.chdir('x')\n" + SOUND,
    "clears the environment": "os.environ.clear()\n" + SOUND,
    "closes standard output": "os.close(1)\n" + SOUND,
    "prints": "print('a line', flush=True)\n" + SOUND,
    "warns": "import warnings\nwarnings.warn('odd')\n" + SOUND,
    "warnings are errors": "import warnings\nwarnings.simplefilter('error')\n" + SOUND,
    "numpy raises": "np.seterr(all='raise')\n" + SOUND,
    "another signal handler": "signal.signal(signal.SIGTERM, signal.SIG_IGN)\n" + SOUND,
    "deep copies": "play(copy.deepcopy(env), steps)\nyield always(1)",
    "an error after the end": "play(env, 299)\nyield always(1)\nplay(env, 99)\nraise RuntimeError",
    "an error in finally": "try:\n    play(env, steps + 9)\n    yield always(1)\nfinally:\n    yield always(1)",
    "memory of a module": "assert not memory\nmemory.append(seed)\n" + SOUND,
    "a recursion limit": "sys.setrecursionlimit(10**5)\n" + SOUND,
}


@pytest.fixture(scope="module")
def suite():
    whole = Suite("mini", PROTOCOL, (frozen(LAKE, PROTOCOL),), (), "", {})
    return replace(whole, digest=digest_of_suite(whole))


def written(codes):
    """The file of an agent whose run with seed k has the k-th of these codes."""
    functions = [
        f"def run_{k}(env, steps, seed, *, rate=0.1):\n{indent(code, ' ' * 4)}\n" for k, code in enumerate(codes)
    ]
    return "\n\n".join(
        [HEAD, *functions, "def learn(env, steps, seed):\n    return globals()[f'run_{seed}'](env, steps, seed)\n"]
    )


def fault(number, words, kind, answer, folder):
    """("refused" for an error, "warned" for a note, "unchanged", its text), or ("failed", why)."""
    run = f"lake, seed {number}"
    record = json.loads((folder / "runs" / "lake" / f"seed-{number}" / "run.json").read_text())
    text, notes = answer["failed"].get(run, ""), {name for name, runs in answer["notes"].items() if run in runs}
    facts = f"{record['status']}: {text[:1000]}, notes {notes}; expected {words}"
    if kind in ("errors", "hangs"):
        holds = record["status"] == "failed" and record["error"] == text and words in text and text.isprintable()
        holds = holds and text.startswith(f"mine.py:learn on {run}: ") and len(text) < 1500
        return ("refused", text) if holds else ("failed", facts)
    if record["status"] != "finished" or text or (record["result"]["counted_steps"] > PROTOCOL.steps):
        return "failed", facts
    if kind == "notes":
        return ("warned", "") if words in notes else ("failed", facts)
    return ("unchanged", "") if notes <= {"late policy", "equal seeds"} else ("failed", facts)


@pytest.mark.parametrize("kind", ["errors", "hangs", "notes", "harmless"])
def test_faulty_agents(suite, tmp_path, count, kind):
    """One command runs all: seed k is the k-th agent, and no agent harms another."""
    sound = {name: (code, "") for name, code in HARMLESS.items()}
    cases = {"errors": ERRORS, "hangs": HANGS, "notes": NOTES, "harmless": sound}[kind]
    (tmp_path / "mine.py").write_text(written([code for code, _ in cases.values()]))
    write_suite(suite, tmp_path / "mini.yaml")
    line = f"benchmark run --agent mine.py:learn --suite mini.yaml --seeds {len(cases)} --workers 2 --out out --json"
    done = process(*line.split(), "--timeout", HASTY if kind == "hangs" else PATIENT, cwd=tmp_path)
    assert done.stdout.count("\n") == 1 and "Traceback" not in done.stderr, (done.stdout[-500:], done.stderr[-3000:])
    answer, tally = json.loads(done.stdout), Tally()
    for number, (name, (_, words)) in enumerate(cases.items()):
        tally.note(name, *fault(number, words, kind, answer, tmp_path / "out"))
    count(f"{tally.total} faulty agents, {kind}: {tally}")
    tally.check()
    assert tally.total == len(cases) == tally.counts[OUTCOMES[kind]]
    assert done.returncode == (OUTCOMES[kind] == "refused")


STUDY = """
name: faulty
seeds: 1
steps: 300
evaluations: 3
blocks:
  - environments: [frozen_lake/4x4]
    chance: [{{random: 0.1}}]
    observations: [vector]
    agents: [{}]
"""
OTHER_DOORS = {
    "errors": [
        *("returns a policy", "yields None", "one observation", "a short answer", "float actions", "bool actions"),
        *(
            "action A",
            "NaN",
            "values",
            "samples actions",
            "samples a little",
            "the policy raises",
            "raises late",
            "SystemExit",
        ),
        *("raises at once", "SystemExit 0", "an exception of its own", "asserts", "the state", "four times the same"),
    ],
    "notes": ["never yields", "yields at the end", "never resets", "the same seed", "stops early", "catches all"],
    "harmless": ["sound", "half precision", "a list", "yields each step", "deep copies", "catches exceptions"],
}
"""Kinds of mistakes that people make, given to the other doors of an agent."""


def through_train(k, folder):
    """(exit code, standard error, notes) of one run of the k-th agent."""
    words = ("--random", 0.1, "--observation", "vector", "--steps", 300, "--interval", 100, "--out", folder / f"{k}")
    done = run("train", "frozen_lake/4x4", "--agent", f"mine.py:run_{k}", *words, "--json")
    return done.exit_code, done.stderr, set(json.loads(done.stdout)["notes"]) if not done.exit_code else set()


def through_tune(k, folder):
    """(exit code, standard error, None) of a search of one trial with the k-th agent: it has no notes."""
    words = ("--trials", 1, "--seeds", 0, "--search", "rate=0.1,0.2", "--steps", 300, "--out", folder / f"{k}")
    done = run("tune", "frozen_lake/4x4", "--random", 0.1, "--agent", f"mine.py:run_{k}", *words)
    return done.exit_code, done.stderr, None


def through_a_study(count, folder):
    """The same of all agents in one study, in their order."""
    (folder / "faulty.yaml").write_text(STUDY.format(", ".join(f'"mine.py:run_{k}"' for k in range(count))))
    done = process("study", "run", "faulty.yaml", "--out", "out", "--workers", 2, cwd=folder)
    assert "Traceback" not in done.stderr, done.stderr[-3000:]
    records = [json.loads(file.read_text()) for file in (folder / "out" / "runs").glob("*/run.json")]
    by_agent = {record["config"]["agent"]: record for record in records}
    ends = [by_agent[f"mine.py:run_{k}"] for k in range(count)]
    return [
        (int(end["status"] != "finished"), f"pharos: {end.get('error', '')}\n", set(end.get("notes", {})))
        for end in ends
    ]


def through_diagnose(k, folder):
    """(exit code, standard error, notes) of the k-th agent on twelve worlds."""
    done = run("diagnose", f"mine.py:run_{k}", "--steps", 300, "--seeds", 1, "--json")
    readings = set() if done.exit_code else {each["reading"] for each in json.loads(done.stdout)["findings"]}
    return done.exit_code, done.stderr, readings & {words for _, words in NOTES.values()}


DIAGNOSED = {
    **dict.fromkeys(["never yields", "stops early"], "refused"),  # no policy at the end
    "yields at the end": "unchanged",  # which is all that is judged
    "half precision": "refused",  # its four actions, where a world has others
}
"""Outcomes of `diagnose` that are others than in `benchmark run`."""


@pytest.mark.parametrize("door", ["train", "tune", "study", "diagnose"])
def test_faulty_agents_through_other_doors(tmp_path, monkeypatch, count, door):
    """An error in one line with the agent's words, a note, or a finished run, as in the benchmark."""
    tables = {"errors": ERRORS, "notes": NOTES, "harmless": {name: (code, "") for name, code in HARMLESS.items()}}
    cases = [(kind, name, *tables[kind][name]) for kind, names in OTHER_DOORS.items() for name in names]
    (tmp_path / "mine.py").write_text(written([code for _, _, code, _ in cases]))
    monkeypatch.chdir(tmp_path)
    if door == "study":
        ends = through_a_study(len(cases), tmp_path)
    else:
        through = {"train": through_train, "tune": through_tune, "diagnose": through_diagnose}[door]
        ends = [through(k, tmp_path) for k in range(len(cases))]
    tally = Tally()
    for (kind, name, _, words), (code, text, notes) in zip(cases, ends, strict=True):
        holds = code == 0 and (
            notes is None or notes <= {"late policy"} if kind == "harmless" else words in (notes or words)
        )
        special = DIAGNOSED.get(name) if door == "diagnose" else None
        if kind == "errors":
            holds = code != 0 and text.count("\n") == 1 and text.startswith("pharos: ") and words in text
        elif special:
            holds = (code != 0 and text.count("\n") == 1) if special == "refused" else code == 0 and not notes
        outcome = special or ("unchanged" if notes is None and not code else OUTCOMES[kind])
        tally.note(name, outcome if holds else "failed", f"exit {code}, {text[-1000:]}, notes {notes}")
    count(f"{tally.total} faulty agents through {door}: {tally}")
    tally.check()
    assert tally.total == len(cases) == sum(map(len, OTHER_DOORS.values()))


def test_an_agent_that_goes_on_after_its_budget_ends_with_a_line(tmp_path):
    """It catches all: nothing but the end of the process stops it."""
    (tmp_path / "mine.py").write_text(written([NOTES["catches all and goes on"][0]]))
    words = ("--agent", "mine.py:run_0", "--steps", 300, "--out", "out")
    done = process("train", "frozen_lake/4x4", *words, cwd=tmp_path)
    assert done.returncode == 1 and "went on for 1,000 steps after its 300" in done.stderr
    assert done.stderr.count("\n") == 1 and done.stdout == ""


def test_agents_that_cannot_be_loaded(suite, tmp_path, count):
    """Nothing runs; one line says why."""
    texts = {
        "a syntax error": "def learn(env, steps, seed)\n",
        "no library": "import a_library_that_nobody_has\n",
        "an error at the top": "1 / 0\n",
        "an exit at the top": "import sys\nsys.exit('usage: mine.py')\n",
        "no learn": "x = 1\n",
        "learn of another form": "def learn(env):\n    yield\n",
        "learn is a number": "learn = 3\n",
        "bytes": "\0\1\2",
        "nothing": "",
    }
    tally = Tally()
    write_suite(suite, tmp_path / "mini.yaml")
    for name, text in texts.items():
        (tmp_path / "mine.py").write_text(text)
        line = "benchmark run --agent mine.py:learn --suite mini.yaml --seeds 2 --out out"
        done = process(*line.split(), cwd=tmp_path)
        lines = done.stderr.splitlines()
        holds = done.returncode == 2 and len(lines) == 1 and "mine.py" in lines[0] and not (tmp_path / "out").exists()
        tally.note(name, "refused" if holds else "failed", done.stderr[-1000:])
    count(f"{tally.total} agents that cannot be loaded: {tally}")
    tally.check()


def test_a_table_of_faults_is_counted():
    """The kinds of the findings: 81 faulty agents in `benchmark run`, and more."""
    assert len({*ERRORS, *HANGS, *NOTES, *HARMLESS}) == sum(map(len, (ERRORS, HANGS, NOTES, HARMLESS))) >= 100
