"""Options of the commands that score: which pairs and frames, which metrics, with what."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from stereogenbench_data.evaluation.protocol import EvaluationProtocol

TierOption = Annotated[
    str,
    typer.Option(
        "--tier",
        help="What the method was given: G0 target geometry, G1 camera, G2 the left view alone.",
    ),
]
PairsOption = Annotated[
    str, typer.Option("--pairs", help="primary, adjacent, all, or pairs such as 0-1,0-5.")
]
FramesOption = Annotated[
    str, typer.Option("--frames", help="all, first, every:K, or numbers such as 0,40,80.")
]
BaselineOption = Annotated[
    tuple[float, float] | None,
    typer.Option("--baseline-cm", help="Shortest and longest baseline, in cm."),
]
SizeOption = Annotated[
    str, typer.Option("--size", help="WIDTHxHEIGHT at which everything is scored [the paper's].")
]
MetricsOption = Annotated[
    str,
    typer.Option(
        "--metrics",
        help="Of psnr, ssim, lpips, e_match, p_psnr, sd, fid, fvd, fd-colour, fd-motion.",
    ),
]
KeypointsOption = Annotated[
    str, typer.Option("--keypoint-matcher", help="For E_match: sift, or dedode (the paper's).")
]
StereoOption = Annotated[
    str,
    typer.Option("--stereo-matcher", help="For SD: sgbm, or foundation-stereo (the paper's)."),
]
FitOption = Annotated[
    str,
    typer.Option(
        "--fit",
        help="The fit of SD that relations are judged by: filtered, least_squares or theil_sen. "
        "Reports always show the first two.",
    ),
]
WeightsOption = Annotated[
    Path | None,
    typer.Option("--weights", "--checkpoint", help="Folder of weights [torch.hub's checkpoints]."),
]
CheckoutOption = Annotated[
    Path | None, typer.Option("--checkout", help="Clone of FoundationStereo's repository.")
]
DeviceOption = Annotated[str, typer.Option("--device", help="Where learned parts run.")]
ByOption = Annotated[
    list[str] | None,
    typer.Option(
        "--by",
        help="Column of the index to stratify by, such as map_name, or focal_mm:18,35,85 with "
        "edges; may be given again.",
    ),
]
PlotsOption = Annotated[bool, typer.Option("--plots/--no-plots", help="Draw metric by baseline.")]
ReportOption = Annotated[
    Path | None,
    typer.Option("--out", "-o", help="Folder of the report, which keeps partial results too."),
]

PAPER_SIZE = "832x480"
OFFLINE = "psnr,ssim,e_match,p_psnr,sd"


def parse_pairs(text: str) -> Any:
    """Return the pairs that an option names, as `StereoPairs` takes them.

    Raises:
        typer.BadParameter: If it names none.
    """
    if text in ("primary", "adjacent", "all"):
        return text
    pairs = [each.split("-") for each in text.split(",")]
    if not all(len(pair) == 2 and all(map(str.isdecimal, pair)) for pair in pairs):
        raise typer.BadParameter(f"{text!r} is not primary, adjacent, all or pairs such as 0-1,0-5")
    return [(int(left), int(right)) for left, right in pairs]


def parse_frames_option(text: str) -> Any:
    """Return the frames that an option names, as `StereoPairs` takes them.

    Raises:
        typer.BadParameter: If it names none.
    """
    if text in ("all", "first"):
        return text
    every, _, step = text.partition(":")
    if every == "every" and step.isdecimal():
        return ("every", int(step))
    if all(map(str.isdecimal, text.split(","))):
        return [int(number) for number in text.split(",")]
    raise typer.BadParameter(f"{text!r} is not all, first, every:K or numbers such as 0,40,80")


def parse_size(text: str) -> tuple[int, int]:
    """Return (height, width) of an option that says WIDTHxHEIGHT.

    Raises:
        typer.BadParameter: If it does not.
    """
    width, _, height = text.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise typer.BadParameter(f"{text!r} is no WIDTHxHEIGHT, such as {PAPER_SIZE}")
    return int(height), int(width)


def parse_by(texts: list[str] | None) -> dict[str, tuple[float, ...]]:
    """Return columns to stratify by, with their edges.

    Raises:
        typer.BadParameter: If an edge is no number.
    """
    by: dict[str, tuple[float, ...]] = {}
    for text in texts or []:
        column, _, edges = text.partition(":")
        try:
            by[column] = tuple(float(edge) for edge in edges.split(",")) if edges else ()
        except ValueError:
            raise typer.BadParameter(f"{text!r}: {edges!r} are no numbers") from None
    return by


def protocol_of(  # noqa: PLR0913 - one parameter an option
    *,
    metrics: str,
    size: str,
    keypoint_matcher: str,
    stereo_matcher: str,
    fit: Any,
    depth_unit_m: float | None,
    weights: Path | None,
    checkout: Path | None,
    device: str,
) -> "EvaluationProtocol":
    """Return the protocol that options ask for."""
    from stereogenbench_data.evaluation.columns import require_metrics
    from stereogenbench_data.evaluation.models.registry import ModelOptions
    from stereogenbench_data.evaluation.protocol import EvaluationProtocol
    from stereogenbench_data.schema.records import DepthEncoding

    return EvaluationProtocol(
        metrics=require_metrics(metrics),
        size=parse_size(size),
        keypoint_matcher=keypoint_matcher,
        stereo_matcher=stereo_matcher,
        fit=fit,
        depth=None if depth_unit_m is None else DepthEncoding(unit_m=depth_unit_m),
        models=ModelOptions(device=device, weights=weights, checkout=checkout),
    )
