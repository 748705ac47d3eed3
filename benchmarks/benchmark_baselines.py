"""The baselines that are shipped with a suite: results files of some agents, each with one setting.

Ten seeds of named agents (A2C five), 2 to 6 s of one core a run; three of those of sb3-contrib, 26 s and more.

python benchmarks/benchmark_baselines.py --out DIR                  all of them; what is finished in DIR stays
python benchmarks/benchmark_baselines.py --out DIR --only dqn       one of them
python benchmarks/benchmark_baselines.py --out DIR --suite v2 --seeds 3 --only dqn    of another suite, with fewer seeds
python benchmarks/benchmark_baselines.py --out DIR --suite levels --seeds 2 --only ppo --tasks lake    of some tasks

A baseline, src/pharos/benchmark/baselines/SUITE/NAME.safetensors, is results.safetensors of `pharos benchmark run`, and
nothing else: `pharos benchmark run --agent dqn --set double=true --name double_dqn --out DIR/double_dqn` gives that of
double_dqn. Settings of dqn and ppo are those of the suite; QR-DQN and recurrent PPO have them too.
"""

import argparse
import shutil
from pathlib import Path
from typing import Any

from pharos import benchmark
from pharos.benchmark.results import BASELINES, RESULTS_FILE
from pharos.benchmark.suite import CORE
from pharos.errors import AllRunsFailed

FEWER_SEEDS = {"a2c": 5, "qrdqn": 3, "recurrent_ppo": 3}
LEFT_OUT = {
    "q_learning": ("memory", "representation", "hidden"),  # its table has a row for each state, whatever is seen
    "qrdqn": ("exploration", "estimation", "credit", "memory"),  # not run yet
    "recurrent_ppo": ("core",),  # minutes a run where chance makes many histories
}


def settings(suite: benchmark.Suite) -> dict[str, tuple[str, dict[str, Any]]]:
    """Name of a baseline -> agent, and hyperparameters beside those of the suite."""
    dqn, ppo = (dict(suite.hyperparameters[name]) for name in ("dqn", "ppo"))
    return {
        **{name: (name, {}) for name in ("oracle", "random", "dqn", "ppo", "q_learning")},
        "double_dqn": ("dqn", {"double": True}),
        "n_step_dqn": ("dqn", {"n_steps": 3}),
        "a2c": ("a2c", {}),
        "qrdqn": ("sb3_contrib:QRDQN", {**dqn, "policy_kwargs": {"n_quantiles": 50}}),
        "recurrent_ppo": (
            "sb3_contrib:RecurrentPPO",
            {**ppo, "policy": "MlpLstmPolicy", "policy_kwargs": {"lstm_hidden_size": 64}},
        ),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder for the runs, one below it for each baseline")
    parser.add_argument("--only", action="append", help="name of a baseline; several times for more")
    parser.add_argument("--suite", default="v1")
    parser.add_argument("--seeds", type=int, help="at most; those of the protocol, a2c, qrdqn and recurrent_ppo fewer")
    parser.add_argument("--tasks", action="append", help="axis or task; several times for more; all when not given")
    parser.add_argument("--workers", type=int)
    options = parser.parse_args()
    suite = benchmark.load_suite(options.suite)
    most = options.seeds or suite.protocol.seeds
    agents, axes = settings(suite), [CORE, *(ladder.axis for ladder in suite.ladders)]
    for name in options.only or agents:
        if name not in agents:
            parser.error(f"--only {name}: expected one of {', '.join(agents)}")
    for name in options.only or agents:
        agent, hyperparameters = agents[name]
        out = options.out / name
        try:
            outcome = benchmark.run(
                agent,
                suite,
                out=out,
                tasks=options.tasks or [axis for axis in axes if axis not in LEFT_OUT.get(name, ())],
                seeds=range(min(most, FEWER_SEEDS.get(name, most))),
                name=name,
                hyperparameters=hyperparameters,
                workers=options.workers,
            )
        except AllRunsFailed as all_failed:
            outcome = all_failed.outcome
        if outcome.missing:
            place, why = next(iter(outcome.missing.items()))
            print(f"{name}: {len(outcome.missing)} runs are missing; the first, {place}: {why}", flush=True)
            continue
        file = BASELINES / suite.name / f"{name}.safetensors"
        file.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(out / RESULTS_FILE, file)
        print(f"{name}: mean regret {outcome.results.mean():.3f}, {file.stat().st_size:,} bytes", flush=True)


if __name__ == "__main__":
    main()
