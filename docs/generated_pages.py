"""What the documentation says of the code by the code itself: the commands, the tables of fields.

The page of commands is made when the site is built. The tables of fields stand in ``samples.md``,
for those who read the file; ``python docs/generated_pages.py`` writes them anew.
"""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import typer
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

from stereogenbench_data.cli.commands import app
from stereogenbench_data.samples.fields import PAIR_FIELDS, VIEW_FIELDS, Field

_TABLES: Mapping[str, Mapping[str, Field]] = {"pairs": PAIR_FIELDS, "views": VIEW_FIELDS}


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the page of commands."""
    files.append(File.generated(config, "commands.md", content=commands_page()))
    return files


def with_fields_tables(markdown: str) -> str:
    """Return a page with each table of fields, between its comments, as the code has it."""
    return re.sub(
        r"(<!-- table of fields: (\w+) -->\n).*?(?=<!-- end of table -->)",
        lambda found: f"{found[1]}\n{fields_table(found[2])}\n\n",
        markdown,
        flags=re.DOTALL,
    )


def fields_table(name: str) -> str:
    """Return the Markdown table of the fields of "pairs" or "views"."""
    rows = [
        f"| `{field}` | {f'{about.dtype} {about.shape}'.strip()} | {about.meaning} |"
        for field, about in _TABLES[name].items()
    ]
    return "\n".join(["| field | type | meaning |", "|---|---|---|", *rows])


def commands_page() -> str:
    """Return the reference of all commands, as the program itself describes them."""
    group: Any = typer.main.get_command(app)
    parts = ["# Commands", "", _plain(group.help or "")]
    if group.epilog:
        parts += ["", _plain(group.epilog)]
    for name, command in group.commands.items():
        parts += _described(name, command, level=2)
        for inner, each in getattr(command, "commands", {}).items():
            parts += _described(f"{name} {inner}", each, level=3)
    return "\n".join(parts) + "\n"


def _described(name: str, command: Any, *, level: int) -> list[str]:
    parts = ["", f"{'#' * level} stereogenbench {name}", "", _plain(command.help or "")]
    if command.epilog:
        parts += ["", _plain(command.epilog)]
    return parts if hasattr(command, "commands") else [*parts, "", *_parameters(command)]


def _parameters(command: Any) -> list[str]:
    rows = ["| parameter | meaning | default |", "|---|---|---|"]
    for parameter in command.params:
        if parameter.name == "help":
            continue
        names = ", ".join(f"`{option}`" for option in parameter.opts)
        if parameter.param_type_name == "argument":
            names = f"`{parameter.name.upper()}`"
        default = parameter.default
        is_shown = default is not False and default not in (None, (), "")
        shown = f"`{default}`" if is_shown and not callable(default) else ""
        if parameter.required:
            shown = "required"
        rows.append(f"| {names} | {_cell(getattr(parameter, 'help', '') or '')} | {shown} |")
    return rows


def _plain(text: str) -> str:
    return text.replace("\b\n", "").strip()


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")


if __name__ == "__main__":
    page = Path(__file__).with_name("samples.md")
    page.write_text(with_fields_tables(page.read_text()))
