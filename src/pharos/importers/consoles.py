"""Games of Atari (ale-py) and Procgen as tabular MDPs, with the conventions of the BRIDGE dataset.

Source: Laidlaw, Russell and Dragan (2023), "Bridging RL Theory and Practice with the Effective Horizon"; Bellemare,
Naddaf, Veness and Bowling (2013), "The Arcade Learning Environment"; Cobbe, Hesse, Hilton and Schulman (2020),
"Leveraging Procedural Generation to Benchmark Reinforcement Learning".
"""

import contextlib
import io
import os
import shutil
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pharos.errors import MissingExtra, ParameterError, UnknownName
from pharos.importers.folder import BUILDING, check_free, save
from pharos.importers.layers import Console, ConsoleLayers, explored
from pharos.mdp import TabularMDP, minimize, whole_number
from pharos.system import storage
from pharos.system.distinct_rows import DistinctRows

MAX_STATES = 100_000


class Recording(NamedTuple):
    """Knowledge of an import besides the MDP.

    Attributes:
        observations: (S, H, W, 3) uint8, the screen of each state, for `importers.save(..., observations=)`.
        actions: names of the actions.
        source: game, package, version and options, for people.
        num_raw_states: states before equal ones were merged.
        layers: number of them at each depth.
        num_steps: steps that were played, without the steps of an earlier, killed import.
    """

    observations: DistinctRows
    actions: tuple[str, ...]
    source: str
    num_raw_states: int
    layers: tuple[int, ...]
    num_steps: int


def atari(  # noqa: PLR0913  (an option each)
    game: str,
    *,
    horizon: int = 10,
    frame_skip: int = 30,
    noops: int = 0,
    all_actions: bool = False,
    life_loss_ends: bool = True,
    settle: int | None = None,
    raw: bool = False,
    max_states: int = MAX_STATES,
    workers: int = 1,
    folder: str | os.PathLike | None = None,
    progress: Callable[[str], object] | None = None,
) -> tuple[TabularMDP, Recording]:
    """Return the MDP of an Atari game over its first steps: deterministic, undiscounted, T steps.

    A state is all that the emulator saves, not only its RAM. Depth T is the end. States with equal screens, rewards
    and successors are merged, as in the BRIDGE dataset. The emulator has no sticky actions; `pharos.sticky_actions`
    adds them to the MDP, one draw a step.

    Args:
        game: a ROM of ale-py, such as "freeway".
        horizon: T, steps of an episode. frame_skip: frames of a step, during which the action is held.
        noops: frames without an action before the first step.
        all_actions: all 18 actions, in place of those that the game uses.
        life_loss_ends: whether the loss of a life ends the episode.
        settle: steps without an action after the last one, whose rewards count with it; None: 200 in skiing, which
            pays at the end, else 0.
        raw: keep states that cannot be told apart.
        max_states: more states, before merging, are refused.
        workers: processes that share a layer; the result is the same.
        folder: keeps the finished layers there, and goes on from them.
        progress: called with a line.
    Raises:
        MissingExtra: ale-py is not installed. UnknownName: it has no such game.
        StateSpaceTooLarge: more than max_states; the message says which horizon fits.
        ParameterError: the game ends within `noops` frames, or the folder holds another game's layers.
    Cost: horizon x states of a layer x actions x frame_skip frames, 10,000 to 18,000 frames a second and process; some
        150 bytes of memory a state, 1 kB a state of the last layer, and 0.1 to 1 kB a distinct screen.
    Source: BRIDGE (Laidlaw, Russell and Dragan 2023), whose freeway_10_fs30 is met state by state.
    """
    horizon, frame_skip, noops = _checked_steps("atari", horizon, frame_skip, noops)
    name = rom_name(game)
    after = (200 if name == "skiing" else 0) if settle is None else whole_number(settle, "atari: settle", "steps", 0)
    make = partial(AtariGame, name, frame_skip, noops, all_actions, life_loss_ends, after)
    identity = {
        "game": f"atari {name}",
        **_package("ale-py"),
        "rom": storage.digest_of_file(_rom_path(name)),
        "frame_skip": frame_skip,
        "noops": noops,
        "all_actions": all_actions,
        "life_loss_ends": life_loss_ends,
    }
    words = [f"frame skip {frame_skip}", "all actions" if all_actions else "minimal actions"]
    words += ["a lost life ends" if life_loss_ends else "all lives"]
    words += [f"{noops} no-op frames"] * bool(noops) + [f"{after} steps to settle"] * bool(after)
    run = partial(explored, max_states=max_states, workers=workers, progress=progress, settles=after > 0)
    return _recorded(make, identity, words, horizon, raw, folder, run)


