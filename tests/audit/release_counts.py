"""An index of 8,493 scenes with the statistics that the paper prints.

What the paper tells of a family's baselines (count, least, largest, mean, standard deviation,
median) fixes a list of numbers up to its shape; that shape is two power laws, found by scipy. Of
Pairwise_Uniform it tells them of all pairs, too: cameras there stand on no line.
"""

import numpy as np
from scipy.optimize import brentq, fsolve

from stereogenbench_data.schema.records import Member, Rig, Scene, SceneId, SceneLabels

FAMILIES = ("IPD_Gaussian", "Uniform", "Pairwise_Uniform")
TRAIN = """
AbandonedPowerPlant 10 27 30|AssetsvilleTown 514 7 978|Car_Dealer 255 39 9|Downtown_West 62 12 120|
GangnyeongieonComplex 801 9 309|GeunjeongjeonComplex 211 180 200|JapaneseStyleRoom 309 39 99|
JesuhabComplex 0 30 479|Light_Foliage 18 19 0|Modular_Scifi_Mechanic_Base 523 27 132|
OWD_Yucca_Pack 63 40 28|ProceduralBuildingGenerator 0 58 0|ProceduralNtr_vol2 83 22 517|
RestaurantScene 125 35 25|ROCKY_SAND_PACK 83 95 0|Scene_Bazaar_Vol1 0 5 0|Scene_Saloon 12 0 0|
Scene_UnfinishedBuilding 8 2 7|Scene_Warehouse 50 7 0|SeyeonjeongPavilion 0 0 698|
Stylized_Egypt 0 108 30|UndergroundSciFi 121 0 30|UtopianCity 41 13 0
"""
EVAL = """
AssetsvilleTown 30 31|Car_Dealer 1 2|Downtown_West 21 12|GangnyeongieonComplex 99 0|
GeunjeongjeonComplex 2 52|JapaneseStyleRoom 22 0|JesuhabComplex 0 1|Light_Foliage 13 35|
Modular_Scifi_Mechanic_Base 2 14|OWD_Yucca_Pack 25 0|ProceduralNtr_vol2 23 18|RestaurantScene 2 1|
ROCKY_SAND_PACK 0 20|Scene_Bazaar_Vol1 0 34|Scene_Warehouse 0 30|Stylized_Egypt 0 31|
UndergroundSciFi 25 0
"""
UNSEEN = "DeepWaterStation_DemoMapScalabilityEpic 34 45|STF_TestMap 57 57"
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


def paper_scenes():
    """Return the 8,493 scenes."""
    rng = np.random.default_rng(0)
    adjacent = {
        ("train", "IPD_Gaussian"): spread_out(16445, 4.5278, 8.3867, 6.3813, 0.4998, 6.3813),
        ("train", "Uniform"): spread_out(3870, 1.0113, 149.8906, 52.7908, 38.95, 43.2916),
        ("train", "Pairwise_Uniform"): spread_out(18455, 5.1117, 123.2309, 38.6091, 20.7742, 36.0),
        ("eval", "IPD_Gaussian"): spread_out(1780, 4.7119, 8.3332, 6.3743, 0.5052, 6.3743),
        ("eval", "Uniform"): spread_out(1915, 1.0058, 149.7889, 50.6741, 39.1111, 41.6438),
    }
    scenes = []
    for (split, family), values in adjacent.items():
        places = _places(split, family)
        rows = _in_rows(values, rng=rng)
        far = [gaps_between(gaps) for gaps in rows]
        if family == "Pairwise_Uniform":
            far = rng.permutation(apart(values)).reshape(-1, 10)
        scenes += [
            _scene(split, family, subset, name, number, rows[number], far[number])
            for number, (subset, name) in enumerate(places)
        ]  # fmt: skip
    return scenes


def _places(split, family):
    column = 1 + FAMILIES.index(family)
    tables = [(None, TRAIN)] if split == "train" else [("seen_map", EVAL), ("unseen_map", UNSEEN)]
    return [
        (subset, row.split()[0])
        for subset, table in tables
        for row in table.replace("\n", "").split("|")
        for _ in range(int(row.split()[column]))
    ]


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


def _scene(split, family, subset, name, number, gaps, far):
    baselines = np.empty(15)
    baselines[ADJACENT] = gaps
    baselines[OTHERS] = far
    folder = {None: "", "seen_map": "MapSeenInTrain/", "unseen_map": "MapUnseen/"}[subset]
    key = f"{split}/{folder}{family}/{name}/scene_{number:06d}"
    focal_mm = 18.0 + 67.0 * (number % 100) / 99
    return Scene(
        id=SceneId(key, split, subset, family, name),
        labels=SceneLabels(),
        caption="",
        rig=Rig(
            focal_mm=focal_mm, sensor_width_mm=23.76, sensor_height_mm=23.76,
            image_width_px=1280, image_height_px=1280, principal_point_px=None,
            baselines_cm=tuple(baselines.tolist()), primary_pair=(0, 1),
        ),
        frames=81,
        frame_rate_hz=15.0,
        lateral_m=(0.0,) * 6,
        rig_residual_px=0.0,
        depth_unit_m=(0.1,) * 6,
        depth_unit_source=("default",) * 6,
        depth_codec=("ffv1",) * 6,
        depth_pixel_format=("gray16le",) * 6,
        valid_depth_ratio=None,
        members={"baseline.json": Member(f"{key}/baseline.json", 0, 7070)},
    )  # fmt: skip
