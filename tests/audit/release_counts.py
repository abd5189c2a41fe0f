"""An index of 8,493 scenes with the statistics that the paper prints.

What the paper tells of a family's baselines (count, least, largest, mean, standard deviation,
median) fixes a list of numbers up to its shape; that shape is two power laws, found by scipy. Of
Pairwise_Uniform it tells them of all pairs, too: cameras there stand on no line.
"""

from dataclasses import replace

import numpy as np
from scipy.optimize import brentq, fsolve

from stereogenbench_data.audit.paper_numbers import paper_table
from stereogenbench_data.schema.records import Member, SceneId

ADJACENT = [0, 5, 9, 12, 14]
OTHERS = [place for place in range(15) if place not in ADJACENT]


def spread_out(count, least, largest, mean, std, median):
    """Return ascending numbers with exactly these statistics."""
    ranks = np.linspace(0, 1, count - count // 2)

    def numbers(shape):
        low = least + (median - least) * ranks ** np.exp(shape[0])
        high = median + (largest - median) * ranks ** np.exp(shape[1])
        return np.concatenate([low, high[count % 2 :]])

    def misses(shape):
        found = numbers(shape)
        return found.mean() - mean, found.std() - std

    shape, _, code, why = fsolve(misses, (0.0, 1.0), xtol=1e-13, full_output=True)
    assert code == 1, why
    return numbers(shape)


def apart(adjacent):
    """Return baselines that make Pairwise_Uniform's of all pairs of those of adjacent cameras."""
    count, mean, std, median = 55365, 97.7615, 56.7814, 93.3603
    others = count - len(adjacent)
    mean_of_others = (count * mean - adjacent.sum()) / others
    square = (count * (std**2 + mean**2) - (adjacent**2).sum()) / others
    rest = others, 10.0, 199.9969, mean_of_others, (square - mean_of_others**2) ** 0.5

    def misses(middle):
        return np.median(np.concatenate([adjacent, spread_out(*rest, middle)])) - median

    return spread_out(*rest, brentq(misses, 100.0, 110.0))


def paper_scenes(like):
    """Return the 8,493 scenes, in all that no table counts like another one."""
    rng = np.random.default_rng(0)
    scenes = []
    for row in paper_table("adjacent"):
        split, family = row["split"], row["family"]
        least, largest, mean, std = (float(row[name]) for name in ("min", "max", "mean", "std"))
        median = float(row["median"] or min(mean, 36.0))
        values = spread_out(int(row["count"]), least, largest, mean, std, median)
        rows = _in_rows(values, rng=rng)
        far = [gaps_between(gaps) for gaps in rows]
        if family == "Pairwise_Uniform":
            far = rng.permutation(apart(values)).reshape(-1, 10)
        places = [
            (each.get("subset"), each["map"])
            for each in paper_table(f"{split}_maps") for _ in range(int(each.get(family, 0)))
        ]  # fmt: skip
        scenes += [
            _scene(
                like, SceneId("", split, subset, family, name), number, rows[number], far[number]
            )
            for number, (subset, name) in enumerate(sorted(places, key=lambda each: each[0] or ""))
        ]
    return scenes


def _in_rows(values, *, rng):
    """Return five gaps a scene, of the primary pairs those of the paper's bins."""
    values = rng.permutation(values)
    if len(values) != 1915:
        return values.reshape(-1, 5)
    edges = {(1, 10): 52, (10, 30): 65, (30, 60): 70, (60, 100): 55, (100, 150.001): 39}
    first = np.concatenate(
        [np.flatnonzero((values >= low) & (values < high))[:n] for (low, high), n in edges.items()]
    )
    rest = np.setdiff1d(np.arange(1915), first)
    primary = np.concatenate([first, rest[:102]])
    return np.column_stack([values[primary], values[rest[102:]].reshape(-1, 4)])


def gaps_between(gaps):
    return [gaps[a:b].sum() for a in range(5) for b in range(a + 2, 6)]


def _scene(like, place, number, gaps, far):
    baselines = np.empty(15)
    baselines[ADJACENT] = gaps
    baselines[OTHERS] = far
    folder = {None: "", "seen_map": "MapSeenInTrain/", "unseen_map": "MapUnseen/"}[place.subset]
    key = f"{place.split}/{folder}{place.family}/{place.map_name}/scene_{number:06d}"
    focal_mm = 18.0 + 67.0 * (number % 100) / 99
    rig = replace(
        like.rig, focal_mm=focal_mm, image_width_px=1280, image_height_px=1280,
        baselines_cm=tuple(baselines.tolist()), primary_pair=(0, 1),
    )  # fmt: skip
    members = {"baseline.json": Member(f"{key}/baseline.json", 0, 7070)}
    return replace(like, id=replace(place, key=key), rig=rig, frames=81, members=members)