def procgen(  # noqa: PLR0913  (an option each)
    game: str,
    *,
    level: int = 0,
    mode: str = "easy",
    horizon: int = 10,
    frame_skip: int | None = None,
    noops: int = 0,
    all_actions: bool = False,
    raw: bool = False,
    max_states: int = MAX_STATES,
    workers: int = 1,
    folder: str | os.PathLike | None = None,
    progress: Callable[[str], object] | None = None,
) -> tuple[TabularMDP, Recording]:
    """Return the MDP of one level of a Procgen game over its first steps: deterministic, undiscounted, T steps.

    Args:
        game: such as "maze". level: seed of the level. mode: easy, hard, extreme, memory or exploration.
        frame_skip: steps of Procgen in a step, during which the action is held; None: BRIDGE's, 1 to 8.
        all_actions: all 15 actions, in place of the 9 to 13 that BRIDGE takes.
        horizon, noops, raw, max_states, workers, folder, progress: as for `atari`; noops are steps of Procgen.
    Raises:
        UnknownName: no such game or mode. StateSpaceTooLarge: as for `atari`.
        ParameterError: Procgen is not installed, and the message says how it is; or as for `atari`.
    Cost: about 1,500 steps of Procgen a second and process.
    Source: BRIDGE (Laidlaw, Russell and Dragan 2023), whose maze_easy_l0_30_fs1 is met state by state.
    """
    if game not in PROCGEN:
        raise UnknownName("game of Procgen", game, PROCGEN)
    if mode not in MODES:
        raise UnknownName("mode of Procgen", mode, MODES)
    skip = PROCGEN[game].frame_skip if frame_skip is None else frame_skip
    horizon, skip, noops = _checked_steps("procgen", horizon, skip, noops)
    level = whole_number(level, "procgen: level", "the number of a level, from 0 on", 0, 2**31 - 1)
    actions = len(COMBINATIONS) if all_actions else PROCGEN[game].num_actions
    make = partial(ProcgenGame, game, level, mode, skip, noops, actions)
    level_options = {"level": level, "mode": mode, "frame_skip": skip, "noops": noops, "actions": actions}
    identity = {"game": f"procgen {game}", **_package("procgen-mirror", "procgen"), **level_options}
    words = [f"level {level}", mode, f"frame skip {skip}", f"{actions} actions"]
    words += [f"{noops} no-op steps"] * bool(noops)
    run = partial(explored, max_states=max_states, workers=workers, progress=progress, settles=False)
    return _recorded(make, identity, words, horizon, raw, folder, run)


def building_folder(out: str | os.PathLike) -> Path:
    """The folder of finished layers within the folder of an MDP, for `folder=`.

    Raises:
        ParameterError: the folder of the MDP holds something else.
    """
    out = Path(out)
    check_free(out)
    return out / BUILDING


def save_recording(mdp: TabularMDP, recording: Recording, out: str | os.PathLike) -> Path:
    """Write an MDP and its recording into a folder, and remove the layers that an import kept there."""
    folder = save(mdp, out, source=recording.source, actions=recording.actions, observations=recording.observations)
    shutil.rmtree(folder / BUILDING, ignore_errors=True)
    return folder


def _checked_steps(kind: str, horizon: int, frame_skip: int, noops: int) -> tuple[int, int, int]:
    return (
        whole_number(horizon, f"{kind}: horizon", "a number of steps of at least 1"),
        whole_number(frame_skip, f"{kind}: frame_skip", "a number of frames of at least 1"),
        whole_number(noops, f"{kind}: noops", "a number of frames from 0 on", 0),
    )


def _recorded(
    make: Callable[[], Console],
    identity: Mapping[str, Any],
    words: list[str],
    horizon: int,
    raw: bool,
    folder: str | os.PathLike | None,
    run: Callable[..., ConsoleLayers],
) -> tuple[TabularMDP, Recording]:
    layers = run(make, identity, horizon=horizon, folder=None if folder is None else Path(folder))
    mdp = TabularMDP.from_arrays(layers.next_states, layers.rewards, gamma=1.0, horizon=horizon)
    screens, number = layers.screens, len(layers.next_states)
    if not raw:
        merged = minimize(mdp, observations=screens.index)
        mdp, screens = merged.mdp, screens.with_index(screens.index[merged.representatives])
    package = f"{identity['package']} {identity['version']}"
    source = f"{package}: {identity['game']}, {', '.join(words)}, horizon {horizon}"
    return mdp, Recording(screens, layers.actions, source, number, tuple(layers.sizes), layers.num_steps)


