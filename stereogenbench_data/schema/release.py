"""The fixed names and numbers of the release: cameras, files, folders, families, maps, bins.

Source: the StereoGenBench paper, section 3 and its appendices on the file schema, the per-map
counts and the baseline bins.
"""

import itertools
import math
import re
from typing import Final, Literal

Split = Literal["train", "eval"]
Subset = Literal["seen_map", "unseen_map"]

CAMERA_COUNT: Final = 6
CAMERA_PAIRS: Final[tuple[tuple[int, int], ...]] = tuple(
    itertools.combinations(range(CAMERA_COUNT), 2)
)
"""The 15 pairs (left, right) with left < right, in the order of all lists of baselines."""

ADJACENT_PAIRS: Final = tuple((left, left + 1) for left in range(CAMERA_COUNT - 1))

FRAME_COUNT: Final = 81
FRAME_RATE_HZ: Final = 15.0
IMAGE_SIZE_PX: Final = 1280
DEFAULT_DEPTH_UNIT_M: Final = 0.1

ADJACENT_CM: Final = {
    "IPD_Gaussian": (4.5, 8.5),
    "Uniform": (1.0, 150.0),
    "Pairwise_Uniform": (5.0, 200.0),
}
"""Between what the baselines of neighbours lie in each family."""

SENSOR_MM: Final = 23.76
"""Width and height of the sensor of every scene that the public viewer shows."""

FAMILIES: Final = ("IPD_Gaussian", "Uniform", "Pairwise_Uniform")

BASELINE_JSON: Final = "baseline.json"
TRAJECTORY_JSON: Final = "trajectory.json"
COMPLETE_JSON: Final = "_scene_complete.json"
DESCRIPTION_JSON: Final = "scene_description_qwen_dataset_level.json"
DESCRIPTION_TXT: Final = "scene_description_qwen_dataset_level.txt"
TRAINING_JSON: Final = "training.json"
"""What this package adds to the metadata of scenes that it derives for training."""
METADATA_FILES: Final = (
    BASELINE_JSON,
    TRAJECTORY_JSON,
    COMPLETE_JSON,
    DESCRIPTION_JSON,
    DESCRIPTION_TXT,
)

SEEN_MAP_FOLDER: Final = "MapSeenInTrain"
_UNSEEN_MAP_FOLDER: Final = re.compile(r"unseen|not_?seen", re.IGNORECASE)
_SEEN: Final = re.compile("seen", re.IGNORECASE)

TRAIN_MAPS: Final = frozenset(
    {"AbandonedPowerPlant", "AssetsvilleTown", "Car_Dealer", "Downtown_West",
     "GangnyeongieonComplex", "GeunjeongjeonComplex", "JapaneseStyleRoom", "JesuhabComplex",
     "Light_Foliage", "Modular_Scifi_Mechanic_Base", "OWD_Yucca_Pack",
     "ProceduralBuildingGenerator", "ProceduralNtr_vol2", "RestaurantScene", "ROCKY_SAND_PACK",
     "Scene_Bazaar_Vol1", "Scene_Saloon", "Scene_UnfinishedBuilding", "Scene_Warehouse",
     "SeyeonjeongPavilion", "Stylized_Egypt", "UndergroundSciFi", "UtopianCity"}
)  # fmt: skip
UNSEEN_MAPS: Final = frozenset({"DeepWaterStation_DemoMapScalabilityEpic", "STF_TestMap"})

SCENE_COUNTS: Final[dict[tuple[str, str, str], int]] = {
    ("train", "", "IPD_Gaussian"): 3289,
    ("train", "", "Uniform"): 774,
    ("train", "", "Pairwise_Uniform"): 3691,
    ("eval", "seen_map", "IPD_Gaussian"): 265,
    ("eval", "seen_map", "Uniform"): 281,
    ("eval", "unseen_map", "IPD_Gaussian"): 91,
    ("eval", "unseen_map", "Uniform"): 102,
}
"""Scenes of the release in each (split, subset, family); the subset of train is empty."""

BASELINE_BINS: Final[dict[str, tuple[float, float]]] = {
    "[0,1)": (0.0, 1.0),
    "[1,10)": (1.0, 10.0),
    "[10,30)": (10.0, 30.0),
    "[30,60)": (30.0, 60.0),
    "[60,100)": (60.0, 100.0),
    "[100,150]": (100.0, 150.0),
    "(150,inf)": (150.0, math.inf),
}
"""Baseline bins in cm. The five in the middle are the paper's. The outer two are for the baselines
beyond them: all pairs of a Pairwise_Uniform rig reach 200 cm, those of a Uniform rig 750 cm. Bins
are half-open, except that 150 cm belongs to the paper's last bin."""


def rgb_name(camera: int) -> str:
    """Return the file name of a camera's RGB video: ``cam_00_rgb.mp4`` for camera 0."""
    return f"cam_{camera:02d}_rgb.mp4"


def depth_name(camera: int) -> str:
    """Return the file name of a camera's depth video: ``cam_00_depth.mkv`` for camera 0."""
    return f"cam_{camera:02d}_depth.mkv"


VIDEO_FILES: Final = tuple(
    name(camera) for name in (rgb_name, depth_name) for camera in range(CAMERA_COUNT)
)
PACKED_DEPTH_NAMES: Final = {
    depth_name(camera): f"cam_{camera:02d}_depth.b2frame" for camera in range(CAMERA_COUNT)
}
"""Released name of a camera's depth to its name in shards where blosc2 packed it."""
RELEASED_NAMES: Final = {packed: name for name, packed in PACKED_DEPTH_NAMES.items()}


def baseline_bin(baseline_cm: float) -> str:
    """Return the name of the bin of a baseline in cm.

    >>> baseline_bin(9.99), baseline_bin(10.0), baseline_bin(150.0), baseline_bin(150.1)
    ('[1,10)', '[10,30)', '[100,150]', '(150,inf)')
    """
    if baseline_cm == 150.0:
        return "[100,150]"
    return next(name for name, (low, high) in BASELINE_BINS.items() if low <= baseline_cm < high)


def subset_of_folder(folder: str) -> Subset | None:
    """Return the subset of a folder under ``eval/``, None if its name does not tell."""
    if _UNSEEN_MAP_FOLDER.search(folder):
        return "unseen_map"
    return "seen_map" if _SEEN.search(folder) else None
