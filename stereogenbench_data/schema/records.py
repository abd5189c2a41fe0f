"""The typed, frozen records that the rest of the package uses.

A record contains the values of a file, with units in the names and nothing derived.
"""

import itertools
import sys
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Final, Literal, get_args

from stereogenbench_data.errors import SchemaError, StorageError
from stereogenbench_data.schema.release import (
    CAMERA_PAIRS,
    PACKED_DEPTH_NAMES,
    VIDEO_FILES,
    Split,
    Subset,
)
from stereogenbench_data.schema.text import counted

DepthKind = Literal["planar", "ray"]
DepthForm = Literal["depth", "inverse"]
DepthRisk = Literal["8-bit", "9-bit", "10-bit", "12-bit", "14-bit", "lossy", "chroma"]
CHANNELS: Final = ("", *map("".join, itertools.permutations("rgb", 2)))
"""Which channels may hold the high and the low byte of depth."""
DepthUnitSource = Literal["tag", "metadata", "default", "conventions", "unreadable"]


@dataclass(frozen=True, slots=True)
class SceneId:
    """The identity of a scene. ``key`` is its whole path in the release, unique and stable.

    ``subset`` is None for train, and for an eval folder whose name does not tell the subset.
    """

    key: str
    split: Split
    subset: Subset | None
    family: str
    map_name: str


@dataclass(frozen=True, slots=True)
class Rig:
    """Six identical pinhole cameras on a lateral rig, from ``baseline.json``.

    ``principal_point_px`` is (x, y) in pixels of the recorded image, None for the image centre.
    ``baselines_cm`` has one entry per pair of `CAMERA_PAIRS`, in that order.
    ``image_size_source`` is "default" if the file records no image size. ``recorded_size_px`` is
    the (width, height) that the file is for, where the pictures are stored at another size:
    ``image_width_px`` and ``image_height_px`` are then those of the stored pictures.
    """

    focal_mm: float
    sensor_width_mm: float
    sensor_height_mm: float
    image_width_px: int
    image_height_px: int
    principal_point_px: tuple[float, float] | None
    baselines_cm: tuple[float, ...]
    primary_pair: tuple[int, int]
    image_size_source: Literal["recorded", "default"] = "recorded"
    recorded_size_px: tuple[int, int] | None = None

    def baseline_cm(self, camera_a: int, camera_b: int) -> float:
        """Return the recorded distance in cm between two cameras, in either order."""
        pair = (min(camera_a, camera_b), max(camera_a, camera_b))
        return self.baselines_cm[CAMERA_PAIRS.index(pair)]


@dataclass(frozen=True, slots=True)
class Remark:
    """Something in a scene's files that is odd, missing or not understood, and stops no sample.

    Attributes:
        about: What it concerns: a name of `REMARKS`.
        text: The place, what was found and, where there is one, the cure.
    """

    about: str
    text: str


REMARKS: Final = {
    "poses": "fields and rigs that need poses are refused, and the rig is assumed rectified",
    "world": "several readings of the poses fit the baselines, and fields that depend on the "
    "reading are refused",
    "principal point": "intrinsics are refused; for all else the image's centre is assumed",
    "left": "disparity, and all that needs poses, is refused: the rig is stated in two ways",
    "primary pair": "cameras are taken to be numbered from left to right",
    "pair": "the primary pair of baseline.json counts, where another file has another",
    "sensor": "the release's sensor is assumed, so the focal length in mm is not known",
    "videos": "pairs of cameras whose videos are missing are refused",
    "frames": "the frames that all videos have are used",
    "rate": "frames are matched by number, where videos have different rates",
    "depth": "depth is refused, unless you pass a DepthEncoding with its unit_m",
    "size": "the videos' picture size counts, where baseline.json has another",
    "stated": "the videos and baseline.json count, where files state otherwise",
    "lens": "a pinhole lens is assumed, where baseline.json states another model",
    "pixels": "disparity follows from the sensor's width, where pixels would not be square",
    "marker": "no scene has _scene_complete.json, so it is not known which were finished",
    "baselines": "baselines that are not recorded are sums of their neighbours",
    "unit": "baselines lie outside of the family's range",
    "labels": "labels that are not understood are left out",
    "caption": "captions that are not understood are left out; that of the JSON counts",
}
"""What a remark may be about, and what follows from it; of some, such as "lens" and "stated", only
rows of earlier versions have remarks."""


@dataclass(frozen=True, slots=True)
class SceneLabels:
    """The identifiers in ``baseline.json`` and ``_scene_complete.json``; None where absent."""

    scene_label: str | None = None
    scene_index: int | None = None
    map_name: str | None = None
    map_path: str | None = None
    character: str | None = None
    animation: str | None = None
    aperture_fstop: float | None = None


def _is_length(value: object, *, least: float) -> bool:
    return isinstance(value, int | float) and least <= value <= sys.float_info.max


