"""What tests need of the system, and folders that all processes of a run share."""

import importlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from filelock import FileLock

CHECKOUT = Path(__file__).resolve().parents[2]
Once = Callable[[str, Callable[[Path], object]], Path]
"""What makes a folder of a name, of the fixture `once`."""


def made_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], object]) -> Path:
    """Return a folder that one process of the run fills and the others read; none may change it."""
    base = factory.getbasetemp()
    base = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    folder, finished = base / name, base / f"{name}.finished"
    with FileLock(base / f"{name}.lock"):
        if not finished.exists():
            shutil.rmtree(folder, ignore_errors=True)
            make(folder)
            finished.touch()
    return folder


def files_of(root: Path) -> dict[str, bytes]:
    """Return the content of every file below a folder but locks, by relative path."""
    return {
        str(path.relative_to(root)): path.read_bytes()
        for path in sorted(root.rglob("*"))
        if path.is_file() and path.suffix != ".lock"
    }


def rewrite_json(path: Path, change: Callable[[Any], object]) -> Any:
    """Let a function change the document of a JSON file in place; return the document."""
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))
    return document


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


@contextmanager
def chromium(*flags: str) -> Iterator[Any]:
    """Open a Chromium without a window; where it is missing skip, or fail where CI is set."""
    webdriver = require_module("selenium.webdriver")
    options = webdriver.ChromeOptions()
    options.binary_location = require_tool("chromium")
    for flag in ("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", *flags):
        options.add_argument(flag)
    services = require_module("selenium.webdriver.chrome.service")
    service = services.Service(executable_path=require_tool("chromedriver"))
    with webdriver.Chrome(options=options, service=service) as driver:
        yield driver


def open_files() -> list[str]:
    """Return what this process has open, as Linux tells; elsewhere skip."""
    folder, links = Path("/proc/self/fd"), []
    if not folder.is_dir():
        pytest.skip("needs /proc")
    for each in folder.iterdir():
        with suppress(OSError):
            links.append(str(each.readlink()))
    return links


def wait_until(condition: Callable[[], object]) -> None:
    """Wait until a condition holds; fail where that takes a minute."""
    deadline_s = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < deadline_s, "it did not come about within a minute"
        time.sleep(0.01)


def run_python(*words: object, **variables: str) -> str:
    """Return what Python prints, in the checkout, with more variables of the environment.

    Fail where it fails, or hangs: five minutes are many times what tests ask for.
    """
    done = subprocess.run(
        [sys.executable, *map(str, words)], env=os.environ | variables, cwd=CHECKOUT,
        capture_output=True, text=True, check=False, timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


def planned_by_make(target: str) -> str:
    """Return the commands that make runs for a target, once the environment is there."""
    command = [require_tool("make"), "--dry-run", "--old-file", ".venv/.ready", target]
    done = subprocess.run(command, cwd=CHECKOUT, capture_output=True, text=True, check=True)
    return done.stdout


def fork_and(act: Callable[[], object]) -> int:
    """Run a function in a fork of this process, which then ends; return its exit status."""
    child = os.fork()
    if child == 0:
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.alarm(60)  # ends a fork that hangs
        status = 1
        try:
            act()
            status = 0
        finally:
            os._exit(status)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def killed_fork(act: Callable[[], object]) -> bool:
    """Run a function in a fork of this process; return whether it was killed while it ran."""
    return fork_and(act) == -signal.SIGKILL


def kill_at(most: int) -> Callable[[int, int], None]:
    """Return a progress function that kills its process once so much is done."""

    def progress(done: int, total: int) -> None:
        if done >= most:
            os.kill(os.getpid(), signal.SIGKILL)

    return progress


@contextmanager
def small_disk(place: Path, *, size: str) -> Iterator[Path]:
    """Mount a disk of so many bytes ("600k") at a folder; where that fails, skip, or fail in CI."""
    place.mkdir(exist_ok=True)
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", place],
        check=False, capture_output=True, text=True,
    )  # fmt: skip
    if mounted.returncode:
        reason = f"a small disk cannot be mounted: {mounted.stderr.strip()}"
        pytest.fail(reason) if os.environ.get("CI") else pytest.skip(reason)
    try:
        yield place
    finally:
        subprocess.run(["umount", place], check=True)


def _missing(reason: str) -> None:
    if os.environ.get("CI"):
        pytest.fail(f"{reason}: install it, CI may not skip this")
    pytest.skip(f"{reason}, which is not installed")
