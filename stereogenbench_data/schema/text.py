"""Text for messages, terminals and Markdown."""

from collections.abc import Sequence


def counted(count: int, noun: str) -> str:
    """Return a number with its noun.

    >>> counted(1, "shard"), counted(0, "shard")
    ('1 shard', '0 shards')
    """
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def shortened(text: str, most: int = 60) -> str:
    """Return a text of the data as a message holds it: its first letters, if it is long.

    >>> shortened("scene_000041"), shortened("x" * 99, 8)
    ('scene_000041', 'xxxxx...')
    """
    return text if len(text) <= most else f"{text[: most - 3]}..."


def markdown_text(text: str) -> str:
    r"""Return text from the data as Markdown that shows it literally, also in a table cell.

    No part of it becomes a tag, a link, a picture, code or the end of a cell.

    >>> print(markdown_text("<img src=x onerror=alert(1)>|[a](b)"))
    &lt;img src=x onerror=alert(1)&gt;\|[a]\(b)
    """
    escaped = text.replace("\\", "\\\\").replace("&", "&amp;")
    escaped = escaped.replace("<", "&lt;").replace(">", "&gt;")
    for mark, inert in (("|", r"\|"), ("`", r"\`"), ("](", r"]\(")):
        escaped = escaped.replace(mark, inert)
    return plain_line(escaped)


def plain_line(text: str) -> str:
    r"""Return text on one line, with control characters escaped, so that terminals ignore them.

    >>> print(plain_line("a" + chr(27) + "[31mb" + chr(10) + "c"))
    a\x1b[31mb\nc
    """
    return "".join(
        each if each.isprintable() else each.encode("unicode_escape").decode() for each in text
    )


def markdown_table(*rows: Sequence[str]) -> list[str]:
    """Return the lines of a Markdown table, the first row its head; empty cells become a dash.

    >>> markdown_table(("here", "paper"), ("7", ""))
    ['| here | paper |', '|---|---|', '| 7 | - |']
    """
    head, *body = (f"| {' | '.join(markdown_text(cell) or '-' for cell in row)} |" for row in rows)
    return [head, "|" + "---|" * len(rows[0]), *body]
