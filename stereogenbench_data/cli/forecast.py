"""``stereogenbench forecast``: what will limit a training."""

import json
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from stereogenbench_data.cli.help import RARE, SCENES
from stereogenbench_data.cli.options import DataOptions, JsonOption, grouped
from stereogenbench_data.cli.samples import SampleSelectionOptions, parse_picture_size

if TYPE_CHECKING:
    from stereogenbench_data.datasets.forecast import Forecast
    from stereogenbench_data.datasets.scaling import Machine, Network, SampleCost, Scale

_NETWORK: Final = "Where the data will be"
"""Panel of the help for delays, bandwidths and limits."""
_MACHINES: Final = "What trains"
"""Panel of the help for machines and accelerators."""


@dataclass(frozen=True, kw_only=True)
class TrainedOptions(SampleSelectionOptions):
    """Which samples of which scenes are trained on: frames drawn at random and clips, too."""

    frames: Annotated[
        str,
        typer.Option(
            help="all, first, every:K, random:N, clips:LENGTH, random-clips:N:LENGTH.",
            rich_help_panel=SCENES,
        ),
    ] = "all"

    def windows(self) -> dict[str, Any]:
        """Return the option of `StereoPairs` that selects frames."""
        return {"frames": _frames(self.frames)}


@dataclass(frozen=True, kw_only=True)
class NetworkOptions:
    """Where the data will be."""

    delay_ms: Annotated[
        float | None,
        typer.Option(
            min=0, help="Until the first byte [of a URL: measured].", rich_help_panel=_NETWORK
        ),
    ] = None
    connection_mb_s: Annotated[
        float | None,
        typer.Option(
            min=0.001, metavar="MB/S", help="Of a connection [of a URL: measured].",
            rich_help_panel=_NETWORK,
        ),
    ] = None  # fmt: skip
    machine_mb_s: Annotated[
        float | None,
        typer.Option(
            min=0.001, metavar="MB/S", help="Of a machine [unlimited].", rich_help_panel=_NETWORK
        ),
    ] = None
    total_mb_s: Annotated[
        float | None,
        typer.Option(
            min=0.001, metavar="MB/S", help="Of the server, for all [unlimited].",
            rich_help_panel=_NETWORK,
        ),
    ] = None  # fmt: skip
    requests_s: Annotated[
        float | None,
        typer.Option(
            min=0.001, metavar="N", help="Requests a second that the server allows [unlimited].",
            rich_help_panel=_NETWORK,
        ),
    ] = None  # fmt: skip
    connections: Annotated[
        int, typer.Option(min=1, help="Requests of a worker at a time.", rich_help_panel=RARE)
    ] = 8

    def network(self, measured: "Network | None") -> "Network | None":
        """Return the network: what was given, else what was measured; None if there is neither."""
        from stereogenbench_data.datasets.scaling import Network

        given = {
            "delay_s": None if self.delay_ms is None else self.delay_ms / 1e3,
            "connection_bytes_s": _bytes_s(self.connection_mb_s),
            "machine_bytes_s": _bytes_s(self.machine_mb_s),
            "total_bytes_s": _bytes_s(self.total_mb_s),
            "requests_s": self.requests_s,
        }
        known: dict[str, Any] = {name: each for name, each in given.items() if each is not None}
        if measured is not None:
            known = {
                "delay_s": measured.delay_s, "connection_bytes_s": measured.connection_bytes_s,
            } | known  # fmt: skip
        return Network(**known, connections=self.connections) if known else None


@dataclass(frozen=True, kw_only=True)
class MachineOptions:
    """What trains."""

    samples_s: Annotated[
        float,
        typer.Option(
            "--samples-s", min=0.001, metavar="RATE",
            help="Samples a second that an accelerator takes.", rich_help_panel=_MACHINES,
        ),
    ]  # fmt: skip
    accelerators: Annotated[
        str,
        typer.Option(metavar="N,N", help="How many, in all.", rich_help_panel=_MACHINES),
    ] = "1,8,64,512,1000,10000"
    per_machine: Annotated[
        int, typer.Option(min=1, help="Accelerators of a machine.", rich_help_panel=_MACHINES)
    ] = 8
    cores: Annotated[
        int | None,
        typer.Option(min=1, help="Cores of a machine [as here].", rich_help_panel=_MACHINES),
    ] = None
    workers: Annotated[
        int | None,
        typer.Option(
            min=1, help="Workers of a machine, at most [one a core].", rich_help_panel=_MACHINES
        ),
    ] = None

    def numbers(self) -> tuple[int, ...]:
        """Return the numbers of accelerators.

        Raises:
            typer.BadParameter: If they are no numbers from 1.
        """
        parts = [part.strip() for part in self.accelerators.split(",")]
        if not all(part.isdecimal() and int(part) > 0 for part in parts):
            raise typer.BadParameter(
                f"{self.accelerators!r}: write numbers from 1, such as 1,8,64.",
                param_hint="--accelerators",
            )
        return tuple(map(int, parts))

    def machine(self) -> "Machine":
        """Return each machine."""
        from stereogenbench_data.datasets.forecast import cores_here
        from stereogenbench_data.datasets.scaling import Machine

        return Machine(self.cores or cores_here(), self.per_machine, self.workers or 0)


