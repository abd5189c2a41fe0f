"""Stereo generation: samples as GenStereo trains on them, and clips for video diffusion.

Pictures are float32 from -1 (black) to 1 (white). The warped view is the left picture splatted into
the right view by its disparity, nearest wins; it is -1 in holes, where the mask is 1.
"""

from collections.abc import Mapping
from typing import Any, Final, Literal, Unpack, get_args

import numpy as np
import torch
from PIL import Image

from stereogenbench_data.bridges.adapted import AdaptedPairs
from stereogenbench_data.datasets.mapped import PAIRS_DEFAULTS, Data, PairsOptions
from stereogenbench_data.errors import FieldError, SelectionError
from stereogenbench_data.geometry.projection import front_pixels, project_rectified
from stereogenbench_data.geometry.rig import RECTIFIED_PX
from stereogenbench_data.samples.fields import Sample
from stereogenbench_data.selection.signatures import list_options

Layout = Literal["tchw", "cthw"]
"""The order of a clip's axes: time, channel, height, width; or channel first."""

Captions = Literal["plain", "with baseline"]
"""Whether a caption tells the baseline, too."""

CLIP_SIZE_PX: Final = 224
CLIP_MEAN: Final = (0.48145466, 0.4578275, 0.40821073)
CLIP_STD: Final = (0.26862954, 0.26130258, 0.27577711)


class GenStereo(AdaptedPairs[dict[str, torch.Tensor]]):
    """Items of GenStereo's dataset: what its training loop reads of a batch.

    | key | | |
    |---|---|---|
    | ``source`` ``target`` | float32 (3, H, W) | the two pictures, -1 to 1 |
    | ``converted_right`` | float32 (3, H, W) | the source warped into the target's view |
    | ``mask`` | uint8 (1, H, W) | 1 in holes of ``converted_right``, else 0 |
    | ``correspondence`` | float32 (1, H, W) | disparity of the source, px; 0 where not known |
    | ``src_coords_embed`` | float32 (14, H, W) | embedded coordinates, 0, source |
    | ``trg_coords_embed`` | float32 (14, H, W) | the same warped: coordinates, mask, picture |
    | ``clip_images`` | float32 (3, 224, 224) | the source as CLIP's image encoder takes it |

    The project's random dropping of warped pixels is left to the loop. Its networks take square
    pictures: give ``size=(768, 768)``.

    Source: Qjizhi/GenStereo, genstereo/dataset/dataset_genstereo.py and train.py.
    """

    fields = ("left", "right", "disparity", "valid", "depth", "hole")

    @list_options(PAIRS_DEFAULTS)
    def __init__(self, data: Data, **options: Unpack[PairsOptions]) -> None:
        """Select the samples; no video is opened before the first item is asked for.

        Args:
            data: As for `StereoPairs`.
            **options: As for `StereoPairs`; ``frames`` are single frames.

        Raises:
            SelectionError: If nothing matches, samples are clips or sweeps, or a rig is not
                rectified: the item is warped along the rows.
            StereoGenBenchError: As `StereoPairs` does.
        """
        super().__init__(data, **options)
        index, rows = self.pairs.index, self.pairs.plan.scene_rows
        odd = rows[index.column("rig_residual_px")[rows] > RECTIFIED_PX]
        if len(odd):
            key, residual_px = (index.column(name)[odd[0]] for name in ("key", "rig_residual_px"))
            raise SelectionError(
                f"{index.where}: {len(odd)} selected scenes have rigs that are not rectified (the "
                f"first: {key}, off by {residual_px:.2g} px), and GenStereo's inputs are warped "
                f"along the rows. Leave them out by scenes=..., or take StereoClips or the field "
                f"warped_right, which are warped by the poses."
            )

    def item(self, sample: Sample) -> dict[str, torch.Tensor]:
        """Return the dict."""
        source, disparity = _from_minus_one(sample["left"]), sample["disparity"]
        coordinates = _embedded_coordinates(*disparity.shape[-2:])
        front, hole = front_pixels(
            project_rectified(sample["depth"][0].numpy(), disparity[0].numpy()),
            measured=sample["valid"][0].numpy(),
        )
        # Of rectified rigs the two differ in what a transform padded alone.
        is_hole = torch.from_numpy(hole) | sample["hole"][0]
        pixels = torch.from_numpy(front)
        warped_coordinates, warped = (
            torch.where(is_hole, empty, values.flatten(1)[:, pixels])
            for values, empty in ((coordinates, 0.0), (source, -1.0))
        )
        mask = is_hole.to(torch.uint8)[None]
        return {
            "source": source,
            "correspondence": disparity,
            "target": _from_minus_one(sample["right"]),
            "src_coords_embed": torch.cat([coordinates, torch.zeros_like(mask), source]),
            "trg_coords_embed": torch.cat([warped_coordinates, mask, warped]),
            "clip_images": _clip_picture(sample["left"]),
            "converted_right": warped,
            "mask": mask,
        }


