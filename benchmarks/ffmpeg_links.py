"""FFmpeg for torchcodec: PyAV's own libraries, under the names by which torchcodec looks for them.

torchcodec comes without FFmpeg. PyAV's wheel has it under other names. A folder of links on
``LD_LIBRARY_PATH`` lets both decode with the same build.
"""

import re
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path


def link_libraries(folder: Path) -> Path | None:
    """Make the folder of links; return it, or None if PyAV's wheel has no libraries."""
    try:
        site = Path(str(distribution("av").locate_file("")))
    except PackageNotFoundError:
        return None
    libraries = sorted((site / "av.libs").glob("*.so*"))
    if not libraries:
        return None
    folder.mkdir(parents=True, exist_ok=True)
    for library in libraries:
        found = re.fullmatch(r"(lib\w+)-[0-9a-f]+(\.so\.\d+)[\d.]*", library.name)
        for name in {library.name, found[1] + found[2] if found else library.name}:
            link = folder / name
            if link.is_symlink() or link.exists():
                link.unlink()
            link.symlink_to(library.resolve())
    return folder
