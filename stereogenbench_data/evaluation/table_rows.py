"""The rows of tables, those of the paper among them, and what to know when reading them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from stereogenbench_data.evaluation.aggregate import Cell
from stereogenbench_data.evaluation.columns import COLUMNS, FRAME_METRICS
from stereogenbench_data.evaluation.frechet import FrechetDistance
from stereogenbench_data.evaluation.protocol import PAPER_SIZE, EvaluationProtocol
from stereogenbench_data.evaluation.reference import TableName, reference_table
from stereogenbench_data.evaluation.results import Labels, Scores
from stereogenbench_data.evaluation.scale import SD_OF_THE_PAPER
from stereogenbench_data.schema.release import FRAME_COUNT

_SOURCES: Mapping[str, tuple[TableName, ...]] = {
    "branches": ("main", "unseen"),
    "bins_primary": ("bins",),
    "controls": ("controls",),
}


@dataclass(frozen=True, slots=True)
class Row:
    """One row: a method's scores of one group, or a row of the paper as printed.

    Attributes:
        method: The method's name.
        labels: The group's values of the table's keys.
        scenes: N_s, the scenes of the group that are scored; None where the paper has no number.
        frames: N_f, their frames.
        missing: How many pairs have no scores, because their right views are missing or unusable.
        cells: For each column of frames, its numbers; of a row of the paper none.
        distances: For each distance between sets, its value.
        printed: Of a row of the paper, its numbers as printed, by column.
    """

    method: str
    labels: Labels
    scenes: int | None
    frames: int | None
    missing: int = 0
    cells: Mapping[str, Cell] = field(default_factory=dict)
    distances: Mapping[str, FrechetDistance] = field(default_factory=dict)
    printed: Mapping[str, str] = field(default_factory=dict)

    @property
    def is_papers(self) -> bool:
        """Whether it is a row of the paper."""
        return bool(self.printed)


@dataclass(frozen=True, slots=True)
class Table:
    """One table.

    Attributes:
        name: A short name, for files.
        title: What it shows.
        keys: What groups are made by.
        protocol: How everything in it was scored.
        columns: Columns of frames, and distances.
        rows: Group by group.
        notes: What to know when reading it.
    """

    name: str
    title: str
    keys: tuple[str, ...]
    protocol: EvaluationProtocol
    columns: tuple[str, ...]
    rows: tuple[Row, ...]
    notes: tuple[str, ...] = ()


def paper_row(row: Mapping[str, str], labels: Labels) -> Row:
    """Return a row of one of the paper's tables, its numbers as printed."""
    printed = {}
    for name in (*FRAME_METRICS, "fid", "fvd"):
        value = row.get(name, "")
        if value:
            interval = row.get(f"{name}_ci95", "")
            headline = FRAME_METRICS.get(name, (name,))[0]
            printed[headline] = f"{value} ± {interval}" if interval else value
    return Row(
        method=f"{row.get('method') or row['control']} (paper)",
        labels=labels,
        scenes=int(row["n_scenes"]) if "n_scenes" in row else None,
        frames=int(row["n_frames"]) if "n_frames" in row else None,
        printed=printed,
    )


def notes_of(
    results: Sequence[Scores], rows: Sequence[Row], *, name: str, columns: Sequence[str]
) -> list[str]:
    """Return what to know when reading a table: sources, and what is not comparable."""
    protocol = results[0].protocol
    notes = []
    if any(COLUMNS[column].fit for column in columns if column in COLUMNS):
        notes.append(f"SD: {SD_OF_THE_PAPER}.")
    if any(row.is_papers for row in rows):
        sources = "; ".join(reference_table(each).source for each in _SOURCES[name])
        notes.append(f"Rows of the paper as printed: {sources}.")
        others = [
            protocol.label(column)
            for column in columns
            if any(column in row.printed for row in rows)
            and column in COLUMNS
            and not protocol.is_papers(column)
        ]
        if others:
            notes.append(
                f"† The paper measures this by DeDoDe (E_match) or FoundationStereo (SD), not by "
                f"what the head of the column names ({', '.join(others)}): not comparable."
            )
        if protocol.size != PAPER_SIZE:
            notes.append(
                f"The paper scores at {PAPER_SIZE[1]}x{PAPER_SIZE[0]}, this at "
                f"{protocol.size[1]}x{protocol.size[0]}: not comparable."
            )
        frames = {pair.frames for one in results for pair in one.pairs if not pair.fault}
        if frames - {FRAME_COUNT}:
            ours = ", ".join(map(str, sorted(frames)))
            notes.append(f"The paper scores {FRAME_COUNT} frames a scene, this {ours}.")
    if any(found.underdetermined for row in rows for found in row.distances.values()):
        notes.append(
            "! No more samples than dimensions: the distance is biased upwards, and more so the "
            "fewer samples there are."
        )
    return notes
