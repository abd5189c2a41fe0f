"""Pairs made where training runs: from six pictures and stored depths to every pair's maps.

A moment of six cameras is 30 bytes a pixel; its 15 pairs with disparity and masks are over 165.
`SceneViews` with the fields `DERIVE_FIELDS` gives the first, `derive` makes the second of it on any
device of torch. Numbers are those of `StereoPairs`: the formulas are the same functions of
`geometry`, in the same order, with cameras in float64.

Maps are (b, p, t, h, w) inside: moments, pairs, frames, rows, columns.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Final, Literal, NamedTuple

import torch

from stereogenbench_data.errors import FieldError, SelectionError
from stereogenbench_data.geometry.arrays import take_pixels
from stereogenbench_data.geometry.disparity import disparity_from_shifts, ray_per_planar
from stereogenbench_data.geometry.projection import front_pixels
from stereogenbench_data.samples.derive import ViewPairMaps, once

DERIVE_FIELDS: Final = (
    "image", "stored_depth", "depth_unit_m", "depth_offset_m", "no_depth", "depth_kind",
    "depth_form", "rig", "intrinsics", "baselines_m", "cams_from_cam", "camera",
)  # fmt: skip
"""The fields of `SceneViews` that `derive` takes; ``image`` only for fields that show pictures."""

PairPlaces = Literal["all"] | Sequence[tuple[int, int]]
"""The pairs to make: (first view, second view), as places on the axis of views."""

_CHUNK_PIXELS: Final = 2**19
"""How many pixels of pairs are made at a time on a processor, in whose cache they then stay. What
lies between steps takes up to 80 bytes each."""

_CHUNK_PIXELS_ELSEWHERE: Final = 2**22
"""The same on other devices, and in a compiled graph, whose size grows with the number of steps."""

_PICTURES: Final = frozenset({"left", "right", "warped_right"})


def derive(
    batch: Mapping[str, Any],
    *,
    fields: Iterable[str] = ("left", "right", "disparity", "valid", "baseline_m", "pair"),
    pairs: PairPlaces = "all",
    device: torch.device | str | None = None,
) -> dict[str, torch.Tensor]:
    """Return fields of stereo pairs, made of a batch of views with stored depth.

    Disparity is the float32 that `StereoPairs` gives or a neighbour of it, and masks are the same:
    a pixel may differ only where a rig goes through its poses and a point lies on the edge of a
    pixel, or two depths are just as far apart as is tolerated, to within the last bits of float64.
    Results do not depend on the device, nor from run to run: where points compete for a pixel, the
    largest of whole numbers wins. Nothing waits for the device. Autocast has no effect here, and
    torch.compile takes the function as a single graph; a batch of scenes of other contracts, or of
    posed among rectified rigs, is compiled anew.

    Args:
        batch: A batch of `SceneViews` with the fields `DERIVE_FIELDS`, of stills or clips.
        fields: Names of the fields to make, of `DERIVED_FIELDS`; they mean what they do in
            `PAIR_FIELDS`.
        pairs: "all" makes each pair of views once, the view that comes first as the left one; or
            (left, right) places on the batch's axis of views. With ``cameras="all"`` these are the
            numbers of the cameras.
        device: Where to move what is needed of the batch, and derive; None derives where it is.

    Returns:
        The fields by name, (B, P, ...) and in clips (B, P, T, ...), where P counts the pairs;
        ``intrinsics``, which all views share, (B, 3, 3).

    Raises:
        FieldError: If the batch lacks a field that is needed, or one that is asked for cannot be
            made.
        SelectionError: If a pair is not two different views of the batch.
    """
    names = (fields,) if isinstance(fields, str) else tuple(fields)
    unknown = [name for name in names if name not in DERIVED_FIELDS]
    if unknown or not names:
        raise FieldError(
            f"derive cannot make {unknown[0] if unknown else 'no field'!r}; it makes "
            f"{', '.join(DERIVED_FIELDS)}."
        )
    needed = [name for name in DERIVE_FIELDS if name != "image" or not _PICTURES.isdisjoint(names)]
    depth = _require_views(batch, needed)
    places = _require_pairs(pairs, views=depth.shape[1])
    where = depth.device if device is None else torch.device(device)
    # The meta device has no autocast to switch off.
    casts_on = "cpu" if where.type == "meta" else where.type
    with torch.no_grad(), torch.autocast(device_type=casts_on, enabled=False):
        moved = _moved(batch, needed, to=where)
        return _of_contracts(moved, names, places, contracts=_contracts(batch))


# torch.compile of torch 2.15 takes no comprehension within a `with` on Python 3.13.
def _moved(
    batch: Mapping[str, Any], needed: list[str], *, to: torch.device
) -> dict[str, torch.Tensor]:
    """Return the tensors that are needed, on a device."""
    return {
        name: batch[name].to(to, non_blocking=True)
        for name in needed
        if isinstance(batch[name], torch.Tensor)
    }


def _of_contracts(
    moved: Mapping[str, torch.Tensor],
    names: tuple[str, ...],
    places: list[tuple[int, int]],
    *,
    contracts: list[tuple["_Contract", list[int]]],
) -> dict[str, torch.Tensor]:
    """Return the fields of all moments, those of each contract together."""
    depth = moved["stored_depth"]
    made: dict[str, torch.Tensor] = {}
    for contract, rows in contracts:
        if len(rows) == len(depth):
            made = _derived(_Moments(moved, contract), names, places)
            break
        chosen = {name: torch.stack([v[row] for row in rows]) for name, v in moved.items()}
        for name, values in _derived(_Moments(chosen, contract), names, places).items():
            if name not in made:
                made[name] = values.new_empty((len(depth), *values.shape[1:]))
            for place, row in enumerate(rows):
                made[name][row] = values[place]
    if depth.ndim == 5:
        made = {name: v.squeeze(2) if v.ndim > 4 else v for name, v in made.items()}
    return made


def _require_views(batch: Mapping[str, Any], needed: list[str]) -> torch.Tensor:
    """Return the stored depth of a batch that has the fields that are needed, of pictures alike."""
    missing = [name for name in needed if name not in batch]
    if missing:
        raise FieldError(
            f"the batch has no {', '.join(missing)}: load it with "
            "SceneViews(..., fields=DERIVE_FIELDS)."
        )
    depth: torch.Tensor = batch["stored_depth"]
    if depth.dtype != torch.uint16 or depth.ndim not in (5, 6):
        raise FieldError(
            f"stored_depth is {depth.dtype} {tuple(depth.shape)}, not uint16 (B, V, 1, H, W) or, "
            "of clips, (B, V, T, 1, H, W): give derive a batch of stacked views."
        )
    expected = (*depth.shape[:-3], 3, *depth.shape[-2:])
    if "image" in needed and batch["image"].shape != expected:
        raise FieldError(
            f"image is {tuple(batch['image'].shape)}, and stored_depth {tuple(depth.shape)} is of "
            f"pictures {expected}: resize and crop by SceneViews(..., size=, transform=), which "
            "moves both and the cameras."
        )
    return depth


def _derived(
    moments: "_Moments", names: tuple[str, ...], places: list[tuple[int, int]]
) -> dict[str, torch.Tensor]:
    """Return fields of moments that have one contract, some pairs at a time."""
    count, _, frames, height_px, width_px = moments.units.shape
    chunk_pixels = _CHUNK_PIXELS_ELSEWHERE
    if moments.units.device.type == "cpu" and not torch.compiler.is_compiling():
        chunk_pixels = _CHUNK_PIXELS
    step = max(1, chunk_pixels // max(1, count * frames * height_px * width_px))
    made: dict[str, torch.Tensor] = {}
    for start in range(0, len(places), step):
        chunk = places[start : start + step]
        ahead = _Pairs(moments, chunk)
        back = _Pairs(moments, [(second, first) for first, second in chunk])
        for name in names:
            if name == "intrinsics":
                made[name] = moments.batch["intrinsics"]
                continue
            values = _MAKERS[name](ahead, back)
            if len(chunk) == len(places):
                made[name] = values
                continue
            if name not in made:
                made[name] = values.new_empty((count, len(places), *values.shape[2:]))
            made[name][:, start : start + len(chunk)] = values
    return made


class _Contract(NamedTuple):
    """What decides which formulas hold for a scene.

    Attributes:
        rig: "rectified" if disparity is the closed form, "posed" if points go through the poses.
        kind: "planar" or "ray" depth.
        form: Whether a stored number is proportional to "depth" or to its "inverse", or depth
            begins at an offset ("ranged").
    """

    rig: str
    kind: str
    form: str


_NO_SCENE: Final = _Contract("rectified", "planar", "depth")
"""What an empty batch is taken for: its maps are empty, of the same shapes by any contract."""


def _contracts(batch: Mapping[str, Any]) -> list[tuple[_Contract, list[int]]]:
    """Return the contracts of a batch's moments, and which have each. Texts: no device is asked."""
    names = ("rig", "depth_kind", "depth_form")
    texts = list(zip(*(batch[name] for name in names), strict=True))
    apart = [each for row, each in enumerate(texts) if each not in texts[:row]]
    return [
        (_Contract(*each), [row for row, other in enumerate(texts) if other == each])
        for each in apart or [_NO_SCENE]
    ]


