"""Applies a random sample of small faults to the core of pharos, and tells which ones no test notices.

    git worktree add --detach ../mutants            # a copy to mutate; a killed run leaves at most its fault there
    python -m venv /tmp/mutation && /tmp/mutation/bin/pip install cosmic-ray
    export PHAROS_CACHE_DIR=/tmp/cache              # of its own: cached spaces in it are removed before every fault
    /tmp/mutation/bin/python scripts/mutation_sample.py ../mutants --python .venv/bin/python --out sample.jsonl
    /tmp/mutation/bin/python scripts/mutation_sample.py ../mutants --python .venv/bin/python --again sample.jsonl

The first run draws the sample and writes a line of JSON for each fault: where it is, its diff, and whether a test
failed. `--again` applies the faults that survived once more, after tests were written: it finds each by its diff, so
the code that was mutated must be the same (tests may be newer). Faults come from cosmic-ray's operators, all places of
a file alike; the tests of each file are those named in `TESTED_BY`, and end at the first failure.
A run past its time limit counts as noticed. CONTRIBUTING.md has the results.
"""

import argparse
import ast
import difflib
import itertools
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import mutate_code
from cosmic_ray.plugins import get_operator

NUMBERS = "core/NumberReplacer"
TESTED_BY = {  # path in src/pharos: weight of its faults (kernels compile again for each), tests
    "mdp/dynamics.py": (1.0, "test_dynamics test_mdp test_occupancy"),
    "mdp/table.py": (1.0, "test_outcome_table test_mdp test_dynamics test_bisimulation test_solvers"),
    "mdp/actions.py": (1.0, "test_mdp test_dynamics test_q_learning test_solvers test_policies"),
    "mdp/rewards.py": (1.0, "test_mdp test_solvers"),
    "mdp/tabular.py": (1.0, "test_mdp test_natural_arguments test_dynamics"),
    "mdp/construction.py": (1.0, "test_mdp test_natural_arguments"),
    "mdp/reachability.py": (1.0, "test_mdp test_dynamics"),
    "mdp/arguments.py": (1.0, "test_mdp test_natural_arguments test_dynamics test_row_sums"),
    "solvers/fixed_point.py": (1.0, "test_error_bounds test_solvers"),
    "solvers/policy_iteration.py": (1.0, "test_error_bounds test_solvers"),
    "solvers/values.py": (1.0, "test_solvers test_error_bounds"),
    "solvers/solution.py": (1.0, "test_solvers test_error_bounds"),
    "hardness/diameter.py": (0.6, "test_diameter"),
    "hardness/sum_sweep.py": (0.6, "test_diameter"),
    "hardness/stochastic_diameter.py": (0.6, "test_stochastic_diameter"),
    "hardness/hitting_times.py": (0.6, "test_stochastic_diameter"),
    "hardness/gaps.py": (0.6, "test_gaps"),
    "hardness/steps.py": (0.6, "test_effective_horizon"),
    "kernels/bellman.py": (0.3, "test_solvers test_dynamics test_chain_measures"),
    "kernels/gaps.py": (0.5, "test_gaps"),
    "kernels/graph.py": (0.2, "test_diameter test_dynamics"),
    "kernels/many_searches.py": (0.2, "test_diameter"),
    "kernels/hitting.py": (0.3, "test_stochastic_diameter"),
}

COMPARISONS = "Eq_NotEq NotEq_Eq Lt_LtE Lt_GtE LtE_Lt LtE_Gt Gt_GtE Gt_LtE GtE_Gt GtE_Lt Is_IsNot IsNot_Is"
BINARY = "Add_Sub Sub_Add Mul_Div Div_Mul FloorDiv_Mul Mod_FloorDiv Pow_Mul BitAnd_BitOr BitOr_BitAnd"
UNARY = "USub_UAdd Delete_USub Delete_Invert Delete_Not"
OTHERS = (
    "AddNot ReplaceAndWithOr ReplaceOrWithAnd NumberReplacer ReplaceTrueWithFalse ReplaceFalseWithTrue "
    "ReplaceBreakWithContinue ReplaceContinueWithBreak ZeroIterationForLoop"
)
OPERATORS = (
    *(f"core/ReplaceComparisonOperator_{name}" for name in COMPARISONS.split()),
    *(f"core/ReplaceBinaryOperator_{name}" for name in BINARY.split()),
    *(f"core/ReplaceUnaryOperator_{name}" for name in UNARY.split()),
    *(f"core/{name}" for name in OTHERS.split()),
)


