"""PRISM and JANI models and Storm's explicit DRN files, built by Storm: https://www.stormchecker.org.

Source: Hensel, Junges, Katoen, Quatmann and Volk (2022), "The probabilistic model checker Storm"; Kwiatkowska, Norman
and Parker (2011), "PRISM 4.0".
"""

import contextlib
import ctypes
import os
import re
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pharos.errors import FileFormatError, MissingExtra, ParameterError, UnknownName
from pharos.importers.files import SUFFIXES
from pharos.importers.folder import ImportedOutcomes
from pharos.mdp import Names, Residual, TabularMDP, lacking, normalized_rows, with_sets
from pharos.system import storage
from pharos.system.wording import capped

TARGET_LABEL = "target"
"""Label under which the states of an expression or of a property are kept."""
MAXIMUM, MINIMUM, LEAST_COST, LARGEST_COST = "maximum", "minimum", "least_cost", "largest_cost"
"""Answers of `pharos.reach`, by which properties are answered."""
STEPS_REWARD = "the number of steps"
"""Stands for a reward structure, in properties Tmin and Tmax."""
LARGEST_TOTAL, LEAST_TOTAL = "largest_total", "least_total"
"""Answers of properties R [C]: the optimal and the worst value at gamma 1 without a horizon."""


class Question(NamedTuple):
    """The number that a property asks for.

    Attributes:
        text: the property.
        reach: label of the states to be reached; None: rewards are added up for ever.
        answer: the attribute of `pharos.reach(mdp, reach)` that has it; or LARGEST_TOTAL or LEAST_TOTAL.
        of_starts: "mean", "max" or "min" of the start states, if there are several.
    """

    text: str
    reach: str | None
    answer: str
    of_starts: str


class StormImport(NamedTuple):
    """A model that Storm built.

    Attributes:
        mdp: with the names of its labels, variables and choices.
        outcomes: with the reward of each; None if no choice pays different rewards.
        question: of the property, if one was given.
    """

    mdp: TabularMDP
    outcomes: ImportedOutcomes | None
    question: Question | None


def storm(
    path: str | os.PathLike,
    *,
    constants: str = "",
    reward: str | None = None,
    target: str | None = None,
    property: str | None = None,
    gamma: float = 1.0,
    horizon: int | None = None,
) -> TabularMDP:
    """Return the MDP of a model of discrete time: MDPs, and Markov chains, which have one action.

    Action a of a state is its choice number a. A state with fewer choices than others has fewer actions: those beyond
    are not available there. State s of the MDP is state s of Storm. `mdp.names` has the model's labels, the values of
    its variables in each state, and the names of its choices.

    Args:
        path: a model in PRISM's language (.prism, .nm, .pm), in JANI (.jani), or an explicit one (.drn).
        constants: values of its undefined constants, such as "N=3,K=2".
        reward: name of a reward structure; None: the only one, if there is no target. State rewards are paid with
            every action there; the MDP pays rewards of transitions on average.
        target: a label or an expression, such as "finished & !agree", whose states end the episode; without a reward
            structure, reaching one pays 1, so that the optimal value at gamma 1 is the maximal probability of reaching
            it.
        property: instead of these two, a property in PRISM's language, or the name of one in a JANI file:
            P, Pmax or Pmin=? [F target] or [a U target]; R{"reward"}, Rmax or Rmin=? [F target] or [C]; Tmax or
            Tmin=? [F target], of steps. Its target ends the episode, and of U the states in which `a` does not hold.
        gamma, horizon: of the MDP.
    Raises:
        MissingExtra: stormpy is not installed.
        ParameterError: no such file, or no property that pharos answers. UnknownName: no such reward structure or
            label.
        FileFormatError: Storm cannot read it, constants are missing, or it is of another kind (continuous time, partial
            observability, parameters).
    """
    return storm_import(
        path, constants=constants, reward=reward, target=target, property=property, gamma=gamma, horizon=horizon
    ).mdp


