"""Partial results on disk, one file a scene, from which a killed evaluation resumes.

A folder belongs to one evaluation: its settings, its data and its right views. Anything else is
refused by the name of what differs.
"""

import hashlib
import json
import math
from collections.abc import Collection, Iterable, Iterator, Mapping
from io import BytesIO
from pathlib import Path
from typing import Any, Final

import numpy as np

from stereogenbench_data.errors import EvaluationError, StorageError, cure_of
from stereogenbench_data.evaluation.metrics.frechet import FeatureStatistics
from stereogenbench_data.evaluation.predictions import Pair, pair_name
from stereogenbench_data.evaluation.scene_scores import PairScores, SceneScores
from stereogenbench_data.sources.files import write_atomic

Stamps = Mapping[tuple[str, Pair], str]

STATE_JSON: Final = "evaluation.json"
_FORMAT: Final = 3
_SCENES: Final = "scenes"
_ODD: Final = {"inf": math.inf, "-inf": -math.inf, "nan": math.nan}


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
            if theirs is None:
                if any((folder / _SCENES).iterdir()):
                    raise EvaluationError(
                        f"{folder}: holds scenes without {STATE_JSON}, which tells what they are "
                        f"of. Remove the folder, or choose another."
                    )
                write_atomic(folder / STATE_JSON, json.dumps(ours, indent=1).encode())
        except OSError as error:
            raise StorageError(
                f"{folder}: partial results cannot be kept there ({error.strerror or error}). "
                + cure_of(error, "Choose another folder with --out.")
            ) from error
        if theirs is not None and theirs.get("format") != _FORMAT:
            raise EvaluationError(
                f"{folder}: holds partial results of format {theirs.get('format')}, written by "
                f"another version of this package, and this one writes format {_FORMAT}: SD by "
                f"two fits, each in a column of its own. Choose another folder with --out, or "
                f"remove this one."
            )
        if theirs is not None and theirs != ours:
            name, there, here = next(_differences(theirs, ours))
            raise EvaluationError(
                f"{folder}: holds results of another evaluation: {name} was {there} there and is "
                f"{here} now. Choose another folder with --out, or remove this one."
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
        document = {
            "scene": scene,
            "pairs": {
                _place_name(place): {
                    "stamp": stamps[place],
                    "fault": found.fault,
                    "columns": {
                        name: [
                            number if math.isfinite(number) else str(number) for number in numbers
                        ]
                        for name, numbers in found.columns.items()
                    },
                }
                for place, found in scores.items()
            },
        }
        arrays = {
            f"{_place_name(place)}/{whose}/{name}/{part}": getattr(each, part)
            for place, found in scores.items()
            for whose, statistics in (("predicted", found.predicted), ("target", found.target))
            for name, each in statistics.items()
            for part in ("count", "mean", "root")
        }
        path = self._path(scene)
        try:
            if arrays:
                packed = BytesIO()
                np.savez(packed, **arrays)
                write_atomic(path.with_suffix(".npz"), packed.getvalue())
            write_atomic(path, json.dumps(document, allow_nan=False).encode())
        except OSError as error:
            raise StorageError(
                f"{path}: the scores of {scene} cannot be written ({error.strerror or error}). "
                + cure_of(error, "Choose another folder with --out.")
            ) from error

    def is_done(self, scene: str, *, stamps: Stamps, columns: Collection[str]) -> bool:
        """Return whether a scene was scored with these right views.

        What had no usable right view then and has another now is to be scored again.

        Args:
            scene: The scene's key.
            stamps: What identifies the right views now.
            columns: The columns that scores have.

        Raises:
            EvaluationError: If right views that were scored have changed since, or the scores
                have other columns.
        """
        document = _read_json(self._path(scene))
        if document is None or document.get("scene") != scene:
            return False
        pairs = document["pairs"]
        if pairs.keys() != {_place_name(place) for place in stamps}:
            return False
        for place in stamps:
            self._require_columns(scene, place, pairs[_place_name(place)], columns)
        changed = [place for place in stamps if pairs[_place_name(place)]["stamp"] != stamps[place]]
        for place in changed:
            if not pairs[_place_name(place)]["fault"]:
                raise EvaluationError(
                    f"{self.folder}: holds scores of other right views of {scene}, cameras "
                    f"{pair_name(place[1])} ({place[0]}): they were changed since. Choose another "
                    f"folder with --out, or remove this one."
                )
        return not changed

    def faults(self, scene: str) -> list[str]:
        """Return why pairs of a scene that is done have no scores."""
        document = _read_json(self._path(scene)) or {"pairs": {}}
        return [entry["fault"] for entry in document["pairs"].values() if entry["fault"]]

    def read(self, scene: str, places: Iterable[tuple[str, Pair]]) -> SceneScores:
        """Return the scores of a scene that is done.

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
            place: _pair_scores(document["pairs"][_place_name(place)], arrays, _place_name(place))
            for place in places
        }

    def _require_columns(
        self,
        scene: str,
        place: tuple[str, Pair],
        entry: Mapping[str, Any],
        columns: Collection[str],
    ) -> None:
        """Refuse scores that another version of the package, or another protocol, has made."""
        odd = sorted(set(entry["columns"]) ^ set(columns))
        if odd and not entry["fault"]:
            raise EvaluationError(
                f"{self._path(scene)}: the scores of {scene}, cameras {pair_name(place[1])} "
                f"({place[0]}), have other columns than this evaluation: {', '.join(odd[:3])} "
                f"{'is' if len(odd) == 1 else 'are'} in one of the two alone. They were made by "
                f"another version or protocol: choose another folder with --out, or remove "
                f"{self.folder}."
            )

    def _path(self, scene: str) -> Path:
        digest = hashlib.sha256(scene.encode()).hexdigest()[:24]
        return self.folder / _SCENES / f"{digest}.json"


def _pair_scores(entry: Mapping[str, Any], arrays: Mapping[str, Any], place: str) -> PairScores:
    scores = PairScores(
        columns={
            name: [_ODD[each] if isinstance(each, str) else each for each in numbers]
            for name, numbers in entry["columns"].items()
        },
        fault=entry["fault"],
    )
    for whose, statistics in (("predicted", scores.predicted), ("target", scores.target)):
        start = f"{place}/{whose}/"
        for name in {
            key.removeprefix(start).rpartition("/")[0] for key in arrays if key.startswith(start)
        }:
            count, mean, root = (
                arrays[f"{start}{name}/{part}"] for part in ("count", "mean", "root")
            )
            statistics[name] = FeatureStatistics(int(count), mean, root)
    return scores


def _place_name(place: tuple[str, Pair]) -> str:
    return f"{place[0]}/{pair_name(place[1])}"


def _read_json(path: Path) -> Any:
    """Return a document; None if there is none, or if a kill cut it short."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except ValueError:
        return None
    return found if isinstance(found, dict) else None


def _differences(theirs: Any, ours: Any, name: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Yield the name of each leaf that differs, with both values."""
    if isinstance(theirs, dict) and isinstance(ours, dict):
        for key in sorted({*theirs, *ours}):
            inner = f"{name}.{key}" if name else key
            yield from _differences(theirs.get(key), ours.get(key), inner)
    elif theirs != ours:
        yield name, theirs, ours
