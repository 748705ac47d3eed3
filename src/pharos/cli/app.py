"""The application: its commands, and the conversion of errors to one line and an exit code."""

import errno
import os
import sys
import warnings
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from pharos.cli import (
    benchmark,
    build,
    cache,
    diagnose,
    evaluate,
    hardness,
    import_,
    observations,
    plot,
    render,
    study,
    train,
)
from pharos.cli import (
    list as list_,
)
from pharos.cli.answers import complain
from pharos.cli.command import Commands
from pharos.errors import DivergenceError, ParameterError, PharosError
from pharos.system.interrupts import EXIT_INTERRUPTED, INTERRUPTED, interrupts
from pharos.system.lazy import conflict

EXIT_FAILED, EXIT_USAGE = 1, 2
# Options and commands that went, by the command that had them, and what it says of them
AUDITS = "is gone: only final policies can be proven; `pharos benchmark verify FILE` computes them again"
REMOVED = {
    **{
        f"pharos {name}": f"{name} is gone: `pharos benchmark {name}` does it" for name in ("submit", "verify", "board")
    },
    **{f"pharos benchmark {name}": f"{name} {AUDITS}" for name in ("audit", "commit")},
    "pharos benchmark seal": "seal is gone: pharos.benchmark.write_suite makes a suite of your own, of any seeds",
    "pharos benchmark submit --commitment": f"--commitment {AUDITS}",
    "pharos build --shards": "--shards is gone: files stay in one folder, which a volume may spread over several disks",
    "pharos solve --jacobi": "--jacobi is gone: values of any --processes are within --tolerance, which may be lower",
}
# What NumPy says of an array that no machine can hold, by a ValueError
ADVICE = {
    errno.EEXIST: "expected a folder; choose another name",
    errno.ENOTDIR: "a part of the path is a file; choose another place",
    errno.EISDIR: "expected a file; choose another name",
    errno.EACCES: "choose another place",
    errno.EROFS: "choose another place",
    errno.ENOSPC: "free some, or choose another disk",
}
"""What to try, by the number of an error of the operating system."""
NO_ARRAY = ("array is too big", "Maximum allowed dimension exceeded")


class _Group(TyperGroup):
    """Runs a command. Errors that pharos or the system raise on purpose end as one line, never as a traceback."""

    def main(self, *args: Any, **options: Any) -> object:
        options["standalone_mode"] = False
        options["prog_name"] = "pharos"
        arguments = args[0] if args else options.pop("args", None)
        words = list(sys.argv[1:] if arguments is None else arguments)
        if words[:1] == ["help"]:
            words = [*words[1:], "--help"]
        try:
            code = self._exit_code_of(words, options)
            code = EXIT_INTERRUPTED if interrupts.finish() else code
        except KeyboardInterrupt:
            interrupts.finish()
            code = EXIT_INTERRUPTED
        if code == EXIT_INTERRUPTED and interrupts.report():
            complain(INTERRUPTED)
        sys.exit(code)

    def _exit_code_of(self, words: list[str], options: dict[str, Any]) -> int:
        try:
            if len(words) < 2 or not {"-h", "--help"}.isdisjoint(words):
                _hide_types_of_flags(self)
            code = super().main(words, **options)
            sys.stdout.flush()
            return code if isinstance(code, int) else 0
        except Exception as error:
            code = EXIT_INTERRUPTED if _comes_from_interrupt(error) else _exit_code(error, _command_of(self, words))
            if code is None:
                raise
            return code

    def invoke(self, ctx: Any) -> object:
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt as error:  # which some releases of Typer answer by an empty line
            raise typer.Exit(EXIT_INTERRUPTED) from error
        except EOFError as error:  # which would be taken for the keyboard's, and said to be an interruption
            kernels = Path(__file__).parents[1] / "kernels" / "__pycache__"
            raise PharosError(f"a file ended too early ({error}); if it is compiled code, delete {kernels}") from error


def _hide_types_of_flags(command: Any) -> None:
    """Help shows no <bool> beside options that take no value."""
    for option in command.get_params(typer.Context(command, help_option_names=["-h", "--help"])):
        if getattr(option, "is_flag", False):
            option.metavar = ""
    for each in getattr(command, "commands", {}).values():
        _hide_types_of_flags(each)


