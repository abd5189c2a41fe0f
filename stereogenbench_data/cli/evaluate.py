"""``stereogenbench eval inputs``, ``score``, ``controls``, ``disparity``: scores of a method.

They share their options: scenes, pairs and frames, metrics and models, the report.
"""

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stereogenbench_data.cli.options import (
    DataOptions,
    JsonOption,
    OutArgument,
    SampleOptions,
    SizeOption,
    SplitOption,
    WorkOptions,
    grouped,
    option,
    size_of,
)
from stereogenbench_data.cli.progress import progress_bar
from stereogenbench_data.cli.screen import print_report
from stereogenbench_data.evaluation.columns import METRICS, OFFLINE_METRICS
from stereogenbench_data.schema.text import counted

if TYPE_CHECKING:
    from stereogenbench_data.evaluation.protocol import EvaluationProtocol
    from stereogenbench_data.evaluation.tables import Scores, Table
    from stereogenbench_data.index.table import SceneIndex


_METRICS = "How metrics are computed"
"""Panel of the help for the options of metrics."""
TierOption = Annotated[
    str,
    option(
        "What the method is given beside the left view: G0 the target's depth, G1 the camera, "
        "G2 nothing.",
        metavar="G0|G1|G2",
    ),
]
ScoredSizeOption = Annotated[
    Any,
    option("--size", "Width x height of what is scored; N is NxN.", parser=size_of, metavar="WxH"),
]
PAPER_SIZE = "832x480"


@dataclass(frozen=True, kw_only=True)
class ScoredOptions(SampleOptions):
    """Which samples are scored: those of the eval split by default."""

    split: SplitOption = "eval"

    @contextmanager
    def scored(
        self, source: DataOptions, folder: Path, work: WorkOptions, *, device: str = "cpu"
    ) -> "Iterator[tuple[SceneIndex, dict[str, Any]]]":
        """Yield the index, and options of what scores, with a bar that shows its progress.

        Args:
            source: The data.
            folder: Where the report will be, and partial results.
            work: How many processes.
            device: Where learned models run.
        """
        options = {**work.options(device=device), **self.selection(), "out": folder / "partial"}
        index = source.open()
        with progress_bar("scoring", unit="frames") as progress:
            yield index, options | {"progress": progress}


@dataclass(frozen=True, kw_only=True)
class ProtocolOptions:
    """The metrics and the models that compute them."""

    size: ScoredSizeOption = PAPER_SIZE
    metrics: Annotated[str, option(f"Of {', '.join(METRICS)}; or all.", metavar="NAMES")] = (
        ",".join(OFFLINE_METRICS)
    )
    keypoint_matcher: Annotated[
        str,
        option("Of E_match: sift, or FILE.py:Class of your own.", metavar="NAME", panel=_METRICS),
    ] = "sift"
    stereo_matcher: Annotated[
        str, option("Of SD: sgbm, or FILE.py:Class of your own.", metavar="NAME", panel=_METRICS)
    ] = "sgbm"
    weights: Annotated[
        Path | None,
        option("Folder of weights [torch.hub's checkpoints].", metavar="DIR", panel=_METRICS),
    ] = None
    device: Annotated[
        str, option("Of learned models; other than cpu: one process.", panel=_METRICS)
    ] = "cpu"

    def protocol(self) -> "EvaluationProtocol":
        """Return the protocol of the options.

        Raises:
            EvaluationError: If a metric is unknown.
        """
        from stereogenbench_data.evaluation.protocol import EvaluationProtocol

        return EvaluationProtocol(**vars(self))


@dataclass(frozen=True, kw_only=True)
class GroupOptions:
    """What else scores are grouped by, and how many may be missing."""

    by: Annotated[
        list[str] | None,
        option("Also score by map_name, focal_mm, ... May be repeated.", metavar="COLUMN"),
    ] = None
    allow_missing: Annotated[int, option("Most pairs without usable predictions.", min=0)] = 0

    def columns(self, index: "SceneIndex", *first: str) -> list[str]:
        """Return the columns, those named first included; refuse an unknown one before the work."""
        columns = list(dict.fromkeys([*first, *(self.by or ())]))
        for column in columns:
            index.column(column)
        return columns


@dataclass(frozen=True, kw_only=True)
class ReportOptions:
    """The report of scores."""

    out: Annotated[
        Path | None,
        option("--out", "-o", "Folder of the report and of partial results.", metavar="DIR"),
    ] = None
    as_json: JsonOption = False

    def write(self, folder: Path, results: "Sequence[Scores]", tables: "Sequence[Table]") -> None:
        """Print the report as a page, a screen or JSON, and write its files."""
        from stereogenbench_data.evaluation.report import (
            document,
            page,
            transposed,
            verdict,
            write_report,
        )

        if self.as_json:
            typer.echo(json.dumps(document(results, tables), allow_nan=False))
        else:
            shown = [(each.title, transposed(each)) for each in tables]
            rest = f"Whole report: {folder / 'report.md'}"
            print_report(verdict(results), shown, whole=page(results, tables), rest=rest)
        files = write_report(folder, results, tables)
        names = ", ".join(str(path.relative_to(folder)) for path in files)
        typer.echo(f"{folder}: {names}", err=True)