@dataclass(frozen=True)
class Fault:
    """One small fault: the `occurrence`-th place in a file at which an operator of cosmic-ray applies."""

    path: str  # in src/pharos
    line: int
    operator: str
    occurrence: int

    def code(self, source: str) -> str | None:
        """The file with the fault; None where it is no Python, or the same program."""
        mutated = mutate_code(source, get_operator(self.operator)(), self.occurrence)
        try:
            is_same = mutated is None or ast.dump(ast.parse(mutated)) == ast.dump(ast.parse(source))
        except SyntaxError:
            return None
        return None if is_same else mutated


def main() -> None:
    arguments = parsed_arguments()
    source = Path(arguments.tree).resolve() / "src" / "pharos"
    faults = list(survivors(source, arguments.again) if arguments.again else sample(source, arguments))
    signal.signal(signal.SIGTERM, lambda *_: sys.exit("ended"))  # and puts the file back
    outcomes: Counter[str] = Counter()
    for number, fault in enumerate(faults, 1):
        result = {**asdict(fault), **tried(fault, source, arguments)}
        outcomes[result["outcome"]] += 1
        print(f"{number}/{len(faults)} {result['outcome']:8} {fault.path}:{fault.line} {fault.operator}", flush=True)
        if result["outcome"] == "survived":
            print(result["diff"], flush=True)
        if arguments.out:
            with open(arguments.out, "a", encoding="utf-8") as report:
                print(json.dumps(result), file=report)
    print(", ".join(f"{count} {outcome}" for outcome, count in sorted(outcomes.items())))


def parsed_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tree", help="a copy of the repository; its files are mutated and put back")
    parser.add_argument("--python", default=sys.executable, help="the interpreter that has pharos' dependencies")
    parser.add_argument("--out", help="a file of JSON lines to append the results to")
    parser.add_argument("--again", help="results of an earlier run: apply its survivors again, draw nothing")
    parser.add_argument("--count", type=int, default=150, help="how many faults to draw")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--timeout", type=float, default=150.0, help="seconds for the tests of one fault")
    return parser.parse_args()


# Which faults there are ----------------------------------------------------------------------------------------------


def sample(source: Path, arguments: argparse.Namespace) -> list[Fault]:
    """Faults drawn from each file in proportion to its faults, weighted as `TESTED_BY` says, 2 at least.

    Numbers are most places of every file: of their faults, which are two for each number, a third is left in.
    """
    rng = random.Random(arguments.seed)
    everywhere = {path: list(faults_of(source, path)) for path in TESTED_BY}
    print(f"{sum(map(len, everywhere.values()))} faults in {len(everywhere)} files", flush=True)
    shares = {path: weight * len(everywhere[path]) for path, (weight, _) in TESTED_BY.items()}
    drawn = []
    for path, faults in everywhere.items():
        wanted = max(2, round(arguments.count * shares[path] / sum(shares.values())))
        candidates = [fault for fault in faults if fault.operator != NUMBERS or rng.random() < 1 / 3]
        rng.shuffle(candidates)
        text = (source / path).read_text()
        drawn += itertools.islice((fault for fault in candidates if fault.code(text)), wanted)
    rng.shuffle(drawn)  # so that what an interrupted run has done is a sample as well
    return drawn


def faults_of(source: Path, path: str) -> Iterator[Fault]:
    """All faults of a file, without what no behaviour hangs on: see `without_behaviour`."""
    text = (source / path).read_text()
    left_out = without_behaviour(text)
    for name in OPERATORS:
        operator, occurrence = get_operator(name)(), 0
        for node in ast_nodes(get_ast(text)):
            for (line, column), _ in operator.mutation_positions(node):
                if not any(start <= (line, column) < stop for start, stop in left_out):
                    yield Fault(path, line, name, occurrence)
                occurrence += 1


def without_behaviour(text: str) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    """Ranges of (line, column): annotations, decorators, texts of errors, sizes of blocks."""
    ranges = []
    for node in ast.walk(ast.parse(text)):
        parts: list[ast.AST | None] = []
        if isinstance(node, ast.FunctionDef):
            parts = [node.returns, *node.decorator_list]
        elif isinstance(node, ast.ClassDef):
            parts = [*node.decorator_list]
        elif isinstance(node, ast.arg | ast.AnnAssign):
            parts = [node.annotation]
        elif isinstance(node, ast.Raise) or (isinstance(node, ast.Assign) and "BLOCK" in ast.unparse(node.targets[0])):
            parts = [node]
        for part in parts:
            if part is not None:
                ranges.append(((part.lineno, part.col_offset), (part.end_lineno, part.end_col_offset)))
    return ranges