@dataclass(frozen=True, slots=True)
class DepthEncoding:
    """The depth encoding: how a number stored in a depth video becomes metres.

    Attributes:
        unit_m: Metres in one stored unit. None means what the scene's files state, or the release's
            default of 0.1 m if they state nothing. With ``form="inverse"``, the depth in metres of
            the stored number 1: depth = unit_m / stored.
        channels: Of numbers of 16 bits in two channels of 8, the high byte's and the low byte's:
            "rg" is red and green. "" refuses such streams.
        offset_m: Depth in metres of the stored number 0, as a stream has it that was normalised to
            a range: depth = offset_m + unit_m * stored. It needs ``unit_m``.
        kind: "planar" is depth along the optical axis (z); "ray" is the distance from the
            camera's centre, turned into z by the intrinsics.
        form: "depth" or "inverse".
        frame_lag: A whole number: depth frame t + frame_lag belongs to RGB frame t. Where that
            frame does not exist, depth counts as not measured.
        no_depth: Stored numbers that mean "not measured"; "max" is the pixel format's largest.
        accept: Kinds of streams that are refused unless listed here: fewer than 16 bits ("8-bit",
            "9-bit", "10-bit", "12-bit", "14-bit"), "lossy" (a lossy codec) or "chroma" (only the
            luma plane is read).
        source: The origin of ``unit_m``: a tag of the file, JSON of the scene, the release's
            default, the data's conventions, or the user.

    Raises:
        SchemaError: If a value is out of range.

    Source: the paper's appendix on the file schema; without a tag, a unit is 0.1 m.
    """

    unit_m: float | None = None
    kind: DepthKind = "planar"
    form: DepthForm = "depth"
    frame_lag: int = 0
    no_depth: tuple[int | Literal["max"], ...] = (0, "max")
    accept: frozenset[DepthRisk] = frozenset()
    source: Literal["tag", "metadata", "default", "conventions", "user"] = "user"
    offset_m: float = 0.0
    channels: str = ""

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        kinds, forms = get_args(DepthKind), get_args(DepthForm)
        numbers = [number for number in self.no_depth if number != "max"]
        unit_m, unknown = self.unit_m, set(self.accept) - set(get_args(DepthRisk))
        for is_right, rule, value in (
            (unit_m is None or _is_length(unit_m, least=sys.float_info.min),
             "unit_m must be a positive number of metres", unit_m),
            (_is_length(self.offset_m, least=-sys.float_info.max),
             "offset_m must be a number of metres", self.offset_m),
            (type(self.frame_lag) is int, "frame_lag must be a whole number", self.frame_lag),
            (all(type(number) is int for number in numbers),
             "no_depth must contain whole numbers", self.no_depth),
            (self.kind in kinds, f"kind must be one of {kinds}", self.kind),
            (self.form in forms, f"form must be one of {forms}", self.form),
            (self.channels in CHANNELS, f"channels must be one of {CHANNELS}", self.channels),
            (not unknown, f"accept may hold {get_args(DepthRisk)}", sorted(unknown)),
        ):  # fmt: skip
            if not is_right:
                raise SchemaError(f"{rule}, got {value!r}.")
        if self.offset_m != 0 and (unit_m is None or self.form != "depth"):
            raise SchemaError(
                f"offset_m={self.offset_m!r} needs unit_m, the range over the stored numbers that "
                f'it has, and form="depth".'
            )
        object.__setattr__(self, "accept", frozenset(self.accept))  # a set has no hash

    @property
    def known_unit_m(self) -> float:
        """Metres in one stored unit.

        Raises:
            SchemaError: If ``unit_m`` is None, so that the file's tag decides.
        """
        if self.unit_m is None:
            raise SchemaError(
                "unit_m is None, so the unit depends on the file: take what "
                "`Scene.depth_encoding` returns, or set unit_m."
            )
        return self.unit_m


@dataclass(frozen=True, slots=True)
class Member:
    """The place of one of a scene's files: ``size`` bytes from ``offset`` of ``path``.

    ``path`` is relative to the data's root, with forward slashes. In a released folder each file
    has its own path and offset 0; in a shard all members have the shard's path. ``crc32`` is zlib's
    checksum of the bytes, known for packed files; None for released folders.
    """

    path: str
    offset: int
    size: int
    crc32: int | None = None


@dataclass(frozen=True, slots=True)
class ShardFacts:
    """A shard in an index: its size in bytes, its sha256 in hex, its number of members."""

    size: int
    sha256: str
    members: int


