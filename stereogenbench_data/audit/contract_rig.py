"""What a scene's metadata leave open: the sensor's other side, the primary pair's other order."""

import math

from stereogenbench_data.audit.contract_diagnosis import LEAST_LOG_SCALE
from stereogenbench_data.audit.contract_scoring import Pair
from stereogenbench_data.schema.records import Rig, Scene


def focal_ratios(rig: Rig) -> dict[str, float]:
    """Return other readings of a rig's focal length, each over f / sensor width * width."""
    by_pixels = rig.image_height_px / rig.image_width_px
    by_sensor = rig.sensor_width_mm / rig.sensor_height_mm
    readings = {
        "f / sensor height * picture height": by_pixels * by_sensor,
        "f / sensor height * picture width": by_sensor,
        "f / sensor width * picture height": by_pixels,
    }
    told: dict[str, float] = {}
    for words, ratio in readings.items():
        if all(abs(math.log(ratio / other)) > LEAST_LOG_SCALE for other in (1.0, *told.values())):
            told[words] = ratio
    return told


def crossed_pair(scene: Scene) -> Pair | None:
    """Return the recorded primary pair if its cameras stand in the other order by the poses."""
    left, right = scene.rig.primary_pair
    return (left, right) if scene.lateral_m[left] > scene.lateral_m[right] else None