class StereoClips(AdaptedPairs[dict[str, Any]]):
    """Clips of a pair with what conditions a video diffusion model, and their captions.

    | key | "tchw" | |
    |---|---|---|
    | ``source`` ``target`` | float32 (T, 3, H, W) | left and right view, -1 to 1 |
    | ``warped`` | float32 (T, 3, H, W) | the left view warped into the right one, -1 in holes |
    | ``mask`` | float32 (T, 1, H, W) | 1 in holes of ``warped``, else 0 |
    | ``correspondence`` | float32 (T, 1, H, W) | disparity of the left view, px; 0: not known |
    | ``caption`` | str | description of the scene; empty where there is none |
    | ``baseline_m`` | float64 () | |
    | ``frame_rate_hz`` | float64 () | frames of the clip a second |
    | ``__key__`` | str | scene, cameras and frames |

    With ``layout="cthw"`` the first two axes are exchanged: (3, T, H, W).
    """

    fields = (
        "left", "right", "warped_right", "hole", "disparity", "caption", "baseline_m",
        "frame_rate_hz", "__key__",
    )  # fmt: skip
    frames = "clip"

    @list_options(PAIRS_DEFAULTS)
    def __init__(
        self,
        data: Data,
        *,
        layout: Layout = "tchw",
        captions: Captions = "plain",
        **options: Unpack[PairsOptions],
    ) -> None:
        """Select the clips; no video is opened before the first item is asked for.

        Args:
            data: As for `StereoPairs`.
            layout: "tchw" for (T, 3, H, W), "cthw" for (3, T, H, W).
            captions: "plain", or "with baseline" for captions that tell it (`describe_pair`).
            **options: As for `StereoPairs`; ``frames`` are clips, such as ("clips", 81).

        Raises:
            SelectionError: If nothing matches, or samples are single frames or sweeps.
            FieldError: If there is no such layout, or no such form of captions.
            StereoGenBenchError: As `StereoPairs` does.
        """
        for name, value, known in (
            ("layout", layout, get_args(Layout)),
            ("captions", captions, get_args(Captions)),
        ):
            if value not in known:
                raise FieldError(f"{name} must be one of {known}, got {value!r}.")
        super().__init__(data, **options)
        self.layout, self.captions = layout, captions

    def item(self, sample: Sample) -> dict[str, Any]:
        """Return the dict."""
        clips: Mapping[str, torch.Tensor] = {
            "source": _from_minus_one(sample["left"]),
            "target": _from_minus_one(sample["right"]),
            "warped": _from_minus_one(sample["warped_right"]),
            "mask": sample["hole"].float(),
            "correspondence": sample["disparity"],
        }
        if self.layout == "cthw":
            clips = {name: clip.transpose(0, 1).contiguous() for name, clip in clips.items()}
        caption = sample["caption"]
        if self.captions == "with baseline":
            caption = describe_pair(caption, baseline_m=float(sample["baseline_m"]))
        rest = {name: sample[name] for name in ("baseline_m", "frame_rate_hz", "__key__")}
        return {**clips, "caption": caption, **rest}


def describe_pair(caption: str, *, baseline_m: float) -> str:
    """Return a caption that tells the baseline in centimetres.

    >>> describe_pair("A quiet street.", baseline_m=0.063)
    'A quiet street. Stereo baseline 6.3 cm.'
    """
    return f"{caption} Stereo baseline {baseline_m * 100:.1f} cm.".strip()


def _from_minus_one(pictures: torch.Tensor) -> torch.Tensor:
    """Return uint8 pictures as float32 from -1 to 1."""
    return (pictures.float() / 255 - 0.5) / 0.5


def _embedded_coordinates(height: int, width: int) -> torch.Tensor:
    """Return (10, h, w): x/w and y/h of each pixel, with their sines and cosines at 1 and 2 rad."""
    y, x = torch.meshgrid(torch.arange(height) / height, torch.arange(width) / width, indexing="ij")
    place = torch.stack([x, y])
    waves = [wave(place * rate) for rate in (1, 2) for wave in (torch.sin, torch.cos)]
    return torch.cat([place, *waves])


def _clip_picture(picture: torch.Tensor) -> torch.Tensor:
    """Return a (3, h, w) uint8 picture as CLIP takes it: its middle square, normalised.

    Source: CLIPImageProcessor of Hugging Face transformers, with its default settings.
    """
    pixels = np.ascontiguousarray(picture.permute(1, 2, 0).numpy())
    height, width = pixels.shape[:2]
    shorter = min(height, width)
    sides = [int(CLIP_SIZE_PX * side / shorter) for side in (width, height)]
    left, top = ((side - CLIP_SIZE_PX) // 2 for side in sides)
    small = Image.fromarray(pixels).resize((sides[0], sides[1]), Image.Resampling.BICUBIC)
    square = small.crop((left, top, left + CLIP_SIZE_PX, top + CLIP_SIZE_PX))
    values = torch.from_numpy(np.array(square)).permute(2, 0, 1).float() / 255
    mean, std = (torch.tensor(each)[:, None, None] for each in (CLIP_MEAN, CLIP_STD))
    return (values - mean) / std
