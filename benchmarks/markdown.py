"""Tables and spreads in Markdown."""

from collections.abc import Iterable

from benchmarks.results import Spread

Rows = list[list[str]]


def table(head: Iterable[str], rows: Rows) -> str:
    """Return a table, numbers to the right."""
    titles = list(head)
    lines = [titles, ["---"] + ["---:"] * (len(titles) - 1), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def spread_text(spread: Spread | None, form: str = ".2f") -> str:
    """Return median (low to high quartile)."""
    if spread is None:
        return ""
    return f"{spread.median:{form}} ({spread.low:{form}} to {spread.high:{form}})"


def rate_text(spread: Spread | None) -> str:
    """Return the median alone."""
    return "" if spread is None else f"{spread.median:.3g}"


def verdict(spread: Spread | None, wanted: float | None) -> str:
    """Return the ratio wanted, and whether it is reached."""
    if spread is None or wanted is None:
        return ""
    return f"{wanted:g} {'reached' if spread.median >= wanted else '**missed**'}"
