"""The help pages of the commands: two columns without frames, made for 80 columns.

`HelpedCommand` and `HelpedGroup` replace the pages of typer, which give a flag the type ``<bool>``,
cut the names of long options and put a few words on a line. The names of values come from the
annotations: an option that takes a number with a unit in its name shows the unit, a range shows
``MIN MAX``, a choice shows its values.
"""

import inspect
import re
import textwrap
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Final, Literal, Union, get_args, get_origin

from rich.console import Console
from rich.text import Text
from typer import BadParameter
from typer.core import TyperCommand, TyperGroup

SCENES: Final = "Which scenes"
"""Panel of the options that select scenes, pairs and frames."""
RARE: Final = "Rarely needed"
"""Panel of the options that most users never need; the last one."""

_WIDEST: Final = 100
"""Columns of the widest page."""
_NAMES: Final = 25
"""Columns of the names, at most; the help of a longer name starts on the next line."""
_LONGEST_CHOICE: Final = 24
"""Characters of the longest list of choices that stands beside the option's name."""
_OF_COMPLETION: Final = ("install_completion", "show_completion")
"""Options that typer adds; the page of all commands names them below its tables."""
_MARKED: Final = re.compile(
    r"`(?P<code>[^`]+)`|(?<![\w-])(?P<option>--?[a-z][\w-]*)|(?P<heading>^[A-Z][A-Za-z ]*:$)", re.M
)
_STYLES: Final = {"code": "cyan", "option": "cyan", "heading": "bold"}


class HelpedCommand(TyperCommand):
    """A command with a help page of this module; its values have names."""

    def __init__(self, name: str | None, **settings: Any) -> None:
        """Name the values of the options."""
        super().__init__(name, **settings)
        _name_values(self.params, self.callback)

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Read what was typed; an error quotes it, whatever library checked it for typer."""
        try:
            return super().parse_args(ctx, args)
        except BadParameter as error:
            error.message = _quoting_typed(error)
            raise

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """Return the arguments and the options that must be given, then ``[OPTIONS]``."""
        return [*_required(self.get_params(ctx)), "[OPTIONS]"]

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Print the page."""
        _print_page(self, ctx)


