"""Opening the explorer: from an environment, a state space, an MDP or the folder of a run to a page in the browser."""

import contextlib
import os
import sys
import threading
import webbrowser
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pharos.environments import Environment, class_called, make
from pharos.errors import ParameterError
from pharos.explorer.exploration import Exploration
from pharos.explorer.learned_policy import Learnt
from pharos.explorer.pages import check_size, write
from pharos.explorer.server import Server
from pharos.mdp import TabularMDP
from pharos.policies import PolicyLike
from pharos.state_space import StateSpace, build, load
from pharos.training import ChanceSetting, load_agent, read_record

RECORD = "run.json"
GAMMA = 0.99
"""The discount, where none is given: values of states need one, as they belong to no number of steps to go."""


class Explorer:
    """A page that is served until `close` is called, or the process ends.

    Attributes:
        url: its address, on this machine alone; whoever knows it may look.
        exploration: what it shows.
    """

    def __init__(self, exploration: Exploration, *, port: int = 0):
        self.exploration, self._server = exploration, Server(exploration, port)
        self.url = self._server.url
        self._thread = threading.Thread(target=self._server.serve, name="pharos explorer", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop answering."""
        self._server.close()
        self._thread.join()

    def wait(self) -> None:
        """Return when the process is interrupted (Ctrl-C)."""
        with contextlib.suppress(KeyboardInterrupt):
            while self._thread.is_alive():
                self._thread.join(0.5)

    def __enter__(self) -> "Explorer":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"Explorer({self.exploration.title}, {self.url})"


def explore(  # noqa: PLR0913
    target: str | os.PathLike | Environment | StateSpace | TabularMDP,
    *,
    policy: PolicyLike | None = None,
    gamma: float | None = None,
    sticky: float = 0.0,
    random: float = 0.0,
    lazy: float = 0.0,
    observation: object = "vector",
    trust: bool = False,
    out: str | os.PathLike | None = None,
    port: int = 0,
    browser: bool = True,
) -> Explorer | Path:
    """Show an MDP state by state in the browser.

    Args:
        target: an environment or its name; a state space, or the folder of one; a tabular MDP; or the folder of a
            finished run, whose chance and policy are taken.
        policy: one to set beside the optimal and the uniform policy, as `pharos.evaluate_policy` takes it.
        gamma: discount; None: that of the MDP where it is below 1, else 0.99. A horizon is left out.
        sticky, random, lazy: chance that is added, see `pharos.sticky_actions`.
        observation: what `policy` sees, where it is no table.
        trust: whether code that a run names may be imported.
        out: write the page with all its data into this file instead, where the space is small enough (10,000 states).
        port: of the server; 0: any that is free.
        browser: whether to open the page in the browser.
    Returns:
        An Explorer, whose server answers until it is closed; with `out` the path of the file.
    Raises:
        ParameterError: there is no such target, the policy does not fit, the port is taken, or the space is too large
            for a file. DivergenceError: gamma is 1, and the value may be infinite.
    """
    agent = None if policy is None else Learnt(policy, observation=observation)
    chance = ChanceSetting(sticky, random, lazy)
    world = exploration_of(target, learnt=agent, gamma=gamma, chance=chance, trust=trust, in_one_page=out is not None)
    if out is not None:
        return write(world, out)
    explorer = Explorer(world, port=port)
    if browser:
        open_browser(explorer.url)
    return explorer


def exploration_of(
    target: object,
    *,
    learnt: Learnt | None = None,
    gamma: float | None = None,
    chance: ChanceSetting | None = None,
    trust: bool = False,
    title: str = "",
    env: Environment | None = None,
    in_one_page: bool = False,
    progress: Callable[[str], None] = lambda text: None,
) -> Exploration:
    """Exploration that `explore` shows. `title`, `progress`: as for `Exploration`; `env`: draws the states of an MDP.

    Args:
        in_one_page: whether it is for a page of its own; what is too large for that is refused before it is solved.
    """
    chance = chance or ChanceSetting()
    if isinstance(target, str | os.PathLike) and (Path(target) / RECORD).is_file():
        return _of_run(Path(target), learnt, gamma, chance, trust, title, progress)
    title = title or (target if isinstance(target, str) else "")
    if isinstance(target, str) and (class_called(target.partition("/")[0]) or not Path(target).exists()):
        target = make(target)
    elif isinstance(target, str | os.PathLike):
        target = load(target)
    if isinstance(target, Environment):
        progress("states")
        target = build(target)
    if isinstance(target, TabularMDP):
        mdp, space = target, None
        gamma = mdp.gamma if gamma is None and mdp.gamma < 1 else gamma
    elif isinstance(target, StateSpace):
        if target.environment is None:
            raise ParameterError(f"{target}: pharos does not know its class, so not its rewards; give the environment")
        space, env = target, target.environment
        mdp = space.mdp()
    else:
        raise ParameterError(f"target is {target!r}; expected an environment, a state space, an MDP or a folder")
    title = title or (_title(env) if env is not None else "")
    mdp_with_chance = chance.of(mdp.with_gamma(GAMMA if gamma is None else gamma))
    if in_one_page:
        check_size(mdp_with_chance, title or str(mdp))
    return Exploration(
        mdp_with_chance,
        env=env,
        space=space,
        learnt=learnt,
        title=title,
        chance=described(chance, mdp),
        progress=progress,
    )


def _of_run(
    folder: Path,
    learnt: Learnt | None,
    gamma: float | None,
    chance: ChanceSetting,
    trust: bool,
    title: str,
    progress: Callable[[str], None],
) -> Exploration:
    """The environment of a run with its chance, and what it has learnt."""
    if chance:
        raise ParameterError(f"{folder}: a run has its chance already; leave out sticky, random and lazy")
    progress("what was learnt")
    task, agent = load_agent(folder, trust=trust)
    record = read_record(folder)
    if learnt is None:
        learnt = Learnt(
            agent,
            f"{record['config'].get('agent', 'agent')}, seed {record['config'].get('seed', 0)}",
            task.observation,
            task.observation_options,
            task.previous_action,
            _facts(record, task),
        )
    progress("states")
    space = task.space
    mdp = task.chance.of(space.mdp(gamma=GAMMA if gamma is None else gamma))
    title = title or _title(task.env)
    setting = described(task.chance, mdp)
    return Exploration(mdp, env=task.env, space=space, learnt=learnt, title=title, chance=setting, progress=progress)


def _facts(record: Any, task: Any) -> dict[str, str]:
    """Facts that the run recorded, in its own setting."""
    result, config = record.get("result", {}), record["config"]
    limit = "discounted, no horizon" if task.horizon_steps is None else f"episodes of {task.horizon_steps} steps"
    facts = {"trained": f"{config.get('steps', 0):,} steps, observation {task.observation}", "its setting": limit}
    for name, word in (("value_optimal", "optimal value"), ("final_value", "value"), ("final_regret", "regret")):
        if isinstance(result.get(name), int | float):
            facts[f"{word} there"] = f"{result[name]:.6g}"
    return facts


def described(chance: ChanceSetting, mdp: TabularMDP) -> str:
    """Chance in words; "none" where there is none."""
    parts = ["of the world"] * mdp.dynamics.has_chance
    parts += [f"{kind} actions {p:g}" for kind in ("sticky", "random", "lazy") if (p := getattr(chance, kind))]
    return ", ".join(parts) or "none"


def _title(env: Environment) -> str:
    """The environment as a command would name it; parameters that were not given are left out."""
    parameters = {name: value for name, value in env.parameters.items() if value is not None and value != ()}
    return " ".join([env.name, *(f"{name}={_short(value)}" for name, value in parameters.items())])


def _short(value: object) -> str:
    text = str(value).lower() if isinstance(value, bool) else str(value)
    return text if len(text) <= 40 else f"{text[:37]}..."


def open_browser(url: str) -> bool:
    """Open a page in the user's browser; False where there is none, or no screen to show it on."""
    has_screen = bool({"DISPLAY", "WAYLAND_DISPLAY", "BROWSER"} & set(os.environ))
    if sys.platform.startswith("linux") and not has_screen:  # else a browser of the terminal would take it over
        return False
    try:
        return webbrowser.open(url)
    except (webbrowser.Error, OSError):
        return False
