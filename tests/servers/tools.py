"""What tests of servers need: skipped with a reason at home, never in CI."""

import importlib
import os
import shutil
from types import ModuleType

import pytest


def require_tool(name: str) -> str:
    """Return the path of a program; without it skip, or fail where CI is set."""
    path = shutil.which(name) or shutil.which(name, path="/usr/sbin:/usr/local/sbin")
    if path is None:
        _missing(f"needs the program {name}")
    return str(path)


def require_module(name: str) -> ModuleType:
    """Return a module; without it skip, or fail where CI is set."""
    try:
        return importlib.import_module(name)
    except ImportError:
        _missing(f"needs the Python module {name}")
        raise


def _missing(reason: str) -> None:
    if os.environ.get("CI"):
        pytest.fail(f"{reason}: install it, CI may not skip this")
    pytest.skip(f"{reason}, which is not installed")
