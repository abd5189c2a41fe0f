"""Partial results on disk, one file a scene, from which a killed evaluation resumes.

A folder belongs to one evaluation: its settings, its data and its right views. Results of others
are refused, naming what differs.
"""

import hashlib
import json
import math
from collections.abc import Collection, Iterable, Iterator, Mapping
from io import BytesIO
from pathlib import Path
from typing import Any, Final

import numpy as np

from stereogenbench_data.errors import EvaluationError, StorageError, describe_os_error
from stereogenbench_data.evaluation.metrics.frechet import FeatureStatistics
from stereogenbench_data.evaluation.predictions import Pair, pair_name
from stereogenbench_data.evaluation.scene_scores import PairScores, SceneScores
from stereogenbench_data.sources.files import write_atomic

Stamps = Mapping[tuple[str, Pair], str]

STATE_JSON: Final = "evaluation.json"
_FORMAT: Final = 3
_SCENES: Final = "scenes"
_PARTS: Final = ("count", "mean", "root")
_OTHER_OUT: Final = "Choose another folder with --out."


class PartialResults:
    """The scenes of one evaluation that are scored so far."""

    def __init__(self, folder: Path, *, settings: Mapping[str, Any]) -> None:
        """Start in a folder, or resume an evaluation of the same settings.

        Args:
            folder: Where partial results are kept; it is made where it is missing.
            settings: All that scores depend on, as plain values.

        Raises:
            EvaluationError: If the folder holds results of other settings, naming what differs.
            StorageError: If the folder cannot be read or written.
        """
        self.folder = folder
        ours = {"format": _FORMAT, **json.loads(json.dumps(settings))}
        try:
            (folder / _SCENES).mkdir(parents=True, exist_ok=True)
            theirs = _read_json(folder / STATE_JSON)
            if not any((folder / _SCENES).iterdir()):  # An evaluation may have failed at once.
                write_atomic(folder / STATE_JSON, json.dumps(ours, indent=1).encode())
                return
            if theirs is None:
                raise EvaluationError(
                    f"{folder}: holds scenes without {STATE_JSON}, which says what they "
                    f"belong to. Remove the folder, or choose another."
                )
        except OSError as error:
            what = f"{folder}: partial results cannot be kept there"
            raise StorageError(describe_os_error(what, error, _OTHER_OUT)) from error
        if theirs.get("format") != _FORMAT:
            raise EvaluationError(
                f"{folder}: holds partial results of format {theirs.get('format')}, written by "
                f"another version of this package, and this one writes format {_FORMAT}: SD by "
                f"two fits, each in a column of its own. Choose another folder with --out, or "
                f"remove this one."
            )
        if theirs != ours:
            name, there, here = next(_differences(theirs, ours))
            raise EvaluationError(
                f"{folder}: holds results of another evaluation: {name} was {_shown(there)} there "
                f"and is {_shown(here)} now. Choose another folder with --out, or remove this one."
            )

    def write(self, scene: str, scores: SceneScores, *, stamps: Stamps) -> None:
        """Keep the scores of a scene, whole or not at all.

        Args:
            scene: The scene's key.
            scores: Its scores by source and pair.
            stamps: What identified the right views when they were scored.

        Raises:
            StorageError: If they cannot be written.
        """
        pairs, arrays = {}, {}
        for place, found in scores.items():
            columns = {
                name: [number if math.isfinite(number) else str(number) for number in numbers]
                for name, numbers in found.columns.items()
            }
            pairs[_place_name(place)] = {
                "stamp": stamps[place], "fault": found.problem, "columns": columns
            }  # fmt: skip
            for side, statistics in (("predicted", found.predicted), ("target", found.target)):
                for name, each in statistics.items():
                    for part in _PARTS:
                        arrays[f"{_place_name(place)}/{side}/{name}/{part}"] = getattr(each, part)
        path = self._path(scene)
        try:
            if arrays:
                packed = BytesIO()
                np.savez(packed, **arrays)
                write_atomic(path.with_suffix(".npz"), packed.getvalue())
            text = json.dumps({"scene": scene, "pairs": pairs}, allow_nan=False)
            write_atomic(path, text.encode())
        except OSError as error:
            what = f"{path}: the scores of {scene} cannot be written"
            raise StorageError(describe_os_error(what, error, _OTHER_OUT)) from error

    def problems(self, scene: str, *, stamps: Stamps, columns: Collection[str]) -> list[str] | None:
        """Return why pairs of a scene have no scores, if it was scored with these right views.

        Args:
            scene: The scene's key.
            stamps: What identifies the right views now.
            columns: The columns that scores have.

        Returns:
            None if the scene is to be scored: it was not, or a right view that was missing or
            unusable has changed since.

        Raises:
            EvaluationError: If right views that were scored have changed since, or the scores
                have other columns.
        """
        path = self._path(scene)
        document = _read_json(path)
        if document is None or document.get("scene") != scene:
            return None
        pairs = document["pairs"]
        if pairs.keys() != {_place_name(place) for place in stamps}:
            return None
        entries = {place: pairs[_place_name(place)] for place in stamps}
        for (source, pair), entry in entries.items():
            odd = sorted(set(entry["columns"]) ^ set(columns))
            if odd and not entry["fault"]:
                raise EvaluationError(
                    f"{path}: the scores of {scene}, cameras {pair_name(pair)} ({source}), have "
                    f"other columns than this evaluation: {', '.join(odd[:3])} "
                    f"{'is' if len(odd) == 1 else 'are'} in one of the two alone. They were made "
                    f"by another version or protocol: choose another folder with --out, or remove "
                    f"{self.folder}."
                )
        changed = {
            place: entry for place, entry in entries.items() if entry["stamp"] != stamps[place]
        }
        for (source, pair), entry in changed.items():
            if not entry["fault"]:
                raise EvaluationError(
                    f"{self.folder}: holds scores of other right views of {scene}, cameras "
                    f"{pair_name(pair)} ({source}): they were changed since. Choose another "
                    f"folder with --out, or remove this one."
                )
        return None if changed else [each["fault"] for each in pairs.values() if each["fault"]]

    def read(self, scene: str, places: Iterable[tuple[str, Pair]]) -> SceneScores:
        """Return the scores of a scene that was scored.

        Raises:
            StorageError: If they cannot be read.
        """
        path = self._path(scene)
        document = _read_json(path)
        if document is None:
            raise StorageError(f"{path}: the scores of {scene} are gone. Run the evaluation again.")
        arrays: dict[str, Any] = {}
        if path.with_suffix(".npz").exists():
            with np.load(path.with_suffix(".npz"), allow_pickle=False) as packed:
                arrays = dict(packed)
        return {
            place: _pair_scores(document["pairs"], arrays, _place_name(place)) for place in places
        }

    def _path(self, scene: str) -> Path:
        digest = hashlib.sha256(scene.encode()).hexdigest()[:24]
        return self.folder / _SCENES / f"{digest}.json"


