"""Races over a network: shards behind a server that delays, limits, cuts and refuses.

Every contestant reads the same scenes from the same server of this machine, as its documentation
advises: ours with the defaults, webdataset and Hugging Face `datasets` stream whole tar files,
Mosaic's Streaming downloads its own shards. Beside them ours reads the same shards from the local
disk: the ratio to it says how much of the network is hidden. Scenes beyond the few drawn ones are
hard links to their shards under other names, so what a machine reads stays in its page cache.

The server counts requests and bytes. Time runs as in the other races; the time until the first
batch is kept too, so that the rate after it is known.
"""

import itertools
import os
import resource
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from importlib import import_module
from pathlib import Path
from typing import Any, Final

from torch.utils.data import DataLoader

from benchmarks.clock import Measured, MeasurementError, in_a_fork, whole_pass
from benchmarks.contestants import mosaic, scenewise
from benchmarks.field import unavailable
from benchmarks.material import Material
from benchmarks.results import Report, Results, Spread
from benchmarks.server import Network, serving
from benchmarks.tables import rate_text, spread_text, table
from benchmarks.workloads import SEED, Job, Wanted, Workload
from stereogenbench_data import StereoPairs
from stereogenbench_data.index.parquet import INDEX_NAME
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.schema.records import SceneId
from stereogenbench_data.schema.text import counted

LOCAL: Final = "ours, local"
OURS: Final = "ours"
RIVALS: Final = {
    "webdataset": partial(import_module, "webdataset"),
    "HF datasets": lambda: (import_module("aiohttp"), import_module("datasets")),
    "Mosaic Streaming": mosaic.streaming_module,
}
"""The other contestants, and what imports their libraries."""


NETWORKS: Final = (
    *(
        Network(delay_s, connection_mb_s=mb_s)
        for mb_s in (0.0, 20.0)
        for delay_s in (0.0, 0.02, 0.06, 0.15)
    ),
    Network(0.06, refused=0.05),
    Network(0.06, lost=0.05),
)
"""Networks of the races; where they have faults, ours alone races."""

WORKLOADS: Final = (
    Workload("all-frames", "all frames", 16, "all", "all"),
    Workload("random", "random frames, 4 a scene", 16, ("random", 4), ("random", 4)),
    Workload("first", "first frames", 200, "first", "first"),
    Workload("clips", "16-frame clips", 16, ("clips", 16, 1, 16), ("clips", 16, 1, 16), batch=1),
)

LONGEST_S: Final = 1800.0


@dataclass(frozen=True, slots=True)
class Plan:
    """The settings of the races.

    Attributes:
        rounds: The number of rounds.
        workers: Worker processes.
        networks: The networks.
        scenes: The number of scenes of every workload; 0 is the workload's own.
        workloads: The names of the workloads.
        resume: Whether rounds in the results count.
    """

    rounds: int = 3
    workers: int = 2
    networks: tuple[Network, ...] = NETWORKS
    scenes: int = 0
    workloads: tuple[str, ...] = tuple(workload.name for workload in WORKLOADS)
    resume: bool = False


@dataclass(frozen=True)
class LinkedJob(Job):
    """A workload on linked shards.

    Attributes:
        scenes: The number of scenes.
    """

    scenes: int = 0

    @property
    def root(self) -> Path:
        """The folder that the server serves."""
        return self.material.root / "network"

    @property
    def shards(self) -> Path:
        """The shards and their index."""
        return self.root / f"shards-{self.scenes}"

    @property
    def mds(self) -> Path:
        """Mosaic's shards of the same scenes."""
        return self.root / f"mds-{self.scenes}"

    def pairs(self, data: str | Path) -> StereoPairs:
        """Return the samples of the workload from a place of the shards."""
        workload = self.workload
        return StereoPairs(
            data, pairs="primary", frames=workload.frames, fields=workload.fields, seed=SEED
        )

    @cached_property
    def of_scene(self) -> dict[str, list[Wanted]]:
        """The samples of each drawn scene, by its key in the shards.

        Scenes that are links to one shard have the frames of the first of them.
        """
        pairs, found = self.pairs(self.shards), dict[str, list[Wanted]]()
        keys = pairs.index.column("key").tolist()
        drawn = SceneIndex.open(self.material.shards).column("key").tolist()[: self.scenes]
        for number in range(len(pairs)):
            address = pairs.plan.locate(number, epoch=0)
            place = int(str(keys[address.row]).rpartition("_")[2])
            if place < len(drawn):
                (right,) = address.targets
                wanted = Wanted(drawn[place], address.source, right, address.frames)
                found.setdefault(drawn[place], []).append(wanted)
        return found