def storm_recording(
    path: str | os.PathLike,
    *,
    constants: str = "",
    reward: str | None = None,
    target: str | None = None,
    property: str | None = None,
    gamma: float = 1.0,
    horizon: int | None = None,
) -> tuple[TabularMDP, ImportedOutcomes | None]:
    """Return the MDP of `storm`, and its outcomes with the reward of each, for `importers.save(..., outcomes=)`.

    The outcomes are None if no choice pays different rewards: the MDP then says it all.

    Args, errors: as of `storm`.
    """
    return storm_import(
        path, constants=constants, reward=reward, target=target, property=property, gamma=gamma, horizon=horizon
    )[:2]


def storm_import(
    path: str | os.PathLike,
    *,
    constants: str = "",
    reward: str | None = None,
    target: str | None = None,
    property: str | None = None,
    gamma: float = 1.0,
    horizon: int | None = None,
) -> StormImport:
    """Return a model that Storm built, and the question that its property asks.

    Args, errors: as of `storm`.
    """
    if property is not None and (reward is not None or target is not None):
        raise ParameterError("a property says reward and target; leave out --reward and --target")
    path = Path(path)
    built = _model(path, constants, target, property)
    model = built.model
    labels = sorted(model.labeling.get_labels())
    names = list(model.reward_models)
    query, ended = built.query, np.zeros(model.nr_states, np.bool_)
    if query is not None:
        reward = query.reward
        if reward == "" or (reward not in (None, STEPS_REWARD, *names)):
            if reward or len(names) != 1:
                raise UnknownName(f"reward structure of {path}", reward, names)
            reward = names[0]
        ended = query.goal | query.failed
    elif target is not None:
        ended[list(model.labeling.get_states(target))] = True
    elif reward is None and len(names) == 1:
        reward = names[0]
    if reward not in (None, STEPS_REWARD, *names):
        raise UnknownName(f"reward structure of {path}", reward, names)
    if reward is None and target is None and property is None:
        raise ParameterError(
            f"{path}: nothing says what is paid; give a reward structure ({', '.join(names) or 'it has none'}), a "
            f"target: a label ({', '.join(labels)}) or an expression; or a property"
        )
    goal = ended if query is None else query.goal
    paying = Steps() if reward == STEPS_REWARD else None if reward is None else model.reward_models[reward]
    outcomes = _outcomes(model, ended, goal, paying)
    actions = (len(outcomes.offsets) - 1) // model.nr_states

    def refuse(row: int, total: float) -> FileFormatError:
        where, words = f"state {row // actions}, choice {row % actions}", built.refusal
        return FileFormatError(
            f"{path}: the probabilities of {where} sum to {total:.9g}; expected 1{words and f'; Storm: {words}'}"
        )

    of = np.repeat(np.arange(len(outcomes.offsets) - 1), np.diff(outcomes.offsets))
    probabilities, residuals = normalized_rows(outcomes.probabilities, of, len(outcomes.offsets) - 1, refuse)
    outcomes = outcomes._replace(probabilities=probabilities)
    mdp = _mdp(model, outcomes, gamma, horizon)
    counts = np.array([len(_choices(model, s)) for s in range(model.nr_states)])
    names_of_model, reach = _names(model, actions, None if query is None or query.is_total else query)
    mdp = replace(
        with_sets(mdp, np.arange(actions) < counts[:, None]),
        residual=Residual.of(residuals, np.maximum.reduceat(np.abs(outcomes.rewards), outcomes.offsets[:-1])),
        names=names_of_model,
    )
    question = None
    if query is not None and property is not None:
        question = Question(query.text, None if query.is_total else reach, query.answer, query.of_starts)
    return StormImport(mdp, outcomes if _differ(outcomes) else None, question)


