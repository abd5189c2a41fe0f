"""The paper's own figures, as data: what an audit and an index's statistics stand beside.

Source: "StereoGenBench: A Synthetic Multi-Camera Benchmark for Stereo Generation under Controlled
Baseline Regimes"; each table or paragraph is named where its figures are. Figures are kept as the
paper prints them, so that as many digits are compared as it prints.

The paper does not contradict itself in them, but for what its words leave open:

- its first table says that baselines are of 1-150 cm, which holds for adjacent cameras only:
  pairs of a Pairwise_Uniform rig reach 200 cm, and those of a Uniform rig may reach 750 cm;
- Pairwise_Uniform is meant for pairs of 10-200 cm, and 150 of its baselines are shorter;
- whether standard deviations divide by n or by n - 1 is not stated; ours divide by n, as those of
  the dataset's viewer do.
"""

from typing import Final

FRAMES_A_SCENE: Final = 81

AUDIT_TABLE: Final = "table of the geometry consistency audit"
AUDIT: Final = {
    "intrinsics": "0 px",
    "baseline": "6.68e-12 cm",
    "valid_depth": "94.59 %",
    "reprojection": "1.20e-06 px / 4.39e-03 px",
}
"""Maximum deviation of fx, fy; maximum deviation of pose-derived baselines; mean valid-depth ratio;
median and 95th percentile of the reprojection error of non-occluded pixels, of the primary pair
and of cameras 0 and 5."""

COUNTS_TABLE: Final = "table of scene counts by split and family"
SPLITS: Final = {"train": 7754, "eval": 739}

ADJACENT_TABLE: Final = "table of realized adjacent-baseline statistics"
ADJACENT: Final[dict[tuple[str, str], dict[str, str]]] = {
    ("train", "IPD_Gaussian"): {
        "count": "16445", "min": "4.5278", "max": "8.3867", "mean": "6.3813", "std": "0.4998",
    },
    ("train", "Uniform"): {
        "count": "3870", "min": "1.0113", "max": "149.8906", "mean": "52.7908", "std": "38.9500",
        "median": "43.2916",
    },
    ("train", "Pairwise_Uniform"): {
        "count": "18455", "min": "5.1117", "max": "123.2309", "mean": "38.6091", "std": "20.7742",
    },
    ("eval", "IPD_Gaussian"): {
        "count": "1780", "min": "4.7119", "max": "8.3332", "mean": "6.3743", "std": "0.5052",
    },
    ("eval", "Uniform"): {
        "count": "1915", "min": "1.0058", "max": "149.7889", "mean": "50.6741", "std": "39.1111",
        "median": "41.6438",
    },
}  # fmt: skip
"""Adjacent baselines in cm of each (split, family); the medians are from the appendix on realized
baseline distributions."""

ALL_PAIRS_TABLE: Final = "appendix on realized baseline distributions"
ALL_PAIRS: Final[dict[tuple[str, str], dict[str, str]]] = {
    ("train", "Pairwise_Uniform"): {
        "count": "55365", "min": "5.1117", "max": "199.9969", "mean": "97.7615", "std": "56.7814",
        "median": "93.3603",
    },
}  # fmt: skip
"""Baselines of all 15 pairs in cm."""

BINS_TABLE: Final = "table of baseline-stratified diagnostics (N_s)"
BINS: Final = {"[1,10)": 52, "[10,30)": 65, "[30,60)": 70, "[60,100)": 55, "[100,150]": 39}
"""Scenes of eval seen-map Uniform by the baseline of their primary pair in cm."""

FOCAL_MM: Final = (18.0, 85.0)
"""Between which focal lengths are drawn. Source: appendix on generation parameters."""

EVAL_MAPS_TABLE: Final = "table of evaluation scene counts per family and map"
EVAL_MAPS: Final[dict[str, tuple[str, int, int]]] = {
    "AssetsvilleTown": ("seen_map", 30, 31),
    "Car_Dealer": ("seen_map", 1, 2),
    "DeepWaterStation_DemoMapScalabilityEpic": ("unseen_map", 34, 45),
    "Downtown_West": ("seen_map", 21, 12),
    "GangnyeongieonComplex": ("seen_map", 99, 0),
    "GeunjeongjeonComplex": ("seen_map", 2, 52),
    "JapaneseStyleRoom": ("seen_map", 22, 0),
    "JesuhabComplex": ("seen_map", 0, 1),
    "Light_Foliage": ("seen_map", 13, 35),
    "Modular_Scifi_Mechanic_Base": ("seen_map", 2, 14),
    "OWD_Yucca_Pack": ("seen_map", 25, 0),
    "ProceduralNtr_vol2": ("seen_map", 23, 18),
    "RestaurantScene": ("seen_map", 2, 1),
    "ROCKY_SAND_PACK": ("seen_map", 0, 20),
    "STF_TestMap": ("unseen_map", 57, 57),
    "Scene_Bazaar_Vol1": ("seen_map", 0, 34),
    "Scene_Warehouse": ("seen_map", 0, 30),
    "Stylized_Egypt": ("seen_map", 0, 31),
    "UndergroundSciFi": ("seen_map", 25, 0),
}
"""Map to its subset and its scenes of IPD_Gaussian and Uniform."""

TRAIN_MAPS_TABLE: Final = "table of train scene counts per family and map"
TRAIN_MAPS: Final[dict[str, tuple[int, int, int]]] = {
    "AbandonedPowerPlant": (10, 27, 30),
    "AssetsvilleTown": (514, 7, 978),
    "Car_Dealer": (255, 39, 9),
    "Downtown_West": (62, 12, 120),
    "GangnyeongieonComplex": (801, 9, 309),
    "GeunjeongjeonComplex": (211, 180, 200),
    "JapaneseStyleRoom": (309, 39, 99),
    "JesuhabComplex": (0, 30, 479),
    "Light_Foliage": (18, 19, 0),
    "Modular_Scifi_Mechanic_Base": (523, 27, 132),
    "OWD_Yucca_Pack": (63, 40, 28),
    "ProceduralBuildingGenerator": (0, 58, 0),
    "ProceduralNtr_vol2": (83, 22, 517),
    "RestaurantScene": (125, 35, 25),
    "ROCKY_SAND_PACK": (83, 95, 0),
    "Scene_Bazaar_Vol1": (0, 5, 0),
    "Scene_Saloon": (12, 0, 0),
    "Scene_UnfinishedBuilding": (8, 2, 7),
    "Scene_Warehouse": (50, 7, 0),
    "SeyeonjeongPavilion": (0, 0, 698),
    "Stylized_Egypt": (0, 108, 30),
    "UndergroundSciFi": (121, 0, 30),
    "UtopianCity": (41, 13, 0),
}
"""Map to its scenes of IPD_Gaussian, Uniform and Pairwise_Uniform."""


def map_counts() -> dict[tuple[str, str, str], int]:
    """Return the scenes of each (split, family, map) that the paper's tables list."""
    counts = {
        ("train", family, name): count
        for name, row in TRAIN_MAPS.items()
        for family, count in zip(("IPD_Gaussian", "Uniform", "Pairwise_Uniform"), row, strict=True)
    }
    for name, (_, gaussian, uniform) in EVAL_MAPS.items():
        counts["eval", "IPD_Gaussian", name] = gaussian
        counts["eval", "Uniform", name] = uniform
    return {place: count for place, count in counts.items() if count}