def _pair_scores(pairs: Mapping[str, Any], arrays: Mapping[str, Any], place: str) -> PairScores:
    entry = pairs[place]
    columns = {name: list(map(float, numbers)) for name, numbers in entry["columns"].items()}
    scores = PairScores(columns, problem=entry["fault"])
    for side, statistics in (("predicted", scores.predicted), ("target", scores.target)):
        start = f"{place}/{side}/"
        for key in arrays:
            if key.startswith(start) and key.endswith("/count"):
                name = key.removeprefix(start).removesuffix("/count")
                count, mean, root = (arrays[f"{start}{name}/{part}"] for part in _PARTS)
                statistics[name] = FeatureStatistics(int(count), mean, root)
    return scores


def _place_name(place: tuple[str, Pair]) -> str:
    return f"{place[0]}/{pair_name(place[1])}"


def _read_json(path: Path) -> Any:
    """Return a document; None if there is none, or if a kill cut it short."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (FileNotFoundError, ValueError):
        return None
    return found if isinstance(found, dict) else None


def _shown(value: Any) -> str:
    """Return a setting for a message."""
    if value is None:
        return "not set"
    return "set" if isinstance(value, dict) else str(value)


def _differences(theirs: Any, ours: Any, name: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Yield the name of each leaf that differs, with both values."""
    if isinstance(theirs, dict) and isinstance(ours, dict):
        for key in sorted({*theirs, *ours}):
            inner = f"{name}.{key}" if name else key
            yield from _differences(theirs.get(key), ours.get(key), inner)
    elif theirs != ours:
        yield name, theirs, ours