@dataclass(frozen=True, slots=True)
class TrainingFacts:
    """What training shards say of a scene: derived from what, how, and with what error.

    Attributes:
        source_digest: The digest of the index of the released data.
        quality: The name of the settings, such as "balanced".
        codec: FFmpeg's name of the codec of the pictures.
        settings: The encoder's settings, as JSON.
        psnr_db: Of each camera's pictures, the mean over frames of the PSNR against those that
            ``size=`` gives of the released video; nan for cameras that are not there.
        worst_psnr_db: The same of the worst frame.
    """

    source_digest: str
    quality: str
    codec: str
    settings: str
    psnr_db: tuple[float, ...]
    worst_psnr_db: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Scene:
    """One row of the index: everything that is needed before a video is opened.

    Attributes:
        lateral_m: The distance of each camera to the right of camera 0, in metres along camera
            0's x axis, from the poses.
        rig_residual_px: The largest distance between the closed form of a rectified rig and
            the pose chain, in pixels of the recorded image.
        depth_unit_m: Metres in a stored unit of each camera's depth, as stated or by default.
        depth_offset_m: Depth in metres of the stored number 0 of each camera.
        depth_unit_source: Where that stands: "tag", "metadata" (JSON), "conventions", "default"
            (nowhere), or "unreadable" (not understood, or contradictory: unit nan), per camera.
        depth_codec: FFmpeg's name of the codec of each camera's depth, or "blosc2" for depth
            packed by blosc2.
        depth_pixel_format: FFmpeg's name of the pixel format of each camera's depth.
        frames: The number of frames in every video and in the trajectory.
        key_frames: The frames, ascending from 0, at which the decoding of all cameras' pictures
            can begin.
        training: What is known of a scene of training shards; None for released scenes.
        remarks: What is odd in its files and stops no sample.
        pose_form: The names of the readings of its trajectory that the rig's geometry confirms,
            the chosen one first, joined by "|"; None for the one that the file itself names, and
            where poses are not understood.
        conventions: What conventions state about its files, as `Declaration.text` writes it; None
            where it was described without any.
        members: File name to the place of its bytes. Depth packed by blosc2 has a name of its own,
            which `held_name` returns.
        seek_tables: Where the packets of its videos lie, as `media.seek_table` packs it; None where
            that is not known. Scenes that differ in it alone are equal.
    """

    id: SceneId
    labels: SceneLabels
    caption: str
    rig: Rig
    frames: int
    frame_rate_hz: float
    lateral_m: tuple[float, ...]
    rig_residual_px: float
    depth_unit_m: tuple[float, ...]
    depth_unit_source: tuple[DepthUnitSource, ...]
    depth_codec: tuple[str, ...]
    depth_pixel_format: tuple[str, ...]
    valid_depth_ratio: float | None
    members: Mapping[str, Member] = field(hash=False)
    key_frames: tuple[int, ...] = (0,)
    training: TrainingFacts | None = None
    remarks: tuple[Remark, ...] = ()
    pose_form: str | None = None
    depth_offset_m: tuple[float, ...] = (0.0,) * 6
    conventions: str | None = None
    seek_tables: bytes | None = field(default=None, compare=False, repr=False)

    def depth_encoding(self, camera: int, contract: DepthEncoding | None = None) -> DepthEncoding:
        """Return how a camera's stored depth becomes metres: by a contract, else as files state.

        Its unit stays None where files do not tell it and the contract does not either.
        """
        contract = contract or DepthEncoding()
        source = self.depth_unit_source[camera]
        if source == "unreadable" or contract.unit_m is not None:
            return contract
        unit_m, offset_m = self.depth_unit_m[camera], self.depth_offset_m[camera]
        return replace(contract, unit_m=unit_m, offset_m=offset_m, source=source)

    def held_name(self, name: str) -> str:
        """Return the name in ``members`` of one of the release's files: depth may be packed."""
        return name if name in self.members else PACKED_DEPTH_NAMES.get(name, name)

    def member(self, name: str) -> Member:
        """Return the place of one of the release's files.

        Raises:
            StorageError: If the index lacks it: a download may contain only some cameras.
        """
        found = self.members.get(self.held_name(name))
        if found is None:
            there = ", ".join(self.held_videos) or "no video"
            reasons = self.remark("videos").split("; ")
            reason = next((f" ({each})" for each in reasons if f"{name}: " in each), "")
            raise StorageError(
                f"{self.id.key}: {name} is {'unusable' if reason else 'not in the data'}{reason}; "
                f"the scene has {there}. Select these or download the others too."
            )
        return found

    def remark(self, *about: str) -> str:
        """Return what is remarked about some things, "" where nothing is."""
        return " ".join(remark.text for remark in self.remarks if remark.about in about)

    @property
    def held_videos(self) -> tuple[str, ...]:
        """The names in ``members`` of the videos and packed depth files that the data have."""
        return tuple(name for name in map(self.held_name, VIDEO_FILES) if name in self.members)


def remarks_told(scenes: Iterable[Scene], about: Collection[str] = REMARKS.keys()) -> list[str]:
    """Return what follows from remarks about scenes, once for each kind, with the first of them."""
    texts: dict[str, list[str]] = {}
    for scene in scenes:
        for each in {remark.about for remark in scene.remarks}.intersection(about):
            texts.setdefault(each, []).append(scene.remark(each))
    return [
        f"{REMARKS[each]} ({counted(len(found), 'scene')}, such as {found[0]})"
        for each, found in sorted(texts.items())
    ]