def survivors(source: Path, results: str) -> Iterator[Fault]:
    """The faults of an earlier run that no test noticed."""
    for line in Path(results).read_text().splitlines():
        result = json.loads(line)
        if result["outcome"] == "survived":
            fault = Fault(*(result[name] for name in ("path", "line", "operator", "occurrence")))
            code = (source / fault.path).read_text()
            if difference(code, fault.code(code) or "") != result["diff"]:
                sys.exit(f"{fault} is not what it was in {results}; mutate the tree of that time")
            yield fault


# What a fault does ---------------------------------------------------------------------------------------------------


def tried(fault: Fault, source: Path, arguments: argparse.Namespace) -> dict[str, str | float]:
    """The diff of a fault, the outcome of its tests, and the test that failed."""
    begin = time.monotonic()
    original = (source / fault.path).read_text()
    mutated = fault.code(original)
    assert mutated is not None
    with applied(source / fault.path, mutated):
        outcome, test = tested(source.parents[1], TESTED_BY[fault.path][1], arguments)
    seconds = round(time.monotonic() - begin, 1)
    return {"outcome": outcome, "test": test, "seconds": seconds, "diff": difference(original, mutated)}


@contextmanager
def applied(file: Path, code: str) -> Iterator[None]:
    """Put a mutated file in place; afterwards the original, with its time, so that what was compiled from it holds.

    Numba knows a kernel by the time and size of its file, not by the kernels it calls in others: those are forgotten.
    """
    original, times = file.read_bytes(), file.stat()
    compiled = file.parent / "__pycache__"
    kept = compiled.with_name("kept")
    is_kernel = file.parent.name == "kernels"
    if is_kernel:
        compiled.mkdir(exist_ok=True)
        shutil.rmtree(kept, ignore_errors=True)
        shutil.copytree(compiled, kept)
        users = [each for each in file.parent.glob("*.py") if f"kernels.{file.stem} " in each.read_text()]
        for each in (file, *users):
            for index in compiled.glob(f"{each.stem}.*"):
                index.unlink()
    try:
        file.write_text(code)
        yield
    finally:
        file.write_bytes(original)
        os.utime(file, ns=(times.st_atime_ns, times.st_mtime_ns))
        if is_kernel:
            shutil.rmtree(compiled)
            kept.rename(compiled)


def tested(tree: Path, names: str, arguments: argparse.Namespace) -> tuple[str, str]:
    """("killed", test), ("timeout", "") or ("survived", "") of the tests, each file once, in their order."""
    for kept in (Path(os.environ["PHAROS_CACHE_DIR"]) / "spaces").glob("*"):
        shutil.rmtree(kept)  # measures are kept in the folders of spaces; compiled rules hold none of what is mutated
    files = [next(str(path) for path in (tree / "tests").rglob(f"{name}.py")) for name in dict.fromkeys(names.split())]
    command = [arguments.python, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", "--tb=no", *files]
    environment = {**os.environ, "PYTHONPATH": str(tree / "src"), "PYTHONDONTWRITEBYTECODE": "1"}
    process = subprocess.Popen(
        command, cwd=tree, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        start_new_session=True,
    )  # fmt: skip
    try:
        output, _ = process.communicate(timeout=arguments.timeout)
    except subprocess.TimeoutExpired:
        return "timeout", ""
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()
    if process.returncode == 0:
        return "survived", ""
    failed = [line.split()[1] for line in output.splitlines() if line.startswith(("FAILED", "ERROR"))]
    return "killed", failed[0] if failed else output[-200:]


def difference(before: str, after: str) -> str:
    lines = difflib.unified_diff(before.splitlines(), after.splitlines(), lineterm="", n=0)
    return "\n".join(line for line in lines if not line.startswith(("---", "+++")))


if __name__ == "__main__":
    if "PHAROS_CACHE_DIR" not in os.environ:
        sys.exit("set PHAROS_CACHE_DIR to a folder of its own: cached spaces in it are removed before every fault")
    main()
