"""Files of other programs: BRIDGE's npz, and models that Storm builds.

Tabular MDPs of the BRIDGE dataset (Laidlaw, Russell and Dragan 2023): `consolidated.npz` and the like.

PRISM and JANI models and Storm's explicit DRN files, built by Storm: https://www.stormchecker.org. Source: Hensel,
Junges, Katoen, Quatmann and Volk (2022), "The probabilistic model checker Storm"; Kwiatkowska, Norman and Parker
(2011), "PRISM 4.0".
"""

import contextlib
import ctypes
import os
import re
import sys
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pharos.errors import FileFormatError, MissingExtra, ParameterError, UnknownName
from pharos.importers.folder import ImportedOutcomes
from pharos.mdp import Residual, TabularMDP, lacking, normalized_rows, whole_number, with_sets
from pharos.system import storage
from pharos.system.wording import capped

MINIGRID_STEPS = 100
LARGEST_HORIZON = 100_000
"""In the name of a file: those of BRIDGE say 8 to 200, and values take time for each step."""


def bridge(path: str | os.PathLike, horizon: int | None = None) -> TabularMDP:
    """Return the MDP of a BRIDGE file: undiscounted, T steps, starting in row 0, -1 ending the episode.

    Args:
        path: npz with `transitions` (S, A) integers and `rewards` (S, A); other members are not read.
        horizon: T; None: what the name says: `<rom>_<T>_fs<k>` for Atari and Procgen, 100 for MiniGrid.
    Raises:
        FileFormatError: no npz, a member is missing, pickled, of the wrong shape, or holds an index or reward out of
            range.
        ParameterError: no horizon can be told, or the one given contradicts the name.
    Source: BRIDGE, https://doi.org/10.5281/zenodo.10966777, its data card. The horizon matters: states that are first
        met at depth T are coded as terminal.
    """
    path = Path(path)
    arrays = _members(path, ("transitions", "rewards"))
    transitions, rewards = arrays["transitions"], arrays["rewards"]
    if transitions.ndim != 2 or transitions.dtype.kind not in "iu" or not transitions.size:
        raise FileFormatError(
            f"{path}: transitions have shape {transitions.shape} and type {transitions.dtype}; "
            f"expected integers (states, actions)"
        )
    if rewards.shape != transitions.shape or rewards.dtype.kind not in "iuf":
        raise FileFormatError(
            f"{path}: rewards have shape {rewards.shape} and type {rewards.dtype}; "
            f"expected numbers of shape {transitions.shape}"
        )
    steps = _horizon(path, horizon)
    try:
        return TabularMDP.from_arrays(transitions, rewards.astype(np.float64), gamma=1.0, horizon=steps)
    except ParameterError as error:
        raise FileFormatError(f"{path}: {error}") from None


def bridge_screens(path: str | os.PathLike) -> np.ndarray:
    """Return the screen of each state, (S, H, W, 3) uint8, where the file has screens.

    Raises:
        FileFormatError: it has none, or they do not fit.
    """
    path = Path(path)
    arrays = _members(path, ("transitions", "screens", "screen_mapping"))
    screens, mapping = arrays["screens"], arrays["screen_mapping"]
    if screens.ndim != 4 or screens.dtype != np.uint8 or mapping.shape != (len(arrays["transitions"]),):
        raise FileFormatError(
            f"{path}: screens have shape {screens.shape}, screen_mapping {mapping.shape}; "
            f"expected (screens, height, width, 3) uint8 and one number a state"
        )
    if mapping.dtype.kind not in "iu" or (mapping < 0).any() or (mapping >= len(screens)).any():
        raise FileFormatError(
            f"{path}: screen_mapping names a screen that is not there; expected 0 to {len(screens) - 1}"
        )
    return screens[mapping]


def has_screens(path: str | os.PathLike) -> bool:
    """Whether a file of BRIDGE has the screens of its states; only the list of its members is read."""
    try:
        storage.check_regular(path)
        with zipfile.ZipFile(path) as file:
            return {"screens.npy", "screen_mapping.npy"} <= set(file.namelist())
    except (OSError, zipfile.BadZipFile):
        return False


def how_to_import(path: Path) -> str:
    """The command that brings a file into a folder; or which files can be."""
    kind = "prism" if path.suffix in SUFFIXES else "bridge" if path.suffix == ".npz" else ""
    if kind:
        return f"`pharos import {kind} {path} --out FOLDER`"
    return (
        f"`pharos import` takes {', '.join(SUFFIXES)} and BRIDGE's .npz; matrices of other files go to "
        f"importers.matrices(P, R) and importers.save in Python"
    )