class HelpedGroup(TyperGroup):
    """A group of commands with a help page of this module."""

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Print the page."""
        commands = [self.get_command(ctx, name) for name in self.list_commands(ctx)]
        shown: Any = [each for each in commands if each is not None and not each.hidden]
        panels = _by_panel(shown, default="Commands")
        rows = {
            title: [(each.name, _first_paragraph(each.help)) for each in panel]
            for title, panel in panels.items()
        }
        _print_page(self, ctx, commands=rows)


def _quoting_typed(error: BadParameter) -> str:
    """Return the message of an error; newer typer has values checked by pydantic."""
    found: list[Any] = getattr(error.__cause__, "errors", list)()
    kind = {"int_parsing": "integer", "float_parsing": "number"}.get(
        found[0]["type"] if found else ""
    )
    if kind:
        return f"{found[0]['input']!r} is not a valid {kind}."
    return error.message.removeprefix("Value error, ").replace("%Y-%m-%d", "YYYY-MM-DD")


def _name_values(params: Iterable[Any], callback: Callable[..., Any] | None) -> None:
    """Set the name of the value of each option and argument that has none, from its annotation."""
    known = {} if callback is None else inspect.signature(callback).parameters
    for param in params:
        if param.metavar is not None or param.name not in known:
            continue
        if param.param_type_name == "argument":
            param.metavar = param.name.upper()
        else:
            annotation = known[param.name].annotation
            param.metavar = _value_name(param.name, annotation)
            if get_origin(_bare_type(annotation)) is Literal and "|" not in str(param.metavar):
                param.help += f" One of {', '.join(get_args(_bare_type(annotation)))}."


def _value_name(name: str, annotation: Any) -> str | None:
    """Return the name of the value of an option; None for a flag.

    >>> _value_name("focal_mm", tuple[float, float] | None)
    'MIN MAX'
    >>> _value_name("keypoint_matcher", str)
    'MATCHER'
    """
    kind = _bare_type(annotation)
    if kind is bool:
        return None
    if get_origin(kind) is tuple:
        return "MIN MAX"
    if get_origin(kind) is Literal:
        choice = "|".join(map(str, get_args(kind)))
        if len(choice) <= _LONGEST_CHOICE:
            return choice
    if kind is int:
        return "N"
    if kind is Path:
        return "FILE"
    return name.rpartition("_")[2].upper()


def _bare_type(annotation: Any) -> Any:
    """Return the type of one value, without `Annotated`, None and list."""
    origin, parts = get_origin(annotation), get_args(annotation)
    if origin is Annotated or origin is list:
        return _bare_type(parts[0])
    if origin in (UnionType, Union):
        (kind,) = (part for part in parts if part is not NoneType)
        return _bare_type(kind)
    return annotation


def _required(params: Iterable[Any]) -> list[str]:
    words = []
    for param in params:
        if param.param_type_name == "argument":
            words.append(param.metavar if param.required else f"[{param.metavar}]")
        elif param.required:
            words.append(f"{param.opts[0]} {param.metavar}")
    return words


def _by_panel(items: Iterable[Any], *, default: str) -> dict[str, list[Any]]:
    """Return the items by their panels: the default one first, that of rare options last."""
    panels: dict[str, list[Any]] = {default: []}
    for item in items:
        panels.setdefault(getattr(item, "rich_help_panel", None) or default, []).append(item)
    if RARE in panels:
        panels[RARE] = panels.pop(RARE)
    return {title: panel for title, panel in panels.items() if panel}


def _print_page(
    command: Any, ctx: Any, *, commands: Mapping[str, list[tuple[str, str]]] | None = None
) -> None:
    console = Console(highlight=False)
    width = min(console.width, _WIDEST)
    params = [each for each in command.get_params(ctx) if not getattr(each, "hidden", False)]
    params = [each for each in params if each.name not in _OF_COMPLETION]
    arguments = [each for each in params if each.param_type_name == "argument"]
    panels = _by_panel((each for each in params if each not in arguments), default="Options")
    blocks = [_wrapped(f"Usage: {_usage(command, ctx)}", width, indent=7)]
    blocks += _paragraphs(command.help or "", width)
    blocks += _table(commands or {}, width)
    tables = {"Arguments": arguments} if arguments else {}
    described = {
        title: [(_names(each), _described(each)) for each in panel]
        for title, panel in (tables | panels).items()
    }
    blocks += _table(described, width)
    blocks += _paragraphs(command.epilog or "", width)
    page = Text("\n\n".join(blocks))
    console.print(_styled(page), soft_wrap=True)


def _usage(command: Any, ctx: Any) -> str:
    return " ".join([ctx.command_path, *command.collect_usage_pieces(ctx)])


def _names(param: Any) -> str:
    """Return ``-o, --out FILE`` for an option, ``DATA`` for an argument."""
    if param.param_type_name == "argument":
        return str(param.metavar)
    names = ", ".join(sorted(param.opts, key=lambda name: name.startswith("--")))
    value = "" if getattr(param, "is_flag", False) or not param.metavar else f" {param.metavar}"
    return "/".join([names, *param.secondary_opts]) + value


def _described(param: Any) -> str:
    """Return the help of an option with its default."""
    text = param.help or ""
    default = param.default
    is_plain = isinstance(default, str | int | float) and not isinstance(default, bool)
    if param.required and param.param_type_name != "argument":
        return f"{text} Required."
    if param.secondary_opts:
        return f"{text} [{(param.opts if default else param.secondary_opts)[0]}]"
    if not is_plain or str(default) in ("", str(param.name)):
        return text
    return f"{text} [{default}]"


def _first_paragraph(text: str | None) -> str:
    return " ".join(inspect.cleandoc(text or "").partition("\n\n")[0].split())


def _paragraphs(text: str, width: int) -> list[str]:
    """Return the paragraphs of a text, wrapped; indented ones stay as they are."""
    blocks = inspect.cleandoc(text).split("\n\n")
    return [block if block.startswith(" ") else _wrapped(block, width) for block in blocks if block]


def _wrapped(text: str, width: int, *, indent: int = 0) -> str:
    return textwrap.fill(
        " ".join(text.split()), width, subsequent_indent=" " * indent,
        break_long_words=False, break_on_hyphens=False,
    )  # fmt: skip


def _table(panels: Mapping[str, list[tuple[str, str]]], width: int) -> list[str]:
    """Return a block for each panel: its title, then two columns, as wide in all panels."""
    longest = (len(name) for rows in panels.values() for name, _ in rows if len(name) <= _NAMES)
    names = max(longest, default=0)
    blocks = []
    for title, rows in panels.items():
        lines = [f"{title}:"]
        for name, text in rows:
            helped = textwrap.wrap(
                " ".join(text.split()), width - names - 4, break_on_hyphens=False
            ) or [""]
            first = helped.pop(0) if len(name) <= names else ""
            lines.append(f"  {name:<{names}}  {first}".rstrip())
            lines += [" " * (names + 4) + each for each in helped]
        blocks.append("\n".join(lines))
    return blocks


def _styled(page: Text) -> Text:
    """Return the page with colours for code, options and headings, without back quotes."""
    plain = page.plain
    styled, end = Text(), 0
    for found in _MARKED.finditer(plain):
        kind = found.lastgroup or ""
        styled.append(plain[end : found.start()])
        styled.append(found[kind], _STYLES[kind])
        end = found.end()
    return styled.append(plain[end:])