@grouped
def inputs(
    source: DataOptions,
    out: OutArgument,
    *,
    tier: TierOption,
    chosen: ScoredOptions,
    size: ScoredSizeOption = PAPER_SIZE,
    work: WorkOptions,
) -> None:
    """Write what a method is given: left views, geometry, camera.

    Left views are PNG; tier G0 adds the target's geometry, G1 the camera, G2 nothing. An item is
    one pair of one scene; its folder's name reveals neither. Write the output of the method as
    PREDICTIONS/ITEM/000.png ... or PREDICTIONS/ITEM.mp4, then run `stereogenbench eval score` with
    the same selection. To continue a stopped run, run it again.

    Example: `stereogenbench eval inputs shards/ inputs/ --tier G1`
    """
    from stereogenbench_data.evaluation.inputs import export_inputs

    selection, index = chosen.selection(), source.open()
    with progress_bar("writing", unit="frames") as progress:
        items = export_inputs(
            index, out, tier=tier, size=size, **work.options(), progress=progress, **selection
        )
    typer.echo(f"{out}: {counted(len(items), 'item')} of tier {tier}")


@grouped
def score(  # noqa: PLR0913 - one parameter an option
    source: DataOptions,
    predictions: Annotated[
        Path, typer.Argument(help="Folder of right views, ITEM/000.png ... or ITEM.mp4.")
    ],
    *,
    tier: TierOption,
    name: Annotated[str | None, option("Name of the method [the folder's name].")] = None,
    chosen: ScoredOptions,
    scoring: ProtocolOptions,
    groups: GroupOptions,
    report: ReportOptions,
    work: WorkOptions,
) -> None:
    """Score a method's right views by the paper's protocol.

    `stereogenbench eval inputs` writes what the method is given. PREDICTIONS holds, for each
    item, a folder of PNGs or a video of the same name. The report (Markdown, LaTeX, JSON, CSV,
    plots) and partial results go to --out [evaluation/NAME-TIER]. To continue a stopped run, run it
    again.

    Example: `stereogenbench eval score shards/ predictions/ --tier G1`
    """
    from stereogenbench_data.evaluation.evaluate import evaluate
    from stereogenbench_data.evaluation.tables import tables_of

    protocol, called = scoring.protocol(), name or predictions.resolve().name
    folder = report.out or Path("evaluation") / f"{called}-{tier}"
    with chosen.scored(source, folder, work, device=scoring.device) as (index, how):
        columns, how["allow_missing"] = groups.columns(index), groups.allow_missing
        scores = evaluate(index, predictions, tier=tier, name=called, protocol=protocol, **how)
    report.write(folder, [scores], tables_of([scores], by=columns))


@grouped
def disparity(  # noqa: PLR0913 - one parameter an option
    source: DataOptions,
    predictions: Annotated[
        Path,
        typer.Argument(help="Folder of disparity maps, SCENE/00-01/000.pfm, .png, .npy, .npz."),
    ],
    *,
    chosen: ScoredOptions,
    size: SizeOption = None,
    max_disparity: Annotated[
        float | None,
        option("Leave out pixels whose true disparity is this or more.", metavar="PX"),
    ] = None,
    groups: GroupOptions,
    report: ReportOptions,
    work: WorkOptions,
) -> None:
    """Score the disparity that a method finds in the left views.

    PREDICTIONS holds a folder for each pair, SCENE/00-01 or the item's name, with a map for each
    frame: PFM, KITTI's PNG, npy or npz, positive pixels of the scored size. The report (Markdown,
    LaTeX, JSON, CSV, plots) and partial results go to --out [evaluation/FOLDER-disparity]. To
    continue a stopped run, run it again.

    Example: `stereogenbench eval disparity shards/ maps/`
    """
    from stereogenbench_data.evaluation.disparity import disparity_tables, evaluate_disparity
    from stereogenbench_data.evaluation.protocol import DisparityProtocol

    protocol = DisparityProtocol(size=size, max_disparity_px=max_disparity)
    folder = report.out or Path("evaluation") / f"{predictions.resolve().name}-disparity"
    with chosen.scored(source, folder, work) as (index, how):
        columns, how["allow_missing"] = groups.columns(index, "map_name"), groups.allow_missing
        scores = evaluate_disparity(index, predictions, protocol=protocol, **how)
    report.write(folder, [scores], disparity_tables([scores], by=columns))


@grouped
def controls(
    source: DataOptions,
    *,
    chosen: ScoredOptions,
    scoring: ProtocolOptions,
    report: ReportOptions,
    work: WorkOptions,
) -> None:
    """Score a perfect, a copied, a wrong and a random right view.

    The controls are the rendered target, the left view, the view of the next camera (02 for 01),
    and the right view of another scene. The report goes to --out [evaluation/controls]. To continue
    a stopped run, run it again.

    Example: `stereogenbench eval controls shards/ --frames every:20`
    """
    from stereogenbench_data.evaluation.controls import score_controls
    from stereogenbench_data.evaluation.tables import table_of

    protocol, folder = scoring.protocol(), report.out or Path("evaluation") / "controls"
    with chosen.scored(source, folder, work, device=scoring.device) as (index, how):
        results = score_controls(index, protocol=protocol, **how)
    tables = [table_of(results, name) for name in ("controls", "branches", "explanations")]
    report.write(folder, results, tables)
