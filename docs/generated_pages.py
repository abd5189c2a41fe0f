"""Make the folder that the site is built from: `docs/`, and what the code says of itself.

python docs/generated_pages.py            # writes build/docs, before `mkdocs build`
python docs/generated_pages.py tables     # the tables of fields in docs/samples.md, from the code
python docs/generated_pages.py notebook   # runs examples/tutorial.ipynb and keeps what it shows
"""

import base64
import importlib
import json
import re
import shutil
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import typer

import stereogenbench_data
from stereogenbench_data.cli.commands import app
from stereogenbench_data.samples.fields import PAIR_FIELDS, VIEW_FIELDS, Field

HOME = Path(__file__).resolve().parents[1]
NOTEBOOK = HOME / "examples" / "tutorial.ipynb"

_TABLES: Mapping[str, Mapping[str, Field]] = {"pairs": PAIR_FIELDS, "views": VIEW_FIELDS}
_PACKAGE = "stereogenbench_data"

REFERENCE: Mapping[str, tuple[str, Mapping[str, Sequence[str]]]] = {
    "datasets": (
        "Datasets and loaders",
        {
            "datasets.mapped": ("StereoPairs", "SceneViews", "PairsOptions", "ReadOptions"),
            "datasets.loader": ("PairsLoader", "LoaderOptions", "LoaderStats"),
            "datasets.epoch_rule": ("EpochOptions",),
            "datasets.batches": ("EpochBatches",),
            "datasets.streamed": ("StereoPairStream",),
            "datasets.batch_buffers": ("collate", "to_device"),
            "datasets.derive": ("derive", "DERIVE_FIELDS", "DERIVED_FIELDS"),
            "datasets.forecast": ("forecast", "Forecast", "Scale"),
        },
    ),
    "selection": (
        "Choosing scenes and pairs",
        {
            "selection.filters": ("SceneFilters",),
            "selection.plan": ("PairOptions", "parse_frames"),
            "index.table": ("SceneIndex",),
        },
    ),
    "samples": (
        "Fields, transforms and pictures",
        {
            "samples.fields": ("Field", "PAIR_FIELDS", "VIEW_FIELDS"),
            "samples.transforms": (
                "Compose", "Resize", "Letterbox", "Crop", "RandomCrop", "RandomScale",
                "HorizontalFlip", "ColorJitter", "Eraser",
            ),
            "bridges.picture": ("show",),
            "bridges.matching": ("to_raft_stereo", "to_torchvision"),
        },
    ),
    "files": (
        "Files, conventions and depth",
        {
            "schema.records": ("DepthEncoding",),
            "schema.conventions": ("Conventions",),
            "sources.cache": ("ShardCache",),
            "sources.retry": ("RetryPolicy",),
            "shards.download": ("download",),
        },
    ),
    "geometry": (
        "Geometry",
        {
            "geometry.disparity": (
                "disparity_from_depth", "disparity_from_shifts", "disparity_error_px",
                "planar_from_ray", "ray_per_planar",
            ),
            "geometry.projection": (
                "Projection", "project_rectified", "homography", "project_by_homography",
                "visible_in_target", "visible_from_source", "splat", "backward_warp",
            ),
            "geometry.camera": ("Intrinsics",),
            "geometry.pose": ("CameraPoses",),
        },
    ),
    "checking": (
        "Checking data",
        {
            "audit.geometry.audit": ("audit", "AuditOptions"),
            "audit.contract.doctor": ("diagnose", "DoctorReport"),
            "audit.statistics": ("statistics", "Statistics"),
            "shards.verify": ("verify", "VerifyReport"),
        },
    ),
    "evaluation": (
        "Evaluation",
        {
            "evaluation.evaluate": ("evaluate", "EvaluationOptions"),
            "evaluation.disparity": ("evaluate_disparity", "disparity_tables"),
            "evaluation.metrics.disparity": ("DisparityError",),
            "evaluation.protocol": ("EvaluationProtocol", "DisparityProtocol"),
            "evaluation.inputs": ("export_inputs",),
            "evaluation.controls": ("score_controls",),
            "evaluation.tables": ("Scores", "tables_of"),
            "evaluation.report": ("write_report", "page", "markdown"),
        },
    ),
    "packing": (
        "Shards and batch work",
        {
            "shards.pack": ("pack", "PackReport"),
            "shards.training": ("TrainingSettings",),
            "shards.unpack": ("unpack", "UnpackReport"),
            "jobs": ("WorkOptions",),
            "engine": ("ProcessPool", "RayCluster"),
        },
    ),
    "synthesis": (
        "Generating scenes",
        {
            "synthesis.produce": ("synthesise", "plan_scenes"),
            "synthesis.request": ("SynthRequest", "ExportContract"),
            "synthesis.renderer": ("Renderer", "World", "ScenePlan", "RenderedView"),
        },
    ),
    "bridges": (
        "Other projects' forms",
        {
            "bridges.matching": ("RaftStereo", "IgevStereo", "UniMatch", "DynamicStereo"),
            "bridges.generation": ("GenStereo", "StereoClips", "describe_pair"),
            "bridges.clips": ("export_clips", "ClipOptions"),
            "bridges.multiview": ("dust3r_views", "vggt_record"),
            "bridges.export_views": ("export_views", "ViewExportOptions"),
            "bridges.rerun": ("write_recording", "log_scene"),
            "bridges.huggingface": ("iterable", "sample_features", "features", "decode"),
            "bridges.webdataset": ("decode",),
            "bridges.croissant.descriptor": ("write_descriptor",),
            "bridges.card": ("card", "write_card"),
        },
    ),
}  # fmt: skip
"""Each page of the reference: its title, and by modules what users call; the errors have theirs."""