def _members(path: Path, names: tuple[str, ...]) -> dict[str, np.ndarray]:
    try:
        storage.check_regular(path)
        if path.exists() and not zipfile.is_zipfile(path):
            advice = "" if path.suffix == ".npz" else f"; {how_to_import(path)}"
            raise FileFormatError(f"{path}: cannot be read as npz: it is no zip archive{advice}")
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as stored:
            missing = [name for name in names if name not in stored.files]
            if missing:
                raise FileFormatError(
                    f"{path}: lacks {', '.join(missing)}; found {', '.join(stored.files) or 'nothing'}: "
                    f"expected a file of BRIDGE"
                )
            return {name: stored[name] for name in names}
    except FileNotFoundError:
        raise ParameterError(f"{path}: no such file") from None
    except FileFormatError:
        raise
    except (
        Exception
    ) as error:  # of zipfile, zlib, lzma, struct, NumPy and the parser of array headers: each has its own
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise FileFormatError(f"{path}: cannot be read as npz without unpickling: {reason}") from None


def _horizon(path: Path, horizon: int | None) -> int:
    named = horizon_of_name(path)
    if horizon is not None:
        whole_number(horizon, "horizon", "a whole number of steps, at least 1")
    if named is None and horizon is None:
        raise ParameterError(
            f"{path}: its name does not tell the horizon; give one (`--horizon T`), as its values depend on it"
        )
    if named is not None and horizon is not None and named != horizon:
        raise ParameterError(f"{path}: horizon {horizon} contradicts its name, which says {named}; leave it out")
    if horizon is None and named is not None and named > LARGEST_HORIZON:
        raise ParameterError(
            f"{path}: its name says {named} steps; expected at most {LARGEST_HORIZON}: "
            f"give a horizon (`--horizon T`) and another name"
        )
    return int(named if horizon is None else horizon)  # type: ignore[arg-type]


def horizon_of_name(path: Path) -> int | None:
    """T from the name of a file or its folder: `freeway_10_fs30`, or MiniGrid."""
    for name in (path.stem, path.resolve().parent.name):
        match = re.search(r"_(\d+)_fs\d+", name)
        if match:
            return int(match[1])
        if "minigrid" in name.lower():
            return MINIGRID_STEPS
    return None


# Storm ----------------------------------------------------------------------------------------------------------------


SUFFIXES = (".prism", ".nm", ".pm", ".sm", ".jani", ".drn")


def storm(
    path: str | os.PathLike,
    *,
    constants: str = "",
    reward: str | None = None,
    target: str | None = None,
    gamma: float = 1.0,
    horizon: int | None = None,
) -> TabularMDP:
    """Return the MDP of a model of discrete time: MDPs, and Markov chains, which have one action.

    Action a of a state is its choice number a. A state with fewer choices than others has fewer actions: those beyond
    are not available there. State s of the MDP is state s of Storm.

    Args:
        path: a model in PRISM's language (.prism, .nm, .pm), in JANI (.jani), or an explicit one (.drn).
        constants: values of its undefined constants, such as "N=3,K=2".
        reward: name of a reward structure; None: the only one, where there is no target. State rewards are paid with
            every action there; the MDP pays rewards of transitions on average.
        target: a label whose states end the episode; without a reward structure, reaching one pays 1, so that the
            optimal value at gamma 1 is the maximal probability of reaching it.
        gamma, horizon: of the MDP.
    Raises:
        MissingExtra: stormpy is not installed.
        ParameterError: no such file; UnknownName: no such reward structure or label.
        FileFormatError: Storm cannot read it, constants are missing, or it is of another kind (continuous time, partial
            observability, parameters).
    """
    return storm_recording(path, constants=constants, reward=reward, target=target, gamma=gamma, horizon=horizon)[0]


