"""The records of an audit, in types that JSON has: one row for each figure of a scene."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

QUANTILES: Final = tuple(step / 40 for step in range(41))
"""The quantiles of each scene's errors that are kept: 0, 2.5 %, 5 % ... 100 %."""


@dataclass(frozen=True, slots=True)
class Figure:
    """One measured figure of a scene.

    Attributes:
        quantity: Its name in `checks.CHECKS`.
        member: The file that it is about; empty for the whole scene.
        value: The figure, nan if the scene's content does not allow the check.
        where: Where in the file it was found; for nan, why it was not measured. A figure that is
            nan without a reason was not looked for.
    """

    quantity: str
    member: str = ""
    value: float = math.nan
    where: str = ""


@dataclass(frozen=True, slots=True)
class PairAudit:
    """Reprojection of one pair over the audited frames.

    Attributes:
        comparable: Pixels that land inside the right picture where depth was measured.
        unhidden: Those of them that nothing in the left view hides.
        agreeing: Those of the unhidden ones whose two depths agree.
        kept: For each of `reprojection.TOLERANCES`, the pixels kept.
        errors_px: For each of them the `QUANTILES` of the errors; empty if no pixel was kept.
    """

    comparable: int
    unhidden: int
    agreeing: int
    kept: Sequence[int]
    errors_px: Sequence[Sequence[float]]

    @property
    def agreement(self) -> float:
        """Share of the unhidden pixels whose depths agree, nan if there are no such pixels."""
        return self.agreeing / self.unhidden if self.unhidden else math.nan

    def median_px(self, tolerance: int) -> float:
        """Return the median error at a tolerance, by its place; nan if no pixel was kept."""
        errors_px = self.errors_px[tolerance]
        return errors_px[QUANTILES.index(0.5)] if errors_px else math.nan


@dataclass(frozen=True, slots=True)
class SceneAudit:
    """The audit of one scene.

    Attributes:
        key: The scene's key.
        frames: Number of frames by the index.
        audited_frames: The frames that were decoded.
        figures: What was measured of its metadata, its files and how they fit together.
        pairs: Reprojection of the primary pair and of cameras 0 and 5.
        problems: Maps files that could not be read to the reason.
    """

    key: str
    frames: int
    audited_frames: tuple[int, ...]
    figures: tuple[Figure, ...]
    pairs: tuple[PairAudit, ...]
    problems: Mapping[str, str]

    @classmethod
    def revived(cls, record: Mapping[str, Any]) -> "SceneAudit":
        """Return the audit that `plain` made a record of.

        Raises:
            TypeError: If a field is missing or unknown.
        """
        figures = (
            Figure(**{**each, "value": math.nan if each["value"] is None else each["value"]})
            for each in record["figures"]
        )
        pairs = (PairAudit(**each) for each in record["pairs"])
        frames = tuple(record["audited_frames"])
        parts = {"figures": tuple(figures), "pairs": tuple(pairs), "audited_frames": frames}
        return cls(**{**record, **parts})


@dataclass(frozen=True, slots=True)
class Finding:
    """A figure beyond its limit, a file that cannot be read, or a check that was not testable.

    Attributes:
        scene: The scene's key.
        member: The file; empty for none.
        check: The check.
        found: What was found, or why the scene's content does not allow the check.
    """

    scene: str
    member: str
    check: str
    found: str

    def __str__(self) -> str:
        """Return it as one line."""
        where = "/".join(part for part in (self.scene, self.member) if part)
        found = " ".join(self.found.split())
        return f"{where}: {self.check}: {found}"


@dataclass(frozen=True, slots=True)
class AuditRow:
    """A row of the audit's table."""

    check: str
    quantity: str
    ours: str
    paper: str = ""
    limit: str = ""


@dataclass(frozen=True, slots=True)
class AuditReport:
    """The audit of a data set.

    Attributes:
        root: Where the data are.
        scenes_there: Number of scenes of the index.
        scenes_audited: How many of them were audited.
        frames: Number of frames audited of each scene; 0 for all.
        rows: The table.
        findings: The findings, in the order of scenes.
        untested: Checks that the content of a scene does not allow.
        notes: Remarks that are not findings.
        scenes: Each scene's figures.
    """

    root: str
    scenes_there: int
    scenes_audited: int
    frames: int
    rows: tuple[AuditRow, ...]
    findings: tuple[Finding, ...]
    untested: tuple[Finding, ...]
    notes: tuple[str, ...]
    scenes: tuple[SceneAudit, ...]

    def to_json(self) -> dict[str, Any]:
        """Return the report as values for `json.dumps`, with None for nan."""
        document: dict[str, Any] = plain(asdict(self))
        return document


def plain(value: Any) -> Any:
    """Return a value as JSON has it, with None in place of every nan and infinity in it."""
    if isinstance(value, dict):
        return {str(key): plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple | frozenset):
        return [plain(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
