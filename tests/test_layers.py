"""The package's structure: imports go one way, torch comes late, names are documented."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import stereogenbench_data
from tests.servers.tools import run_python

PACKAGE = Path(stereogenbench_data.__file__).parent
LAYERS = (
    "errors", "schema", "geometry", "media", "engine", "sources", "jobs", "index", "shards",
    "selection", "samples", "datasets", "bridges", "audit", "evaluation", "synthesis", "cli",
    "__main__",
)  # fmt: skip
ENTRANCES = (Path("__init__.py"), Path("__main__.py"))
"""Modules above the layers: the public names, and the command."""
MODULES = sorted(path.relative_to(PACKAGE) for path in PACKAGE.rglob("*.py"))


def _layer(path: Path) -> str:
    return path.parts[0].removesuffix(".py")


def _imported(path: Path) -> list[str]:
    """Return the package's own modules that a file imports anywhere, also inside functions."""
    names: list[str] = []
    for node in ast.walk(ast.parse((PACKAGE / path).read_text())):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            names.append(str(node.module))
            names += [f"{node.module}.{alias.name}" for alias in node.names]
    return [name for name in names if name.startswith("stereogenbench_data.")]


@pytest.mark.parametrize("module", [path for path in MODULES if path not in ENTRANCES], ids=str)
def test_a_module_imports_from_its_own_layer_or_one_to_the_left(module):
    own = LAYERS.index(_layer(module))

    to_the_right = [name for name in _imported(module) if LAYERS.index(name.split(".")[1]) > own]

    assert to_the_right == []


def test_the_imports_have_no_cycle():
    modules = {
        ".".join(("stereogenbench_data", *path.with_suffix("").parts)): path for path in MODULES
    }
    waiting = {
        name: {imported for imported in _imported(path) if imported in modules and imported != name}
        for name, path in modules.items()
        if path not in ENTRANCES
    }
    while waiting:
        free = {name for name, needs in waiting.items() if not needs & waiting.keys()}
        assert free, f"a cycle among {sorted(waiting)}"
        waiting = {name: needs for name, needs in waiting.items() if name not in free}


def test_modules_that_do_not_need_torch_start_without_it():
    modules = (
        "stereogenbench_data", "stereogenbench_data.schema.parse",
        "stereogenbench_data.geometry.camera", "stereogenbench_data.geometry.projection",
        "stereogenbench_data.media.depth", "stereogenbench_data.index.table",
        "stereogenbench_data.selection.plan", "stereogenbench_data.cli.commands",
    )  # fmt: skip
    code = (
        "import sys, importlib\n"
        "for name in sys.argv[1:]:\n"
        "    importlib.import_module(name)\n"
        "    if 'torch' in sys.modules: sys.exit(f'{name} imports torch')"
    )
    ended = subprocess.run([sys.executable, "-c", code, *modules], check=False, capture_output=True)

    assert (ended.returncode, ended.stderr.decode()) == (0, "")


def test_what_no_first_sample_needs_is_not_imported_with_the_package():
    unneeded = {
        "pyarrow.compute", "pyarrow.dataset", "pyarrow.fs", "pyarrow.parquet", "urllib3", "fsspec",
        "huggingface_hub", "pandas", "PIL", "rich", "typer", "blosc2",
        "stereogenbench_data.index.build", "stereogenbench_data.sources.web",
    }  # fmt: skip
    code = "import sys; from stereogenbench_data import StereoPairs; print(*sys.modules)"

    assert unneeded.isdisjoint(run_python("-c", code).split())


def test_every_public_name_can_be_imported_and_has_a_docstring():
    for name in stereogenbench_data.__all__:
        public = getattr(stereogenbench_data, name)

        assert isinstance(public, dict) or len(public.__doc__ or "") > 30, name


def test_an_unknown_public_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'StereoPair'"):
        stereogenbench_data.StereoPair  # noqa: B018