@grouped
def forecast(  # noqa: PLR0913 - one parameter an option
    source: DataOptions,
    *,
    trains: MachineOptions,
    size: Annotated[
        str | None, typer.Option(metavar="WxH", help="Of a sample's pictures [as stored].")
    ] = None,
    fields: Annotated[
        str | None, typer.Option(metavar="NAMES", help="Such as left,right [the defaults].")
    ] = None,
    batch_size: Annotated[int, typer.Option(min=1, help="Samples of a batch.")] = 8,
    training: Annotated[
        str | None,
        typer.Option(
            metavar="WxH", help="Compare with training shards: one scene is derived and measured."
        ),
    ] = None,
    measure_s: Annotated[
        float, typer.Option(min=0.1, help="How long to decode.", rich_help_panel=RARE)
    ] = 6.0,
    where: NetworkOptions,
    chosen: TrainedOptions,
    as_json: JsonOption = False,
) -> None:
    """Forecast what will limit a training: processors, network, requests.

    Bytes and requests of a sample follow from the index. Decoding is measured on this machine, for
    seconds. The documentation has the formula.
    """
    from stereogenbench_data.datasets.forecast import forecast as forecast_by
    from stereogenbench_data.datasets.forecast import measured_network
    from stereogenbench_data.samples.fields import DEFAULT_PAIR_FIELDS
    from stereogenbench_data.sources.location import is_remote

    numbers, selection = trains.numbers(), chosen.selection()
    size_px = None if size is None else parse_picture_size(size)
    training_px = None if training is None else parse_picture_size(training)
    names = DEFAULT_PAIR_FIELDS if fields is None else [each.strip() for each in fields.split(",")]
    index = source.open()
    asks = is_remote(index.root) and None in (where.delay_ms, where.connection_mb_s)
    found = forecast_by(
        index,
        samples_s=trains.samples_s,
        accelerators=numbers,
        batch_size=batch_size,
        machine=trains.machine(),
        network=where.network(measured_network(index) if asks else None),
        fields=names,
        size=size_px,
        training=training_px,
        measure_s=measure_s,
        **selection,
    )
    if as_json:
        typer.echo(json.dumps(found.to_json(), indent=1))
        return
    typer.echo("\n".join(_lines(found)))


def _digits(number: float) -> str:
    """Return a number with its first four digits, or all before the point; no exponent.

    >>> _digits(14306.2), _digits(27.943), _digits(10.0)
    ('14,306', '27.94', '10')
    """
    decimals = max(0, 3 - math.floor(math.log10(number))) if number > 0 else 0
    text = f"{number:,.{decimals}f}"
    return text.rstrip("0").rstrip(".") if "." in text else text


def _lines(found: "Forecast") -> list[str]:
    network = found.network
    ways = [
        f"{network.delay_s * 1e3:.3g} ms until a first byte" if network.delay_s else "",
        _bandwidth(network.connection_bytes_s, "a connection"),
        _bandwidth(network.machine_bytes_s, "a machine"),
        _bandwidth(network.total_bytes_s, "in all"),
        f"{_digits(network.requests_s)} requests/s" if math.isfinite(network.requests_s) else "",
    ]
    here = f", {found.cost.slowdown:.2f} times that in each of {found.measured_on} at a time"
    counted = "all" if found.bytes_of == "epoch" else "a part"
    lines = [
        f"A sample: {_cost(found.cost)}"
        + (here if found.measured_on > 1 else "")
        + f" (bytes by the index, over {counted} of {found.samples:,} samples)",
        f"A worker: {found.worker_bytes / 1e9:.2g} GB of memory",
        f"Data: {', '.join(filter(None, ways)) or 'on a disk that is never waited for'}",
        "",
        *_table(found.scales),
    ]
    if found.training is not None and found.training_cost is not None:
        lines += ["", f"With training shards: {_cost(found.training_cost)}"]
        lines += ["", *_table(found.training)]
    return lines


def _cost(cost: "SampleCost") -> str:
    return (
        f"{cost.cpu_s * 1e3:.3g} ms of a core, {_digits(cost.bytes / 1e3)} kB in "
        f"{cost.requests:.3g} requests"
    )


def _table(scales: "tuple[Scale, ...]") -> list[str]:
    heads = (
        "accelerators", "machines", "cores", "workers/machine", "MB/s", "requests/s", "fed",
        "limit",
    )  # fmt: skip
    rows = [
        (
            f"{each.accelerators:,}", f"{each.machines:,}", f"{each.cores:,}",
            f"{each.workers:,}", _digits(each.bytes_s / 1e6), _digits(each.requests_s),
            f"{each.share:.0%}", each.limit,
        )
        for each in scales
    ]  # fmt: skip
    widths = [max(map(len, column)) for column in zip(heads, *rows, strict=True)]
    return [
        "  ".join(
            text.ljust(width) if text == row[-1] else text.rjust(width)
            for text, width in zip(row, widths, strict=True)
        ).rstrip()
        for row in (heads, *rows)
    ]


def _bandwidth(bytes_s: float, of: str) -> str:
    return f"{_digits(bytes_s / 1e6)} MB/s {of}" if math.isfinite(bytes_s) else ""


def _bytes_s(mb_s: float | None) -> float | None:
    return None if mb_s is None else mb_s * 1e6


_FRAMES: Final = {"every": 1, "random": 1, "clips": 1, "random-clips": 2}
"""Kinds of frames to how many numbers follow."""


def _frames(text: str) -> Any:
    if text in ("all", "first"):
        return text
    kind, *numbers = text.split(":")
    if all(map(str.isdecimal, numbers)):
        if _FRAMES.get(kind) == len(numbers):
            return (kind.replace("-", " "), *map(int, numbers))
        if not numbers and all(map(str.isdecimal, text.split(","))):
            return [int(number) for number in text.split(",")]
    raise typer.BadParameter(
        f"{text!r} is not all, first, every:K, random:N, clips:LENGTH, random-clips:N:LENGTH or "
        f"numbers such as 0,40,80.",
        param_hint="--frames",
    )
