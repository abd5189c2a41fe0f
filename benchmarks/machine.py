"""On what it was measured: processor, system, versions."""

import os
import platform
import re
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Final

import av

_PACKAGES: Final = (
    "stereogenbench-data", "av", "numpy", "torch", "pyarrow", "webdataset", "datasets",
    "torchcodec", "decord", "blosc2",
)  # fmt: skip


def machine() -> dict[str, Any]:
    """Return what results depend on beside the code."""
    model = re.search(r"model name\s*: (.*)", _read("/proc/cpuinfo"))
    memory = re.search(r"MemTotal:\s*(\d+)", _read("/proc/meminfo"))
    return {
        "when": datetime.now(UTC).isoformat(timespec="seconds"),
        "cpu": model[1] if model else platform.processor(),
        "cores": os.cpu_count(),
        "memory_gb": round(int(memory[1]) / 1e6, 1) if memory else None,
        "system": platform.platform(),
        "python": platform.python_version(),
        "ffmpeg of PyAV": av.ffmpeg_version_info,
        "load before": os.getloadavg()[0],
        "versions": {name: _version(name) for name in _PACKAGES},
    }


def _read(path: str) -> str:
    return Path(path).read_text() if Path(path).exists() else ""


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None