def _names(model: Any, num_actions: int, query: "Query | None") -> tuple[Names, str]:
    """(names of the model's labels, variables and choices, label of the states to be reached)."""
    states = model.nr_states
    labels = {}
    for label in sorted(model.labeling.get_labels()):
        if label != OUT_OF_BOUNDS and not label.startswith(("(", "!")):  # those are expressions of properties
            labels[label] = np.zeros(states, np.bool_)
            labels[label][list(model.labeling.get_states(label))] = True
    reach = TARGET_LABEL
    if query is not None:
        goal = query.goal
        same = [label for label, mask in labels.items() if f'"{label}"' in query.text and (mask == goal).all()]
        while reach in labels and reach not in same:
            reach += "_"
        reach = same[0] if same else reach
        labels[reach] = goal
    variables = _variables(model, states) if model.has_state_valuations() else {}
    if not model.has_choice_labeling():
        return Names(labels, variables), reach
    codes, numbers = np.full((states, num_actions), -1, np.int64), dict[str, int]()
    for s in range(states):
        for a, choice in enumerate(_choices(model, s)):
            name = ", ".join(sorted(model.choice_labeling.get_labels_of_choice(choice)))
            if name:
                codes[s, a] = numbers.setdefault(name, len(numbers))
    if not numbers:
        return Names(labels, variables), reach
    return Names(labels, variables, None, codes, tuple(numbers)), reach


def _variables(model: Any, states: int) -> dict[str, np.ndarray]:
    """The variables that have whole or truth values in all states; without locations of which there is but one."""
    valuations = model.state_valuations
    columns = {}
    for variable in sorted(valuations.get_all_variables(), key=lambda each: each.index):
        if not all(valuations.entity_has_variable(s, variable) for s in range(states)):
            continue
        if variable.has_boolean_type():
            columns[variable.name] = np.array([bool(valuations.get_value(s, variable)) for s in range(states)])
        elif variable.has_integer_type():
            column = np.array(valuations.get_int64_values(variable), np.int64)
            if not variable.name.startswith("_loc_") or column.min() < column.max():
                columns[variable.name] = column
    return columns


def _outcomes(model: Any, ended: np.ndarray, goal: np.ndarray, reward_model: Any) -> ImportedOutcomes:
    """Outcomes of every state and action with their rewards; states in `ended` lead to the end of the episode.

    Without rewards, a transition into `goal` pays 1.
    """
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
            rewards += [0.0] if ended[s] else _rewards(reward_model, s, choice, successors[offsets[-1] :], goal)
            offsets.append(len(successors))
    return ImportedOutcomes(
        np.array(offsets), np.array(successors, np.int64), np.array(probabilities), np.array(rewards, np.float64)
    )


def _choices(model: Any, state: int) -> range:
    """The choices of a state, as rows of Storm's matrix."""
    matrix = model.transition_matrix
    return range(matrix.get_row_group_start(state), matrix.get_row_group_end(state))


def _rewards(reward_model: Any, state: int, choice: int, successors: list[int], goal: np.ndarray) -> list[float]:
    """Reward of a choice with each successor: the sum of the rewards of state, choice and transition."""
    if reward_model is None:
        return [float(successor >= 0 and goal[successor]) for successor in successors]
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


class Steps:
    """The reward structure that pays 1 with every choice, of properties Tmin and Tmax: expected numbers of steps."""

    has_state_rewards = has_transition_rewards = False
    has_state_action_rewards = True

    @staticmethod
    def get_state_action_reward(_: int) -> float:
        return 1.0


class Query(NamedTuple):
    """States of a target or a property, and what it asks.

    Attributes:
        text: the property. goal, failed: (S,) bool, whether it has come true, and whether it no longer can.
        reward: name of its reward structure, "" for the only one, STEPS for steps; None: probabilities.
        answer, of_starts: as of `Question`. is_total: whether rewards are added up for ever.
    """

    text: str
    goal: np.ndarray
    failed: np.ndarray
    reward: str | None = None
    answer: str = MAXIMUM
    of_starts: str = "mean"
    is_total: bool = False


class Built(NamedTuple):
    """A model of Storm; what Storm says of sums that differ from 1, if it says anything; and what is asked of it."""

    model: Any
    refusal: str
    query: Query | None


