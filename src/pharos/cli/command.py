"""Commands from functions: their parameters are arguments and options, and their docstrings the help texts.

    @app.command("solve")
    def solve(target: Target, *, chance: ChanceSetting, threads: Count = 1) -> Answer:
        '''Find the optimal values.

        Args:
            threads: Use this many threads for a sweep.
        '''

A parameter is an argument, one after `*` is an option; `Annotated[Path, "DIR"]` says what stands for its value in help.
A parameter that is a dataclass stands for an option of each of its fields, and the function gets one object;
`Annotated[ChanceSetting, "sticky random"]` has these fields alone.
"""

import dataclasses
import functools
import inspect
import operator
from collections.abc import Callable, Iterator, Mapping
from copy import copy
from types import UnionType
from typing import TYPE_CHECKING, Annotated, Any, Union, get_args, get_origin

import typer
from typer.models import ArgumentInfo, OptionInfo, ParameterInfo

from pharos.cli.answers import Answer
from pharos.cli.options import parse_parameters
from pharos.environments import declared_parameters
from pharos.system.records import docstring_entries, first_sentence

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

JSON = OptionInfo(default=False, param_decls=("--json",), help="One JSON object on standard output, nothing else.")
Words = list[str] | None
FLAGS = {"observation_options": "option", "evaluation_interval": "interval", "hyperparameters": "set"}


class Commands(typer.Typer):
    """A Typer application or group whose commands are made from functions."""

    def command(  # type: ignore[override]
        self, name: str | None = None, **options: Any
    ) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
        register = super().command(name, **options)

        def decorator(function: Callable[..., Any]) -> Callable[..., Any]:
            register(command(function))
            return function

        return decorator


def command(function: Callable[..., Any]) -> Callable[..., None]:
    """Return the callback of a function for Typer: a parameter for each argument and option, `--json` the last."""
    parameters: list[inspect.Parameter] = []
    objects: dict[str, tuple[inspect.Parameter, Any, list[str]]] = {}
    texts, signature = docstring_entries(function), inspect.signature(function)
    for each in signature.parameters.values():
        cls, *names = get_args(each.annotation) if get_origin(each.annotation) is Annotated else (each.annotation,)
        if isinstance(cls, type) and dataclasses.is_dataclass(cls):
            group = [*_of_fields(cls, None if each.default is each.empty else each.default, texts)]
            group = [one for one in group if not names or one.name in names[0].split()]
            objects[each.name] = (each, cls, [one.name for one in group])
            parameters += group
        elif each.annotation is typer.Context:
            parameters.append(each)
        elif each.name != "json":
            default = ... if each.default is each.empty else each.default
            is_argument = each.kind is each.POSITIONAL_OR_KEYWORD
            parameters.append(_typed(each.name, each.annotation, default, texts.get(each.name), is_argument))

    words = [each.name for each in parameters if each.annotation == Words and each.default.metavar == "NAME=VALUE"]

    def run(*, json: bool, **values: Any) -> None:
        values |= {name: parse_parameters(values[name]) for name in words}
        for name, (parameter, cls, names) in objects.items():
            own = {each: values.pop(each) for each in names}
            empty = parameter.default is parameter.empty
            values[name] = cls(**own) if empty else dataclasses.replace(parameter.default, **own)
        if "json" in signature.parameters:
            values["json"] = json
        answer = function(**values)
        if isinstance(answer, Answer):
            answer.say(json)

    parameters.append(inspect.Parameter("json", inspect.Parameter.KEYWORD_ONLY, default=JSON, annotation=bool))
    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {}  # which Typer would read before the signature: a command may have an option `values`
    run.__doc__, run.__name__ = inspect.cleandoc(function.__doc__ or "").partition("\n\nArgs:")[0], function.__name__
    return run


def _of_fields(cls: "type[DataclassInstance]", values: object, docs: Mapping[str, str]) -> Iterator[inspect.Parameter]:
    """Yield a parameter for each field of a dataclass, and for the fields of nested dataclasses.

    Args:
        values: the defaults. docs: help texts that override the texts of the class.
    """
    texts, declared = docstring_entries(cls), declared_parameters(cls)
    for field in dataclasses.fields(cls):
        default = getattr(values, field.name) if values is not None else field.default
        if isinstance(field.type, type) and dataclasses.is_dataclass(field.type):
            yield from _of_fields(field.type, None if default is dataclasses.MISSING else default, docs)
        elif field.init:
            text = docs.get(field.name) or first_sentence(texts.get(field.name, ""))
            parameter = _typed(field.name, field.type, ... if default is dataclasses.MISSING else default, text)
            if (limits := declared.get(field.name)) is not None:
                parameter.default.min, parameter.default.max = limits.low, limits.high
            yield parameter


def _typed(name: str, hint: object, default: object, text: str | None, is_argument: bool = False) -> inspect.Parameter:
    """A parameter as Typer reads it. Flags, values and help in its annotation take precedence."""
    parts = get_args(hint) if get_origin(hint) in (UnionType, Union) else (hint,)
    notes = [note for part in parts for note in getattr(part, "__metadata__", ())]
    hint = functools.reduce(
        operator.or_, [get_args(each)[0] if get_origin(each) is Annotated else each for each in parts]
    )
    infos = [copy(note) for note in notes if isinstance(note, ParameterInfo)]
    info = infos[0] if infos else ArgumentInfo(default=...) if is_argument else OptionInfo(default=...)
    if isinstance(info, OptionInfo):
        flags: Any = (() if info.default is ... else (info.default,)) + tuple(info.param_decls or ())
        flag = FLAGS.get(name, name).replace("_", "-")
        info.param_decls = flags or (f"--{flag}/--no-{flag}" if default is True else f"--{flag}",)
    if any(get_origin(part) is Mapping for part in (hint, *get_args(hint))):
        hint, default, info.metavar = Words, None, "NAME=VALUE"
    for note in notes:
        if isinstance(note, str):
            info.metavar = note
    info.default, info.help = default, info.help or text
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=info, annotation=hint)
