"""Scenes that are left out: how many may be, and how they are told."""

import re
from collections.abc import Mapping
from typing import Final

from stereogenbench_data.schema.text import counted, shortened

MOST_LEFT_OUT: Final = 0.05
"""The largest share of scenes that may be left out; one always may."""
_LONGEST_REASON: Final = 5000
_SHOWN: Final = 10


def are_few(left_out: int, *, of: int) -> bool:
    """Return whether so many scenes may be left out."""
    return left_out <= max(1, of * MOST_LEFT_OUT)


def by_reason(reasons: Mapping[str, str]) -> list[list[str]]:
    """Return the keys of scenes, sorted, those together whose reasons differ by figures alone."""
    groups: dict[str, list[str]] = {}
    for key, reason in sorted(reasons.items()):
        kind = re.sub(r"[0-9.]+", "#", reason.replace(key, ""))
        groups.setdefault(kind, []).append(key)
    return list(groups.values())


def reasons_told(reasons: Mapping[str, str]) -> str:
    """Return the reasons for which scenes are left out, each once, with the first scene of it.

    Args:
        reasons: The key of each scene to its reason.
    """
    groups, lines = by_reason(reasons), []
    for keys in groups[:_SHOWN]:
        reason = reasons[keys[0]]
        told = reason if keys[0] in reason else f"{keys[0]}: {reason}"
        more = f" ({counted(len(keys) - 1, 'other scene')} likewise)" if len(keys) > 1 else ""
        lines.append(f"{shortened(told, _LONGEST_REASON).rstrip('.')}{more}")
    if len(groups) > _SHOWN:
        lines.append(f"and {len(groups) - _SHOWN} other reasons")
    return "\n  ".join(lines)


def listed(left_out: Mapping[str, str]) -> str:
    """Return how many scenes are left out, and why, with the first of each reason."""
    return f"{counted(len(left_out), 'scene')} cannot be used:\n  {reasons_told(left_out)}"