@dataclass(frozen=True, slots=True)
class Turn(Measured):
    """One contestant's turn, with what its process and the server counted.

    Attributes:
        peak_mb: The most memory that a worker held, shared memory included.
        requests: Requests that the server counted.
        sent_mb: Megabytes of bodies that it counted.
        failures: Responses that it cut or refused on purpose.
    """

    peak_mb: float = 0.0
    requests: int = 0
    sent_mb: float = 0.0
    failures: int = 0


def link_shards(job: LinkedJob) -> None:
    """Make as many shards as a job has scenes: links to the packed ones in turn, with an index."""
    if (job.shards / INDEX_NAME).exists():
        return
    index = SceneIndex.open(job.material.shards)
    index.load_seek_tables()
    job.shards.mkdir(parents=True, exist_ok=True)
    scenes, facts = [], {}
    for number in range(job.scenes):
        row = number % len(index)
        scene, name = index.scene(row), f"net-{number:06d}.tar"
        (path,) = {member.path for member in scene.members.values()}
        if not (job.shards / name).exists():
            os.link(job.material.shards / path, job.shards / name)
        facts[name] = index.shards[path]
        family = scene.id.family
        key = f"train/{family}/SynthStage/scene_{number:06d}"
        members = {file: replace(member, path=name) for file, member in scene.members.items()}
        identity = SceneId(key, "train", None, family, scene.id.map_name)
        tables = index.seek_tables(row)
        scenes.append(replace(scene, id=identity, members=members, seek_tables=tables))
    SceneIndex.from_scenes(scenes, job.shards, shards=facts).write(job.shards / INDEX_NAME)


def link_mds(job: LinkedJob) -> None:
    """Make Mosaic's shards of the same scenes, whole like the tar files."""
    if (job.mds / "index.json").exists():
        return
    distinct = job.root / "mds"
    if not (distinct / "index.json").exists():
        shutil.rmtree(distinct, ignore_errors=True)
        mosaic.write_shards(SceneIndex.open(job.material.shards), distinct)
    job.mds.mkdir(parents=True, exist_ok=True)
    mosaic.repeat_shards(distinct, job.mds, count=job.scenes)


def run_network(material: Material, results: Results, *, plan: Plan, report: Report) -> list[str]:
    """Run the races; results are written after every network.

    Returns:
        A message for each failure.
    """
    reasons = {name: why for name, load in RIVALS.items() if (why := unavailable(load))}
    section = results.sections.get("network", {}) if plan.resume else {}
    section = {"failed": reasons, "workers": plan.workers, "races": section.get("races", [])}
    failed = []
    for workload in (each for each in WORKLOADS if each.name in plan.workloads):
        scenes = plan.scenes or workload.scenes
        job = LinkedJob(workload, material, scenes=scenes)
        link_shards(job)
        if "Mosaic Streaming" not in reasons:
            in_a_fork(partial(link_mds, job))
        for number, network in itertools.product(range(plan.rounds), plan.networks):
            place = {
                "workload": workload.name, "scenes": scenes, "round": number, **asdict(network)
            }  # fmt: skip
            if any(place.items() <= race.items() for race in section["races"]):
                continue
            report(f"network, {workload.title}, {_named(network)}: round {number + 1}")
            rivals = () if network.refused or network.lost else RIVALS
            names = [name for name in (LOCAL, OURS, *rivals) if name not in reasons]
            found = {}
            for name in names if number % 2 == 0 else names[::-1]:
                try:
                    found[name] = asdict(measured(name, job, network, workers=plan.workers))
                except MeasurementError as error:
                    failed.append(f"network: {workload.name}: {name}: {error}")
                    report(failed[-1][:400])
            section["races"].append({**place, "found": found})
            results.put("network", section)
    return failed


