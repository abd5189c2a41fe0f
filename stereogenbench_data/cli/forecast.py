"""``stereogenbench forecast``: what will limit a training."""

import math
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any

import typer

from stereogenbench_data.cli.options import (
    DataOptions,
    SampleOptions,
    SizeOption,
    grouped,
    option,
)

_of = partial(option, panel="What trains, and on which network")


@dataclass(frozen=True, kw_only=True)
class MachineOptions:
    """What trains, and where the data will be."""

    samples_s: Annotated[float, _of("Samples a second that an accelerator takes.", min=0.001)]
    per_machine: Annotated[int, _of("Accelerators of a machine.", min=1)] = 8
    cores: Annotated[int | None, _of("Cores of a machine [as here].", min=1)] = None
    delay_ms: Annotated[float | None, _of("Until the first byte [of a URL: measured].", min=0)] = (
        None
    )
    machine_mb_s: Annotated[float, _of("Of a machine.", min=0.001)] = math.inf
    total_mb_s: Annotated[float, _of("Of the server, for all.", min=0.001)] = math.inf


@grouped
def forecast(
    source: DataOptions,
    *,
    trains: MachineOptions,
    size: SizeOption = None,
    fields: Annotated[
        str | None, option("Such as left,right [the defaults].", metavar="NAMES")
    ] = None,
    batch_size: Annotated[int, option("Samples of a batch.", min=1)] = 8,
    chosen: SampleOptions,
) -> None:
    """Forecast what will limit a training: processors, network, requests.

    Bytes and requests of a sample follow from the index. Decoding is measured on this machine, for
    seconds. Frames may be random:N or clips:LENGTH, too. The documentation has the formula;
    `stereogenbench_data.forecast` returns the numbers.

    Example: `stereogenbench forecast shards/ --samples-s 100 --delay-ms 60`
    """
    from stereogenbench_data.datasets.forecast import forecast as forecast_by

    options = vars(trains) | chosen.selection()
    if fields is not None:
        options["fields"] = [each.strip() for each in fields.split(",")]
    if size is not None:
        options["size"] = size
    found = forecast_by(source.open(), batch_size=batch_size, **options)
    typer.echo(_table(found))


def _table(found: Any) -> str:
    heads = (
        "accelerators", "machines", "cores each", "workers each", "MB/s in all",
        "requests/s in all", "fed", "limit",
    )  # fmt: skip
    lines = [
        f"A sample: {found.decoding_s * 1e3:.3g} ms of a core, {found.bytes / 1e3:,.1f} kB in "
        f"{found.requests:.3g} requests, each {found.delay_ms:.3g} ms until its first byte",
        "",
        "{:>12}  {:>8}  {:>10}  {:>12}  {:>12}  {:>17}  {:>4}  {}".format(*heads),
    ]
    lines += [
        f"{each.accelerators:12,}  {each.machines:8,}  {each.cores:10,}  {each.workers:12,}  "
        f"{each.mb_s:12,.1f}  {each.requests_s:17,.1f}  {each.share:4.0%}  {each.limit}"
        for each in found.scales
    ]
    return "\n".join(lines)