def _require_pairs(pairs: PairPlaces, *, views: int) -> list[tuple[int, int]]:
    if isinstance(pairs, str):
        if pairs != "all":
            raise SelectionError(f"pairs must be 'all' or places of two views, got {pairs!r}.")
        return [(first, second) for first in range(views) for second in range(first + 1, views)]
    places = [(int(first), int(second)) for first, second in pairs]
    for first, second in places:
        if first == second or not (0 <= first < views and 0 <= second < views):
            raise SelectionError(
                f"pair {(first, second)} is not of two different views: the batch has {views}, "
                f"numbered from 0."
            )
    if not places:
        raise SelectionError("pairs must be at least one, got none.")
    return places


class _Moments:
    """A batch of views: maps (b, v, t, h, w), numbers of each view (b, v).

    Attributes:
        batch: Its fields.
        contract: What decides which formulas hold for them.
        units: Stored numbers, int32.
        measured: Where they mean a depth.
        made: What was made of them once.
    """

    def __init__(self, batch: Mapping[str, torch.Tensor], contract: _Contract) -> None:
        """Take the views of a batch; stills become clips of one frame."""
        self.batch, self.contract = dict(batch), contract
        self.made: dict[str, Any] = {}
        if batch["stored_depth"].ndim == 5:
            for name in {"stored_depth", "cams_from_cam", "image"} & batch.keys():
                self.batch[name] = batch[name].unsqueeze(2)
        # torch has few operations for uint16: its bits are read as int16, and the sign is dropped.
        stored = self.batch["stored_depth"].squeeze(-3).view(torch.int16)
        self.units = stored.to(torch.int32) & 0xFFFF
        self.measured = self.units != _per_map(batch["no_depth"])

    @once
    def stored(self) -> torch.Tensor:
        """Stored numbers as `disparity_from_shifts` takes them."""
        stored = self.units.to(torch.float64)
        is_inverse = self.contract.form == "inverse"
        return stored if is_inverse else torch.where(stored == 0, torch.inf, stored)

    @once
    def depth_m(self) -> torch.Tensor:
        """Depth along the optical axis, as `depth_m_from_units` gives it."""
        units, unit_m = self.units.to(torch.float64), _per_map(self.batch["depth_unit_m"])
        if self.contract.form == "depth":
            depth_m = (units * unit_m).to(torch.float32) * self.measured
        elif self.contract.form == "ranged":
            ranged_m = units * unit_m + _per_map(self.batch["depth_offset_m"])
            depth_m = ranged_m.to(torch.float32) * self.measured
        else:
            depth_m = torch.where(self.measured, (unit_m / units).to(torch.float32), 0.0)
        if self.contract.kind == "planar":
            return depth_m
        fx_px, fy_px, cx_px, cy_px = _lens(self.batch["intrinsics"][:, None, None, None, None])
        lengths: torch.Tensor = ray_per_planar(
            depth_m, focal_px=(fx_px, fy_px), centre_px=(cx_px, cy_px)
        )
        return depth_m / lengths


