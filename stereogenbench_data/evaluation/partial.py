"""Scores on disk, one file a scene, from which a stopped evaluation goes on.

    OUT/evaluation.json       all that scores depend on (`jobs`); other settings are refused
    OUT/scenes/<digest>.json  a scene's scores, with what identified its right views
    OUT/scenes/<digest>.npz   the statistics of its features, where a distance needs them

Scores of right views that were changed since are refused, by name.
"""

import hashlib
import json
import math
from collections.abc import Collection, Iterable, Mapping
from io import BytesIO
from pathlib import Path
from typing import Any, Final

import numpy as np

from stereogenbench_data.errors import EvaluationError, StorageError, explain_os_errors
from stereogenbench_data.evaluation.metrics.frechet import FeatureStatistics
from stereogenbench_data.evaluation.predictions import Pair, pair_name
from stereogenbench_data.evaluation.scene_scores import PairScores, SceneScores
from stereogenbench_data.jobs import JobKind, read_item
from stereogenbench_data.sources.files import write_atomic

Stamps = Mapping[tuple[str, Pair], str]

EVALUATION: Final = JobKind("scores", "evaluation.json", ".evaluation.lock", EvaluationError)
FORMAT: Final = 4
"""Of the files of scenes; other formats are refused."""
_SCENES: Final = "scenes"
_PARTS: Final = ("count", "mean", "root")


class PartialResults:
    """The scenes of one evaluation that are scored so far."""

    def __init__(self, folder: Path) -> None:
        """Take a folder that is held by `job_folder`."""
        self.folder = folder

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
                "stamp": stamps[place], "fault": found.problem, "views_sha256": found.views_sha256,
                "columns": columns,
            }  # fmt: skip
            for side, statistics in (("predicted", found.predicted), ("target", found.target)):
                for name, each in statistics.items():
                    for part in _PARTS:
                        arrays[f"{_place_name(place)}/{side}/{name}/{part}"] = getattr(each, part)
        path = self._path(scene)
        what = f"{path}: the scores of {scene} cannot be written"
        with explain_os_errors(what, "Choose another folder with --out."):
            path.parent.mkdir(exist_ok=True)
            if arrays:
                packed = BytesIO()
                np.savez(packed, **arrays)
                write_atomic(path.with_suffix(".npz"), packed.getvalue())
            text = json.dumps({"scene": scene, "pairs": pairs}, allow_nan=False)
            write_atomic(path, text.encode())

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
        document = read_item(path)
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
        document = read_item(path)
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
    scores = PairScores(columns, problem=entry["fault"], views_sha256=entry["views_sha256"])
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