_LOADERS = {"loader", "set_epoch", "epoch", "stats", "close", "to_pandas"}
"""What the datasets inherit from a base that no user sees."""


def main(arguments: Sequence[str]) -> int:
    """Write the tables of fields, or the folder of the site."""
    match list(arguments):
        case []:
            write_site(HOME / "build" / "docs")
        case ["tables"]:
            page = HOME / "docs" / "samples.md"
            page.write_text(with_fields_tables(page.read_text()))
        case ["notebook"]:
            import nbformat

            with TemporaryDirectory() as folder:
                nbformat.write(executed(NOTEBOOK, Path(folder)), NOTEBOOK)
        case _:
            sys.stderr.write(f"{__doc__}")
            return 2
    return 0


def write_site(folder: Path) -> None:
    """Write all pages and pictures that the site is built from; what stood there goes."""
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(HOME / "docs", folder, ignore=shutil.ignore_patterns("*.py", "__pycache__"))
    first = folder / "index.md"
    text = with_install(first.read_text())
    first.write_text(text.replace("../examples/tutorial.ipynb", "tutorial.md"))
    (folder / "commands.md").write_text(commands_page())
    (folder / "tutorial.md").write_text(notebook_page(NOTEBOOK, pictures=folder / "tutorial"))
    (folder / "reference").mkdir()
    for name, (title, modules) in reference().items():
        (folder / "reference" / f"{name}.md").write_text(reference_page(title, modules))
    overview = folder / "api.md"
    overview.write_text(overview.read_text() + reference_overview())


def with_install(markdown: str) -> str:
    """Return a page with README's section on installing between its comments."""
    readme = (HOME / "README.md").read_text()
    section = readme.partition("\n## Install\n")[2].partition("\n## ")[0].strip()
    return re.sub(
        r"<!-- section Install of README.md -->.*?<!-- end of section -->",
        lambda _: section.replace("](docs/", "]("),
        markdown,
        flags=re.DOTALL,
    )


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


def reference() -> dict[str, tuple[str, Mapping[str, Sequence[str]]]]:
    """Return the pages of the reference, with that of all errors and warnings."""
    modules: dict[str, list[str]] = {}
    for name in stereogenbench_data.__all__:
        found = getattr(stereogenbench_data, name)
        if isinstance(found, type) and issubclass(found, Exception):
            modules.setdefault(found.__module__.removeprefix(f"{_PACKAGE}."), []).append(name)
    return {**REFERENCE, "errors": ("Errors and warnings", modules)}


def reference_page(title: str, modules: Mapping[str, Sequence[str]]) -> str:
    """Return a page of the reference: below each place of import, what is called from there."""
    parts = [f"# {title}", ""]
    public = [(place, name) for place in modules for name in modules[place] if _is_public(name)]
    if public:
        parts += [f"## `from {_PACKAGE} import ...`", ""]
        parts += [_directive(f"{_PACKAGE}.{place}.{name}") for place, name in public]
    for place, names in modules.items():
        inner = [name for name in names if (place, name) not in public]
        if inner:
            parts += [f"## `from {_PACKAGE}.{place} import ...`", ""]
            parts += [_directive(f"{_PACKAGE}.{place}.{name}") for name in inner]
    return "\n".join(parts) + "\n"