def storm_recording(
    path: str | os.PathLike,
    *,
    constants: str = "",
    reward: str | None = None,
    target: str | None = None,
    gamma: float = 1.0,
    horizon: int | None = None,
) -> tuple[TabularMDP, ImportedOutcomes | None]:
    """Return the MDP of `storm`, and its outcomes with the reward of each, for `importers.save(..., outcomes=)`.

    The outcomes are None where no choice pays different rewards, so that the MDP says it all.

    Raises:
        As `storm`.
    """
    model, refusal = _model(Path(path), constants)
    labels = sorted(model.labeling.get_labels())
    if target is not None and target not in labels:
        raise UnknownName(f"label of {path}", target, labels)
    names = list(model.reward_models)
    if reward is None and target is None and len(names) == 1:
        reward = names[0]
    if reward is not None and reward not in names:
        raise UnknownName(f"reward structure of {path}", reward, names)
    if reward is None and target is None:
        raise ParameterError(
            f"{path}: nothing says what is paid; give a reward structure ({', '.join(names) or 'it has none'}) or a "
            f"target label ({', '.join(labels)})"
        )
    ended = np.zeros(model.nr_states, np.bool_)
    if target is not None:
        ended[list(model.labeling.get_states(target))] = True
    outcomes = _outcomes(model, ended, None if reward is None else model.reward_models[reward])
    actions = (len(outcomes.offsets) - 1) // model.nr_states

    def refuse(row: int, total: float) -> FileFormatError:
        where = f"state {row // actions}, choice {row % actions}"
        return FileFormatError(
            f"{path}: the probabilities of {where} sum to {total:.9g}; expected 1{refusal and f'; Storm: {refusal}'}"
        )

    of = np.repeat(np.arange(len(outcomes.offsets) - 1), np.diff(outcomes.offsets))
    probabilities, residuals = normalized_rows(outcomes.probabilities, of, len(outcomes.offsets) - 1, refuse)
    outcomes = outcomes._replace(probabilities=probabilities)
    mdp = _mdp(model, outcomes, gamma, horizon)
    counts = np.array([len(_choices(model, s)) for s in range(model.nr_states)])
    mdp = replace(
        with_sets(mdp, np.arange(actions) < counts[:, None]),
        residual=Residual.of(residuals, np.maximum.reduceat(np.abs(outcomes.rewards), outcomes.offsets[:-1])),
    )
    return mdp, outcomes if _differ(outcomes) else None


def _outcomes(model: Any, ended: np.ndarray, reward_model: Any) -> ImportedOutcomes:
    """Outcomes of every state and action with their rewards; states in `ended` lead to the end of the episode."""
    matrix, states = model.transition_matrix, model.nr_states
    choices = [_choices(model, s) for s in range(states)]
    actions = max(map(len, choices))
    offsets: list[int] = [0]
    successors: list[int] = []
    probabilities: list[float] = []
    rewards: list[float] = []
    for s in range(states):
        for a in range(actions):
            choice = choices[s][a] if a < len(choices[s]) else choices[s][0]  # an action that is not available
            row = [] if ended[s] else [(int(entry.column), float(entry.value)) for entry in matrix.get_row(choice)]
            row = row or [(-1, 1.0)]
            successors += [successor for successor, _ in row]
            probabilities += [p for _, p in row]
            rewards += [0.0] if ended[s] else _rewards(reward_model, s, choice, successors[offsets[-1] :], ended)
            offsets.append(len(successors))
    return ImportedOutcomes(
        np.array(offsets), np.array(successors, np.int64), np.array(probabilities), np.array(rewards, np.float64)
    )


def _choices(model: Any, state: int) -> range:
    """The choices of a state, as rows of Storm's matrix."""
    matrix = model.transition_matrix
    return range(matrix.get_row_group_start(state), matrix.get_row_group_end(state))


def _rewards(reward_model: Any, state: int, choice: int, successors: list[int], ended: np.ndarray) -> list[float]:
    """Reward of a choice with each successor: the sum of the rewards of state, choice and transition."""
    if reward_model is None:
        return [float(successor >= 0 and ended[successor]) for successor in successors]
    always = 0.0
    if reward_model.has_state_rewards:
        always += float(reward_model.get_state_reward(state))
    if reward_model.has_state_action_rewards:
        always += float(reward_model.get_state_action_reward(choice))
    if not reward_model.has_transition_rewards:
        return [always] * len(successors)
    of = {entry.column: float(entry.value) for entry in reward_model.transition_rewards.get_row(choice)}
    return [always + of.get(successor, 0.0) for successor in successors]


def _differ(outcomes: ImportedOutcomes) -> bool:
    """Whether some state and action pays different rewards."""
    begin = outcomes.offsets[:-1]
    return bool((np.minimum.reduceat(outcomes.rewards, begin) < np.maximum.reduceat(outcomes.rewards, begin)).any())


def _mdp(model: Any, outcomes: ImportedOutcomes, gamma: float, horizon: int | None) -> TabularMDP:
    from scipy import sparse

    begin, counts, states = outcomes.offsets[:-1], np.diff(outcomes.offsets), model.nr_states
    rows = np.repeat(np.arange(len(counts)), counts)
    goes_on = outcomes.next_states >= 0
    table = sparse.csr_matrix(
        (outcomes.probabilities[goes_on], (rows[goes_on], outcomes.next_states[goes_on])), shape=(len(counts), states)
    )
    means = np.add.reduceat(outcomes.probabilities * outcomes.rewards, begin)
    is_constant = np.minimum.reduceat(outcomes.rewards, begin) == np.maximum.reduceat(outcomes.rewards, begin)
    rewards = np.where(is_constant, outcomes.rewards[begin], means).reshape(states, -1)
    starts = list(model.initial_states)
    setting: dict[str, Any] = {"gamma": gamma, "initial": starts[0] if len(starts) == 1 else starts}
    return TabularMDP.from_matrices(table, rewards, horizon=horizon, ends=lacking(table), **setting)