def measured(name: str, job: LinkedJob, network: Network, *, workers: int) -> Turn:
    """Return what one contestant's turn took, over a network.

    Raises:
        MeasurementError: If it fails.
    """
    with serving(job.root, network=network) as server:
        run = partial(_run, name, job, server.url, workers=workers)
        found: Turn = in_a_fork(run, longest_s=LONGEST_S)
        counts = server.counts()
    sent_mb = round(counts.sent_bytes / 1e6, 3)
    return replace(found, requests=counts.requests, sent_mb=sent_mb, failures=counts.failures)


def _run(name: str, job: LinkedJob, url: str, *, workers: int) -> Turn:
    list(job.of_scene)  # computed before the clock starts
    with tempfile.TemporaryDirectory() as local:
        took = whole_pass(partial(_loader, name, job, url, Path(local)), workers=workers)
    peak_kb = resource.getrusage(
        resource.RUSAGE_CHILDREN if workers else resource.RUSAGE_SELF
    ).ru_maxrss
    return Turn(**asdict(took), peak_mb=round(peak_kb / 1e3, 1))


def _loader(name: str, job: LinkedJob, url: str, local: Path, **options: Any) -> DataLoader[Any]:
    """Return a contestant's loader; an empty folder is for what it downloads."""
    place, batch = f"{url}/{job.shards.name}", job.workload.batch
    if name in (LOCAL, OURS):
        pairs = job.pairs(job.shards if name == LOCAL else place)
        return pairs.loader(batch, drop_last=False, seed=SEED, **options)
    tars = [f"{place}/{path.name}" for path in sorted(job.shards.glob("*.tar"))]
    if name == "webdataset":
        stream = scenewise.webdataset_stream(job, tars)
    elif name == "HF datasets":
        stream = scenewise.hugging_face_stream(job, tars)
    else:
        stream = mosaic.MosaicScenes(job, server=url, remote=f"s3://{job.mds.name}", local=local)
    return DataLoader(stream, batch_size=batch, **options)


def _named(network: Network) -> str:
    """Return a network in words."""
    words = [f"{network.delay_s * 1e3:g} ms"]
    words += [f"{network.connection_mb_s:g} MB/s a connection"] if network.connection_mb_s else []
    words += [f"{network.refused:.0%} of requests refused"] if network.refused else []
    words += [f"{network.lost:.0%} of responses cut"] if network.lost else []
    return ", ".join(words)


_Value = Callable[[dict[str, Any], dict[str, Any]], float]
"""A figure of a contestant's turn, given that of ours from the local disk in the same round."""


_Rounds = list[dict[str, dict[str, Any]]]
"""What was found in each round of one workload over one network, by contestant."""


def _spread(rounds: _Rounds, name: str, value: _Value) -> Spread | None:
    """Return the spread of a value of a contestant, given its turn and the local one's."""
    both = [found for found in rounds if name in found and LOCAL in found]
    return Spread.of(value(found[name], found[LOCAL]) for found in both)


def _rate(turn: dict[str, Any]) -> float:
    return float(turn["samples"] / turn["seconds"])


def _later_rate(turn: dict[str, Any]) -> float:
    """Return the samples a second after the first batch."""
    seconds = turn["seconds"] - turn["first_s"]
    return float((turn["samples"] - turn["first_samples"]) / seconds) if seconds > 0 else 0.0


def _by_network(section: dict[str, Any], workload: Workload) -> dict[Network, _Rounds]:
    found: dict[Network, _Rounds] = {}
    for race in section["races"]:
        if race["workload"] == workload.name:
            network = Network(**{name: race[name] for name in asdict(Network())})
            found.setdefault(network, []).append(race["found"])
    return found