def _model(path: Path, constants: str, target: str | None, property: str | None) -> Built:
    try:
        import stormpy  # noqa: F401
    except ImportError:
        raise MissingExtra("importing PRISM, JANI and DRN models", "stormpy", "storm") from None
    if path.suffix not in SUFFIXES:
        raise ParameterError(f"{path}: expected a name that ends in {', '.join(SUFFIXES)}")
    try:
        storage.check_regular(path)
    except OSError as error:
        raise ParameterError(f"{path}: {error.strerror}; expected a file of a model") from None
    with _storms_output() as printed:
        try:
            program, properties = _program(path, constants)
            formula = None if property is None else _formula(path, program, properties, property)
            model, refusal = _checked_model(path, program, formula)
            if target is not None and target not in model.labeling.get_labels():
                formula = _target(path, program, model, target)
                model, refusal = _checked_model(path, program, formula)
            query = None if formula is None else _query_of(model, formula)
        except (FileFormatError, ParameterError):
            raise
        except Exception as error:  # of Storm, which has many, and of the bindings
            reason = _first_error(printed()) or _without_type(error)
            raise FileFormatError(f"{path}: Storm cannot build it: {capped(reason, 600)}") from None
    kind = str(model.model_type).rpartition(".")[2]
    if kind not in ("DTMC", "MDP"):
        raise FileFormatError(f"{path}: is a model of type {kind}; expected an MDP or a DTMC")
    if query is not None and property is not None and kind == "MDP" and not OPTIMUM.search(query.text):
        raise ParameterError(
            f"{path}: {query.text}: says neither max nor min; expected one of them, such as Pmax=? or Rmin=?"
        )
    return Built(model, refusal, query)


def _program(path: Path, constants: str) -> tuple[Any, dict[str, Any]]:
    """(model of a file with its constants, None for an explicit one; the properties of a JANI file by name)."""
    import stormpy

    if path.suffix == ".drn":
        return None, {}
    program, listed = (
        stormpy.parse_jani_model(str(path)) if path.suffix == ".jani" else (stormpy.parse_prism_program(str(path)), [])
    )
    if constants:  # of the properties too, which Storm else reads with any value
        program, listed = stormpy.instantiate_constants(program, constants, listed)
    return program, {each.get_name(): each for each in listed}


OPTIMUM = re.compile(r"^\s*(?:filter\(\w+,\s*)?[PRT](?:\{[^}]*\})?(?:max|min)")
REWARD_LAST = re.compile(r"\bR(max|min)\s*(\{[^}]*\})")
"""PRISM's Rmax{"steps"}, which Storm writes R{"steps"}max."""
DENIED = re.compile(r"!\s*(\w+\s*(?:<=|>=|!=|=|<|>)\s*-?\w+)")
"""!x=3, which is !(x=3) in PRISM, and refused by Storm."""
FORMS = (
    'P, Pmax or Pmin=? [F target] or [a U b]; R, Rmax or Rmin=? [F target] or [C], of a reward structure R{"name"}; '
    "Tmax or Tmin=? [F target]"
)


def _formula(path: Path, program: object, properties: dict[str, Any], text: str) -> Any:
    """A property of Storm, by its name in a JANI file, or parsed."""
    if text in properties:
        return properties[text]
    try:
        parsed = _parsed(text, program)
    except Exception as error:
        named = f"; properties of the file: {', '.join(properties)}" if properties else ""
        reason = _without_type(error)
        raise ParameterError(
            f"{path}: property {capped(text)!r}: Storm cannot read it: {capped(reason)}; expected {FORMS}{named}"
        ) from None
    if len(parsed) != 1:
        raise ParameterError(f"{path}: property {capped(text)!r}: is {len(parsed)} properties; expected one")
    return parsed[0]


def _parsed(text: str, program: object) -> list[Any]:
    """Properties of Storm, from a text as PRISM reads it."""
    import stormpy

    words = DENIED.sub(r"!(\1)", REWARD_LAST.sub(r"R\2\1", text))
    return list(stormpy.parse_properties(words) if program is None else stormpy.parse_properties(words, program))


def _target(path: Path, program: Any, model: Any, text: str) -> Any:
    """The property of reaching a target that is no label: an expression, with labels in quotes or without."""
    labels = {*model.labeling.get_labels()}
    try:
        words = re.sub(r'"[^"]*"|[A-Za-z_]\w*', lambda match: _quoted(match[0], labels, program), text)
        return _parsed(f"P=? [F ({words})]", program)[0]
    except Exception as error:
        if re.fullmatch(r"\w+", text):
            raise UnknownName(f"label of {path}", text, labels) from None
        raise ParameterError(
            f"{path}: target {capped(text)!r}: is no label ({', '.join(sorted(labels))}), and as an expression Storm "
            f"cannot read it: {capped(_without_type(error))}"
        ) from None