NOT_ONE = re.compile("do not s[uo]me? to one")
"""In the refusal of Storm's checks, which compare sums with 1 as exact fractions; "some" for synchronised commands."""


def _model(path: Path, constants: str) -> tuple[Any, str]:
    """(model, what Storm says of sums that differ from 1, where it says anything)."""
    try:
        import stormpy
    except ImportError:
        raise MissingExtra("importing PRISM, JANI and DRN models", "stormpy", "storm") from None
    if path.suffix not in SUFFIXES:
        raise ParameterError(f"{path}: expected a name that ends in {', '.join(SUFFIXES)}")
    try:
        storage.check_regular(path)
    except OSError as error:
        raise ParameterError(f"{path}: {error.strerror}; expected a file of a model") from None
    refusal = ""
    with _storms_output() as printed:
        try:
            if path.suffix == ".drn":
                model = stormpy.build_model_from_drn(str(path))
            else:
                jani = path.suffix == ".jani"
                program = stormpy.parse_jani_model(str(path))[0] if jani else stormpy.parse_prism_program(str(path))
                if constants:
                    program = stormpy.instantiate_constants(program, constants)[0]
                model, refusal = _checked_model(path, program)
        except FileFormatError:
            raise
        except Exception as error:  # of Storm, which has many, and of the bindings
            reason = _first_error(printed()) or _without_type(error)
            raise FileFormatError(f"{path}: Storm cannot build it: {capped(reason, 600)}") from None
    kind = str(model.model_type).rpartition(".")[2]
    if kind not in ("DTMC", "MDP"):
        raise FileFormatError(f"{path}: is a model of type {kind}; expected an MDP or a DTMC")
    return model, refusal


def _checked_model(path: Path, program: object) -> tuple[Any, str]:
    """The model, and what Storm says of sums of probabilities that differ from 1, which may be rounded.

    Raises:
        RuntimeError: of Storm's checks of each command, but the one of sums.
        FileFormatError: an update leaves the range of a variable, in a command that Storm did not get to.
    """
    import stormpy

    options = stormpy.BuilderOptions(build_full=True)
    options.set_exploration_checks(True)
    try:
        return stormpy.build_model(program, options=options), ""
    except RuntimeError as error:
        refusal = _without_type(error)
        if not NOT_ONE.search(refusal):
            raise
    options = stormpy.BuilderOptions(build_full=True)
    options.set_add_out_of_bounds_state(True)
    model = stormpy.build_model(program, options=options)
    if OUT_OF_BOUNDS in model.labeling.get_labels():
        raise FileFormatError(
            f"{path}: some update leaves the range of its variable; Storm stopped before it: {refusal}"
        )
    return model, refusal


OUT_OF_BOUNDS = "out_of_bounds"
"""Storm's label of the state that updates out of range lead to."""


@contextlib.contextmanager
def _storms_output() -> Iterator[Callable[[], str]]:
    """Catch what Storm prints past Python; yields a function that returns it. If all goes well, it goes to stderr."""
    flush = ctypes.CDLL(None).fflush
    sys.stdout.flush()
    sys.stderr.flush()
    with tempfile.TemporaryFile() as file:
        saved = [os.dup(number) for number in (1, 2)]

        def printed() -> str:
            flush(None)
            file.seek(0)
            return file.read().decode(errors="replace")

        try:
            flush(None)
            for number in (1, 2):
                os.dup2(file.fileno(), number)
            yield printed
        finally:
            text = printed()
            for number, own in zip((1, 2), saved, strict=True):
                os.dup2(own, number)
                os.close(own)
        sys.stderr.write("".join(line for line in text.splitlines(keepends=True) if not NOT_ONE.search(line)))


def _without_type(error: Exception) -> str:
    """Storm's message, in one line, without the name of its exception."""
    return re.sub(r"^\w+Exception: ", "", " ".join(str(error).split()))


def _first_error(printed: str) -> str:
    """The first error that Storm prints, which is often clearer than the last one."""
    match = re.search(r"ERROR \([^)]*\): (.*?)(?=\n(?:ERROR|WARN|INFO) |\Z)", printed, re.DOTALL)
    return " ".join(match[1].split()) if match else ""