def network_tables(section: dict[str, Any]) -> str:
    """Return the tables of the races over a network."""
    parts = [
        "## Over a network\n",
        f"{section['workers']} workers; primary pair with disparity; without a cache. The ratio is "
        "to ours from the local disk in the same round; that in brackets leaves the first batch "
        "out. Requests and bytes are the server's own count.\n",
    ]
    for workload in WORKLOADS:
        races = _by_network(section, workload)
        if not races:
            continue
        scenes = next(r["scenes"] for r in section["races"] if r["workload"] == workload.name)
        rows = [
            _row(network, rounds, name)
            for network, rounds in races.items()
            for name in (LOCAL, OURS, *RIVALS)
            if any(name in found for found in rounds)
        ]
        most = counted(max(map(len, races.values())), "round")
        first = f"{workload.title}, {scenes} scenes, {most}"
        head = (
            first, "contestant", "samples/s",
            "to local", "(after the first batch)", "first batch, s", "the same, delays more than "
            "local", "requests a sample", "MB a sample", "peak MB of a worker",
        )  # fmt: skip
        parts.append(table(head, rows))
    failed = [f"- {name}: {why}" for name, why in section["failed"].items()]
    if failed:
        parts.append("Did not race:\n" + "\n".join(failed) + "\n")
    return "\n".join([*parts, "![Speed over a network](network.png)\n"])


def _row(network: Network, rounds: _Rounds, name: str) -> list[str]:
    """Return the row of a contestant; ours from the local disk is compared with nothing."""
    delay_s = network.delay_s

    def cell(value: _Value) -> str:
        return rate_text(_spread(rounds, name, value))

    def compared(value: _Value, text: Callable[[Spread | None], str] = rate_text) -> str:
        return "" if name == LOCAL else text(_spread(rounds, name, value))

    return [
        _named(network), name, cell(lambda turn, _: _rate(turn)),
        compared(lambda turn, own: _rate(turn) / _rate(own), spread_text),
        compared(
            lambda turn, own: _later_rate(turn) / max(_later_rate(own), 1e-9), spread_text
        ),
        cell(lambda turn, _: turn["first_s"]),
        compared(lambda turn, own: (turn["first_s"] - own["first_s"]) / delay_s) if delay_s else "",
        compared(lambda turn, _: turn["requests"] / turn["samples"]),
        compared(lambda turn, _: turn["sent_mb"] / turn["samples"]),
        cell(lambda turn, _: turn["peak_mb"]),
    ]  # fmt: skip


_COLOURS: Final = {
    LOCAL: "#222222", OURS: "#0b6e99", "webdataset": "#b8b8b8", "HF datasets": "#c9a66b",
    "Mosaic Streaming": "#8fb08c",
}  # fmt: skip


def network_plot(section: dict[str, Any]) -> Any:
    """Return a figure: the speed of each contestant as a share of ours from the local disk."""
    import matplotlib.pyplot as plt

    shown = {each.title: found for each in WORKLOADS if (found := _by_network(section, each))}
    bars = {
        title: [
            (_named(network), name, spread)
            for network, rounds in races.items()
            for name in (OURS, *RIVALS)
            if (spread := _spread(rounds, name, lambda turn, own: _rate(turn) / _rate(own)))
        ]
        for title, races in shown.items()
    }
    inches = 0.6 + 0.26 * sum(map(len, bars.values()))
    figure, column = plt.subplots(
        len(shown), 1, squeeze=False, sharex=True, figsize=(8, inches),
        height_ratios=[len(found) + 2 for found in bars.values()], layout="constrained",
    )  # fmt: skip
    for axes, (title, found) in zip(column[:, 0], bars.items(), strict=True):
        places = range(len(found))
        medians = [spread.median for _, _, spread in found]
        axes.barh(
            places, medians, color=[_COLOURS[name] for _, name, _ in found],
            xerr=[
                [spread.median - spread.low for _, _, spread in found],
                [spread.high - spread.median for _, _, spread in found],
            ],
        )  # fmt: skip
        for place, median in zip(places, medians, strict=True):
            axes.annotate(f"{median:.2f}", (0.01, place), va="center", color="white", fontsize=8)
        axes.set_yticks(places, [f"{network}: {name}" for network, name, _ in found], fontsize=8)
        axes.invert_yaxis()
        axes.axvline(1, color=_COLOURS[LOCAL], linewidth=0.8)
        axes.set_title(title, fontsize=9)
    column[-1, 0].set_xlabel("samples a second, to ours from the local disk")
    return figure