def _comes_from_interrupt(error: BaseException | None) -> bool:
    """Whether an error was raised while an interrupt was on its way out."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None


def _exit_code(error: Exception, command: str) -> int | None:
    """Print an error of a command as one line on standard error, return its exit code. None for a bug of pharos."""
    if isinstance(error, BrokenPipeError):  # the reader had enough, as in `pharos list | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_FAILED
    if isinstance(error, ParameterError | DivergenceError):
        complain(error)
        return EXIT_USAGE
    if isinstance(error, PharosError):
        complain(error)
        return EXIT_FAILED
    if isinstance(error, OSError):
        where = f"{error.filename}: " if error.filename is not None else ""
        advice = f"; {ADVICE[error.errno]}" if error.errno in ADVICE else ""
        complain(f"{where}{error.strerror or error}{advice}")
        return EXIT_FAILED
    if isinstance(error, MemoryError):
        complain(f"out of memory: {error or 'an array did not fit'}; choose a smaller instance, or set --memory")
        return EXIT_FAILED
    if isinstance(error, OverflowError) or str(error).startswith(NO_ARRAY):
        complain(f"a number is too large: {error}; choose a smaller instance")
        return EXIT_FAILED
    if type(error).__name__ == "Abort":
        return EXIT_INTERRUPTED
    if hasattr(error, "format_message"):  # of typer, in whichever module this version has its exceptions
        text = error.format_message()
        name = getattr(error, "option_name", None) or "".join(text.split("'")[1:2])  # No such command 'NAME'.
        complain(f"{REMOVED.get(f'{command} {name}') or text} (see `{command} --help`)")
        return EXIT_USAGE
    return None


def _command_of(group: object, words: list[str]) -> str:
    """The command that words begin with: "pharos study run". Not all errors know theirs."""
    path = ["pharos"]
    for word in words:
        if (group := getattr(group, "commands", {}).get(word)) is None:
            break
        path.append(word)
    return " ".join(path)


app = Commands(
    name="pharos",
    cls=_Group,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Principled reinforcement-learning benchmarking: exact state spaces, values, hardness and regret.",
    epilog="TARGET is an environment (`pharos list`) with name=value parameters, module:Class for your own, "
    "a built folder, or an imported file.",
)


@app.callback(invoke_without_command=True)
def _options(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version and exit.", is_eager=True)] = False,
) -> None:
    if version:
        from pharos import __version__

        print(f"pharos {__version__}")
        raise typer.Exit()
    if context.invoked_subcommand is None:
        print(context.get_help())
        raise typer.Exit()


app.command("list")(list_.list_)
app.command("build")(build.build)
app.command("count")(build.count)
app.command("check")(build.check)
app.command("solve")(evaluate.solve)
app.command("hardness")(hardness.hardness)
app.command("predict")(hardness.predict)
app.command("evaluate")(evaluate.evaluate)
app.command("observations")(observations.observations)
app.command("render")(render.render)
app.command("play")(render.play)
app.command("explore")(plot.explore)
app.command("train")(train.train)
app.command("tune")(train.tune)
app.command("warm")(cache.warm)
app.add_typer(plot.app, name="plot")
app.add_typer(study.app, name="study")
app.add_typer(benchmark.app, name="benchmark")
app.command("diagnose")(diagnose.diagnose)
app.command("export")(import_.export)
app.add_typer(import_.app, name="import")
app.add_typer(cache.app, name="cache")


def main() -> None:
    """Entry point of the `pharos` command."""
    try:
        _main()
    except KeyboardInterrupt:  # before the command has begun, or a second one
        interrupts.finish()
        if interrupts.report():
            complain(INTERRUPTED)
        sys.exit(EXIT_INTERRUPTED)


def _main() -> None:
    interrupts.begin()
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):  # closed by whoever started it
        if getattr(sys, name) is None:
            stream = open(os.devnull, mode, errors="replace")  # noqa: SIM115
            os.set_inheritable(stream.fileno(), True)  # else processes that start have it closed again
            setattr(sys, name, stream)
    if getattr(sys.stdout, "errors", "") == "strict" and hasattr(sys.stdout, "reconfigure"):
        sys.stdout.reconfigure(errors="backslashreplace")  # names of files need not be UTF-8
    warnings.showwarning = lambda message, *_, **__: complain(f"warning: {message}")
    if not hasattr(sys.modules["pharos"], "make") and (wrong := conflict()):  # the __init__.py is the other project's
        complain(wrong)
        sys.exit(EXIT_FAILED)
    app()