def _package(*names: str) -> dict[str, str]:
    """Name and version of the first of some distributions that is installed."""
    from importlib import metadata

    for name in names:
        try:
            return {"package": name, "version": metadata.version(name)}
        except metadata.PackageNotFoundError:
            continue
    return {"package": names[0], "version": "unknown"}


# Atari ----------------------------------------------------------------------------------------------------------------


def _ale() -> Any:
    try:
        import ale_py
    except ImportError:
        raise MissingExtra("Atari games", "ale-py", "atari") from None
    return ale_py


def rom_name(game: str) -> str:
    """The name of a ROM that ale-py brings; also "MsPacman", "ALE/MsPacman-v5".

    Raises:
        MissingExtra, UnknownName: as `atari`. ParameterError: ale-py knows the game and does not bring its ROM.
    """
    ale_py = _ale()
    roms = ale_py.roms.get_all_rom_ids()
    words = game.removeprefix("ALE/").split("-")[0]
    names = {name.replace("_", ""): name for name in roms}
    name = words if words in roms else names.get(words.lower().replace("_", "").replace(" ", ""))
    if name is None:
        raise UnknownName(f"game of ale-py {ale_py.__version__}", game, roms)
    if not Path(_rom_path(name)).is_file():
        raise ParameterError(
            f"atari: {name}: ale-py {ale_py.__version__} brings no ROM of it here; install another ale-py"
        )
    return name


def _rom_path(name: str) -> str:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return str(_ale().roms.get_rom_path(name) or "")


@dataclass
class AtariGame:
    """An Atari game, played from saved states.

    Attributes:
        name: of a ROM. frame_skip, noops, all_actions, life_loss_ends, settle: as for `atari`.
    """

    name: str
    frame_skip: int
    noops: int = 0
    all_actions: bool = False
    life_loss_ends: bool = True
    settle: int = 0

    def __post_init__(self) -> None:
        self._package = _ale()
        self._package.ALEInterface.setLoggerMode(self._package.LoggerMode.Error)
        self.ale = self._package.ALEInterface()
        self.ale.setInt("random_seed", 0)
        self.ale.setFloat("repeat_action_probability", 0.0)
        self.ale.setInt("frame_skip", 1)
        self.ale.loadROM(_rom_path(self.name))
        self.legal = self.ale.getLegalActionSet() if self.all_actions else self.ale.getMinimalActionSet()
        self.actions: tuple[str, ...] = tuple(action.name.lower() for action in self.legal)

    def start(self) -> bytes:
        """Reset the game, and let `noops` frames pass."""
        ale = self.ale
        ale.reset_game()
        lives = ale.lives()
        for frame in range(self.noops):
            ale.act(0)
            if ale.game_over() or (self.life_loss_ends and ale.lives() < lives):
                raise ParameterError(f"atari: {self.name} ends after {frame + 1} frames without an action; lower noops")
        return self.save()

    def load(self, saved: bytes) -> Any:
        """A saved state as ale-py has it."""
        return self._package.ALEState(saved)

    def step(self, state: Any, action: int) -> tuple[float, bool]:
        """Hold an action for all frames of a step, also after a lost life, as BRIDGE does."""
        self.ale.restoreSystemState(state)
        return self._play(self.legal[action])

    def _play(self, action: object) -> tuple[float, bool]:
        ale, reward, ends = self.ale, 0, False
        act, lives_left, lives = ale.act, ale.lives, ale.lives() if self.life_loss_ends else 0
        for _ in range(self.frame_skip):
            reward += act(action)
            ends = ends or lives_left() < lives
        return float(reward), ends or ale.game_over()

    def save(self) -> bytes:
        """The emulator's own bytes: the console, its random generators and counters."""
        return self.ale.cloneSystemState().serialize()

    def screen(self) -> np.ndarray:
        """(210, 160, 3) uint8."""
        return self.ale.getScreenRGB()

    def last_reward(self) -> float:
        """Rewards of `settle` steps without an action."""
        total = 0.0
        for _ in range(self.settle):
            reward, ends = self._play(self.legal[0])
            total += reward
            if ends:
                break
        return total