def reference_overview() -> str:
    """Return a table of each page of the reference: every name, and the first line on it."""
    parts: list[str] = []
    for page, (title, modules) in reference().items():
        parts += [
            "",
            f"## [{title}](reference/{page}.md)",
            "",
            "| name | what it is |",
            "|---|---|",
        ]
        for place, names in modules.items():
            for name in names:
                path = f"{_PACKAGE}.{place}.{name}"
                about = _first_line(place, name)
                parts.append(f"| [`{name}`](reference/{page}.md#{path}) | {_cell(about)} |")
    return "\n".join(parts) + "\n"


def _first_line(place: str, name: str) -> str:
    found = getattr(importlib.import_module(f"{_PACKAGE}.{place}"), name)
    if isinstance(found, Mapping):
        return "The table of all fields: shapes, dtypes and meanings."
    if isinstance(found, tuple):
        return "Names of fields."
    return (found.__doc__ or "").strip().splitlines()[0]


def _is_public(name: str) -> bool:
    return name in stereogenbench_data.__all__


def _directive(path: str) -> str:
    """Return what mkdocstrings puts the documentation of a thing in place of."""
    found: Any = importlib.import_module(path.rpartition(".")[0])
    found = getattr(found, path.rpartition(".")[2])
    options: dict[str, Any] = {}
    if isinstance(found, Mapping | tuple):
        options["show_attribute_values"] = False
    elif hasattr(found, "__total__"):  # a dictionary of options, whose docstring has its keys
        options["members"] = False
    elif isinstance(found, type):
        inherited = sorted(name for name in _LOADERS if hasattr(found, name))
        options["inherited_members"] = inherited if "loader" in inherited else False
    lines = [f"::: {path}", *(["    options:"] if options else [])]
    return "\n".join([*lines, *(f"      {k}: {json.dumps(v)}" for k, v in options.items()), ""])


def executed(notebook: Path, folder: Path) -> Any:
    """Return a notebook after a run of its cells in a folder: text and pictures, no times.

    Raises:
        nbclient.exceptions.CellExecutionError: If a cell raises an error.
    """
    import nbformat
    from nbclient import NotebookClient

    for module in notebook.parent.glob("small_*.py"):  # what the notebook imports
        shutil.copy(module, folder)
    ran = nbformat.read(notebook, as_version=4)
    place = {"metadata": {"path": str(folder)}}
    NotebookClient(
        ran, timeout=300, resources=place, record_timing=False, coalesce_streams=True
    ).execute()
    for cell in ran["cells"]:
        if cell["cell_type"] == "code":
            cell["execution_count"] = None
            cell["outputs"] = [nbformat.from_dict(_kept(output)) for output in cell["outputs"]]
    return ran


def _kept(output: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a notebook keeps of an output: its text, or its picture as PNG."""
    if "text" in output:
        return {"name": output["name"], "output_type": "stream", "text": output["text"]}
    data = {"image/png": output["data"]["image/png"]}
    return {"data": data, "metadata": {}, "output_type": "display_data"}


def notebook_page(notebook: Path, *, pictures: Path) -> str:
    """Return a notebook as a page: its text, its code, and below it what it showed.

    Args:
        notebook: The file, with the outputs of a run.
        pictures: The folder for its pictures, beside the page.
    """
    pictures.mkdir()
    parts: list[str] = []
    for number, cell in enumerate(json.loads(notebook.read_text())["cells"]):
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            # Links lead from the notebook's folder to the pages of `docs/`.
            parts += [source.replace("](../docs/", "]("), ""]
            continue
        parts += ["```python", source, "```", ""]
        for output in cell["outputs"]:
            if "text" in output:
                parts += ["``` { .text .output }", "".join(output["text"]).rstrip(), "```", ""]
            else:
                picture = pictures / f"{number}.png"
                picture.write_bytes(base64.b64decode("".join(output["data"]["image/png"])))
                parts += [f"![What the cell shows]({pictures.name}/{picture.name})", ""]
    return "\n".join(parts)


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
    sys.exit(main(sys.argv[1:]))
