"""Tables of every command, its options and the keys of its JSON, from the application and docs/json-keys.yaml.

scripts/build_site.py puts them into the page of the command line.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml
from typer.main import get_command

from pharos.cli import app

KEYS = Path(__file__).parents[1] / "docs" / "json-keys.yaml"
MARK = "<!-- The site has tables of all commands here: scripts/cli_page.py. -->"


def commands(group: Any = None, words: tuple[str, ...] = ()) -> Iterator[tuple[str, Any]]:
    """(words, command), of every verb in the order of the application."""
    group = get_command(app) if group is None else group
    if not hasattr(group, "commands"):
        yield " ".join(words), group
        return
    for name, command in group.commands.items():
        yield from commands(command, (*words, name))


def keys() -> tuple[dict[str, list[str]], dict[str, str]]:
    """Keys of each command's JSON, those that some answers lack with *; and what each key means."""
    declared = yaml.safe_load(KEYS.read_text(encoding="utf-8"))
    return declared["commands"], declared["meanings"]


def tables() -> str:
    """A section for each command."""
    lines, (keys_of, meaning) = [], keys()
    for name, command in commands():
        arguments = [each for each in command.params if each.param_type_name == "argument"]
        options = [each for each in command.params if each.param_type_name == "option" and not each.hidden]
        usage = " ".join([f"pharos {name}", *map(_value, arguments)])
        lines += [f"### {name}", "", f"`{usage}`", "", " ".join((command.help or "").split()), ""]
        lines += ["| option | meaning |", "|---|---|", *(f"| {_names(each)} | {_meaning(each)} |" for each in options)]
        lines += ["", "| key of `--json` | meaning |", "|---|---|"]
        for key in keys_of[name]:
            sometimes = ", *in some answers*" if key.endswith("*") else ""
            lines.append(f"| `{key.rstrip('*')}` | {meaning[key.rstrip('*')]}{sometimes} |")
        lines.append("")
    return "\n".join(lines)


def _value(parameter: Any) -> str:
    """What stands for the value of an argument or option."""
    name = parameter.metavar or parameter.name.upper()
    plain = parameter.required or parameter.param_type_name == "option" or name.startswith("[")
    return name if plain else f"[{name}]"


def _names(option: Any) -> str:
    """`--out FILE`, or both of `--browser / --no-browser`."""
    if option.is_flag:
        return " / ".join(f"`{name}`" for name in (*option.opts, *option.secondary_opts))
    return f"`{option.opts[0]}` {cell(_value(option))}"


def _meaning(option: Any) -> str:
    """The help of an option, and its default where it has one."""
    default = option.default
    shown = not (default is None or option.is_flag or callable(default) or option.multiple)
    return cell(f"{option.help or ''}{f' Default: `{default}`.' if shown else ''}")


def cell(text: str) -> str:
    """Text for a cell of a table."""
    return text.replace("|", r"\|").replace("\n", " ").replace("<", "&lt;").replace("*", r"\*")