# Procgen --------------------------------------------------------------------------------------------------------------


class Convention(NamedTuple):
    """BRIDGE's numbers for a game: the first `num_actions` of Procgen's combinations, held for `frame_skip` steps."""

    num_actions: int
    frame_skip: int


PROCGEN = {
    "bigfish": Convention(9, 8),
    "bossfight": Convention(10, 8),
    "caveflyer": Convention(10, 8),  # BRIDGE has no frame skip for it
    "chaser": Convention(9, 2),
    "climber": Convention(9, 6),
    "coinrun": Convention(9, 8),
    "dodgeball": Convention(10, 8),
    "fruitbot": Convention(9, 8),
    "heist": Convention(9, 2),
    "jumper": Convention(9, 8),
    "leaper": Convention(9, 6),
    "maze": Convention(9, 1),
    "miner": Convention(9, 1),
    "ninja": Convention(13, 8),
    "plunder": Convention(10, 8),
    "starpilot": Convention(11, 8),
}
MODES = ("easy", "hard", "extreme", "memory", "exploration")
COMBINATIONS = (
    *("left+down", "left", "left+up", "down", "none", "up", "right+down", "right", "right+up"),
    *("d", "a", "w", "s", "q", "e"),
)
NOTHING = COMBINATIONS.index("none")
PROCGEN_PARTS = (
    "procgen-mirror==0.10.7 gym==0.26.2 gym-notices gym3==0.3.3 imageio moderngl glfw glcontext cffi pycparser"
)


def _procgen() -> Any:
    with warnings.catch_warnings(), contextlib.redirect_stderr(io.StringIO()):  # of the old gym
        warnings.simplefilter("ignore")
        try:
            import procgen as package
        except ImportError as error:
            raise _incomplete(error) from None
    return package


def _incomplete(error: ImportError) -> ParameterError:
    return ParameterError(
        f"Procgen needs procgen-mirror ({error}); it works with NumPy 2, which its metadata excludes: "
        f"pip install --no-deps {PROCGEN_PARTS}"
    )


@dataclass
class ProcgenGame:
    """A level of a Procgen game, played from saved states.

    Attributes:
        name, level, mode, frame_skip, noops: as for `procgen`. num_actions: the first ones of COMBINATIONS.
    """

    name: str
    level: int
    mode: str
    frame_skip: int
    noops: int
    num_actions: int

    def __post_init__(self) -> None:
        levels = {"start_level": self.level, "num_levels": 1} if self.mode != "exploration" else {}
        try:
            self.env = _procgen().ProcgenGym3Env(
                num=1, env_name=self.name, distribution_mode=self.mode, rand_seed=0, num_threads=0, **levels
            )
        except ImportError as error:  # of what it loads when it begins
            raise _incomplete(error) from None
        self.actions: tuple[str, ...] = COMBINATIONS[: self.num_actions]
        self._begin = self.save()

    def start(self) -> bytes:
        """Go to the start, and let `noops` steps pass."""
        self.env.callmethod("set_state", [self._begin])
        for step in range(self.noops):
            if self._act(NOTHING)[1]:
                raise ParameterError(f"procgen: {self.name} ends after {step + 1} steps without an action; lower noops")
        return self.save()

    def load(self, saved: bytes) -> bytes:
        """The same bytes."""
        return saved

    def step(self, state: bytes, action: int) -> tuple[float, bool]:
        """Hold an action until the episode ends, at most `frame_skip` steps."""
        self.env.callmethod("set_state", [state])
        total = 0.0
        for _ in range(self.frame_skip):
            reward, ends = self._act(action)
            total += reward
            if ends:
                return total, True
        return total, False

    def _act(self, action: int) -> tuple[float, bool]:
        self.env.act(np.array([action]))
        reward, _, is_first = self.env.observe()
        return float(reward[0]), bool(is_first[0])

    def save(self) -> bytes:
        """Procgen's own bytes."""
        return self.env.callmethod("get_state")[0]

    def screen(self) -> np.ndarray:
        """(64, 64, 3) uint8."""
        return np.array(self.env.observe()[1]["rgb"][0])

    def last_reward(self) -> float:
        """Zero: nothing is paid after the last step."""
        return 0.0