def _quoted(word: str, labels: set[str], program: Any) -> str:
    """A label in quotes, if it is one and no variable is called so."""
    if word not in labels or program is None:
        return f'"{word}"' if word in labels else word
    variables = {each.name for each in program.expression_manager.get_variables()}
    return word if word in variables else f'"{word}"'


def _query_of(model: Any, prop: Any) -> Query:
    """The query of a property of Storm, and the states that it speaks of.

    Raises:
        ParameterError: it asks what pharos does not answer.
    """
    import stormpy

    formula, states = prop.get_raw_formula(), model.nr_states
    text = str(formula)

    def refused() -> ParameterError:
        advice = "; steps are --target with --horizon" if "<=" in text.partition("[")[2] else ""
        return ParameterError(f"property {capped(text)!r}: is not answered; expected {FORMS}{advice}")

    def where(condition: object) -> np.ndarray:
        mask = np.zeros(states, np.bool_)
        mask[list(stormpy.model_checking(model, condition).get_truth_values_vector())] = True
        return mask

    kind = {"ProbabilityOperatorFormula": "P", "RewardOperatorFormula": "R", "TimeOperatorFormula": "T"}.get(
        type(formula).__name__
    )
    if kind is None or formula.has_bound:
        raise refused()
    path, nothing = formula.subformula, np.zeros(states, np.bool_)
    is_least = formula.has_optimality_type and str(formula.optimality_type).endswith("MINIMIZE")
    match = re.search(r"Obtain the (\w+) of the", str(prop))
    of_starts = {"maximum": "max", "minimum": "min"}.get(match[1] if match else "", "mean")
    query = Query(text, nothing, nothing, None, MINIMUM if is_least else MAXIMUM, of_starts)
    shape = type(path).__name__
    if kind == "T":
        query = query._replace(reward=STEPS_REWARD, answer=LEAST_COST if is_least else LARGEST_COST)
    if kind == "R":
        named = re.match(r'R\{"([^"]*)"\}', text)  # its `reward_name` fails if there is none
        query = query._replace(reward=named[1] if named else "", answer=LEAST_COST if is_least else LARGEST_COST)
        if str(path) == "C":
            return query._replace(answer=LEAST_TOTAL if is_least else LARGEST_TOTAL, is_total=True)
    if shape == "EventuallyFormula":
        return query._replace(goal=where(path.subformula))
    if shape == "UntilFormula" and kind == "P":
        goal = where(path.right_subformula)
        return query._replace(goal=goal, failed=~where(path.left_subformula) & ~goal)
    raise refused()


def _checked_model(path: Path, program: Any, prop: Any = None) -> tuple[Any, str]:
    """The model, and what Storm says of sums of probabilities that differ from 1, which may be rounded.

    Raises:
        RuntimeError: of Storm's checks of each command, but the one of sums.
        FileFormatError: an update leaves the range of a variable, in a command that Storm did not get to.
    """
    import stormpy

    if program is None:
        return stormpy.build_model_from_drn(str(path)), ""
    options = _options(prop)
    options.set_exploration_checks(True)
    try:
        return stormpy.build_model(program, options=options), ""
    except RuntimeError as error:
        refusal = _without_type(error)
        if not NOT_ONE.search(refusal):
            raise
    options = _options(prop)
    options.set_add_out_of_bounds_state(True)
    model = stormpy.build_model(program, options=options)
    if OUT_OF_BOUNDS in model.labeling.get_labels():
        raise FileFormatError(
            f"{path}: some update leaves the range of its variable; Storm stopped before it: {refusal}"
        )
    return model, refusal


def _options(prop: Any) -> Any:
    """Storm's options: everything is built, with names, and the expressions of a property."""
    import stormpy

    # Of a single formula, Storm would leave out what comes after its target
    options = stormpy.BuilderOptions([] if prop is None else [prop.get_raw_formula()] * 2)
    options.set_build_all_labels()
    options.set_build_all_reward_models()
    options.set_build_state_valuations()
    options.set_build_choice_labels()
    return options


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
