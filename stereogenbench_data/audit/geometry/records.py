"""The records of an audit, in types that JSON has: one row for each figure of a scene."""

import math
from collections.abc import Mapping
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
class ToleranceAudit:
    """Reprojection errors of one pair at one tolerance: how many, and their quantiles in px."""

    tolerance: str
    kept: int
    errors_px: tuple[float, ...]

    @property
    def median_px(self) -> float:
        """The median error, nan if no pixel was kept."""
        return self.errors_px[QUANTILES.index(0.5)] if self.errors_px else math.nan


@dataclass(frozen=True, slots=True)
class PairAudit:
    """Reprojection of one pair over the audited frames; counts are of pixels.

    ``comparable`` pixels land inside the right picture where depth was measured. Of these, nothing
    in the left view hides the ``unhidden`` ones; of these, the two depths agree at the ``agreeing``
    ones.
    """

    left: int
    right: int
    frames: int
    measured: int
    comparable: int
    unhidden: int
    agreeing: int
    tolerances: tuple[ToleranceAudit, ...]

    @property
    def agreement(self) -> float:
        """Share of the unhidden pixels whose depths agree, nan if there are no such pixels."""
        return self.agreeing / self.unhidden if self.unhidden else math.nan


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
        pairs = []
        for pair in record["pairs"]:
            tolerances = (
                ToleranceAudit(each["tolerance"], each["kept"], tuple(each["errors_px"]))
                for each in pair["tolerances"]
            )
            pairs.append(PairAudit(**{**pair, "tolerances": tuple(tolerances)}))
        figures = (
            Figure(**{**each, "value": math.nan if each["value"] is None else each["value"]})
            for each in record["figures"]
        )
        parts = {"audited_frames": record["audited_frames"], "figures": figures, "pairs": pairs}
        return cls(**{**record, **{name: tuple(part) for name, part in parts.items()}})


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
        seed: Seed of the random choice of scenes.
        limits: The limits beyond which a figure is a finding.
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
    seed: int
    limits: Mapping[str, float]
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