def _per_map(values: torch.Tensor) -> torch.Tensor:
    """Return numbers (b, p) such that they are broadcast to maps (b, p, t, h, w)."""
    return values[..., None, None, None]


def _taken(values: torch.Tensor, places: Sequence[int]) -> torch.Tensor:
    """Return (b, p, ...) of (b, v, ...): some views, by slices that no device waits for."""
    if len(places) == 1:
        return values[:, places[0] : places[0] + 1]
    return torch.stack([values[:, place] for place in places], dim=1)


class _Pairs(ViewPairMaps):
    """What follows from the depth of some source views for one target view each, (b, p, t, h, w).

    It does for tensors of many scenes what `PairGeometry` does for the arrays of one.
    """

    coarser = staticmethod(torch.maximum)

    def __init__(self, moments: _Moments, places: list[tuple[int, int]]) -> None:
        """Take all views, and the places of the sources and targets among them."""
        super().__init__()
        self._moments, self._batch, self._places = moments, moments.batch, places
        self._sources = [source for source, _ in places]
        self.is_rectified = moments.contract.rig == "rectified"
        self.is_inverse = moments.contract.form == "inverse"

    def broadcast_to_maps(self, numbers: torch.Tensor, *, like: torch.Tensor) -> torch.Tensor:
        """Return numbers (b, p) as they are broadcast to maps like these, in their dtype."""
        return _per_map(numbers).to(like.dtype)

    @once
    def measured(self) -> torch.Tensor:
        """Where the source's depth was measured."""
        return _taken(self._moments.measured, self._sources)

    @once
    def depth_m(self) -> torch.Tensor:
        """The source's depth along the optical axis."""
        return _taken(self._moments.depth_m, self._sources)

    @once
    def baseline_m(self) -> torch.Tensor:
        """(b, p) signed baselines."""
        baselines_m = self._batch["baselines_m"]
        return torch.stack([baselines_m[:, source, target] for source, target in self._places], 1)

    @once
    def shift_px_m(self) -> torch.Tensor:
        """(b, p) focal lengths in pixels times baselines."""
        return self._batch["intrinsics"][:, 0, 0, None] * self.baseline_m

    @once
    def unit_m(self) -> torch.Tensor:
        """(b, p) metres in a stored unit of the source."""
        return _taken(self._batch["depth_unit_m"], self._sources)

    @once
    def disparity(self) -> torch.Tensor:
        """Disparity in pixels, 0 where it is not known."""
        contract = self._moments.contract
        disparity: torch.Tensor
        if not self.is_rectified:
            disparity = self.moved_px.to(torch.float32)
            return disparity
        if contract.kind == "ray" or contract.form == "ranged":
            depth_m = torch.where(self.depth_m > 0, self.depth_m, torch.inf).to(torch.float64)
            return (_per_map(self.shift_px_m) / depth_m).to(torch.float32)
        disparity = disparity_from_shifts(
            _taken(self._moments.stored, self._sources),
            _per_map(self.shift_px_m / self.unit_m),
            form="inverse" if self.is_inverse else "depth",
        )
        return torch.where(self.measured, disparity, 0.0)

    @once
    def homography(self) -> tuple[torch.Tensor, torch.Tensor]:
        """(b, p, t, 3, 3) and (b, p, t, 3): what takes pixels and depth to the target."""
        cams_from_cam = self._batch["cams_from_cam"]
        target_from_source = torch.stack(
            [cams_from_cam[:, source, :, target] for source, target in self._places], dim=1
        )
        camera_matrix = self._batch["intrinsics"][:, None, None]
        homography = camera_matrix @ target_from_source[..., :3, :3] @ _inverse(camera_matrix)
        return homography, (camera_matrix @ target_from_source[..., :3, 3:])[..., 0]

    @once
    def picture(self) -> torch.Tensor:
        """The source's pictures (b, p, t, 3, h, w)."""
        return _taken(self._batch["image"], self._sources)

    @once
    def front(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Which source pixel is in front at each target pixel, and where none landed."""
        return front_pixels(self.projection, measured=self.measured)

    @property
    def warped(self) -> torch.Tensor:
        """The source's pictures in the target's view, 0 where no source pixel lands."""
        index, hole = self.front
        warped: torch.Tensor = take_pixels(self.picture, index) * ~hole.unsqueeze(-3)
        return warped

    @property
    def cameras(self) -> torch.Tensor:
        """(b, p, 2) numbers of the two cameras."""
        camera, targets = self._batch["camera"], [target for _, target in self._places]
        return torch.stack([_taken(camera, self._sources), _taken(camera, targets)], dim=-1)


def _lens(camera_matrix: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """Return focal lengths and principal points (fx, fy, cx, cy) of matrices (..., 3, 3)."""
    return tuple(camera_matrix[..., row, col] for row, col in ((0, 0), (1, 1), (0, 2), (1, 2)))


def _inverse(camera_matrix: torch.Tensor) -> torch.Tensor:
    """Return K^-1 of matrices K without skew."""
    fx_px, fy_px, cx_px, cy_px = _lens(camera_matrix)
    zero, one = torch.zeros_like(fx_px), torch.ones_like(fx_px)
    rows = [(1 / fx_px, zero, -cx_px / fx_px), (zero, 1 / fy_px, -cy_px / fy_px), (zero, zero, one)]
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


_MAKERS: Final[dict[str, Callable[[_Pairs, _Pairs], torch.Tensor]]] = {
    "left": lambda ahead, back: ahead.picture,
    "right": lambda ahead, back: back.picture,
    "disparity": lambda ahead, back: ahead.disparity.unsqueeze(-3),
    "valid": lambda ahead, back: ahead.known.unsqueeze(-3),
    "visible": lambda ahead, back: ahead.visible(back).unsqueeze(-3),
    "visible_from_left": lambda ahead, back: ahead.visible_from_source.unsqueeze(-3),
    "disparity_error": lambda ahead, back: ahead.disparity_error.unsqueeze(-3),
    "depth": lambda ahead, back: ahead.depth_m.unsqueeze(-3),
    "depth_right": lambda ahead, back: back.depth_m.unsqueeze(-3),
    "disparity_right": lambda ahead, back: 0 - back.disparity.unsqueeze(-3),
    "valid_right": lambda ahead, back: back.known.unsqueeze(-3),
    "visible_right": lambda ahead, back: back.visible(ahead).unsqueeze(-3),
    "warped_right": lambda ahead, back: ahead.warped,
    "hole": lambda ahead, back: ahead.front[1].unsqueeze(-3),
    "baseline_m": lambda ahead, back: ahead.baseline_m,
    "pair": lambda ahead, back: ahead.cameras,
}

DERIVED_FIELDS: Final = (*_MAKERS, "intrinsics")
"""The fields of `PAIR_FIELDS` that `derive` makes."""
