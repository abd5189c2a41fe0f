"""`python -m benchmarks.codecs SCENES...`: which codec training shards should use.

Each way of storing pictures and depth at training size is encoded, decoded and compared: processor
time a frame (in order, and one random frame), bytes a frame, PSNR and SSIM of the pictures, and
what the loss does to stereo: the photometric error of warping by the true disparity, and the
end-point error of semi-global matching. Depth is always lossless: only time and bytes are compared.

Middlebury pairs (``--middlebury FOLDER``) are stills: they tell what a codec does to real textures,
not what it gains from frame to frame.
"""

import argparse
import io
import json
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any, Final

import av
import cv2
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from PIL import Image
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from benchmarks.results import machine
from stereogenbench_data import StereoPairs
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.media.depth import open_depth, read_depth_units, resized_nearest
from stereogenbench_data.media.depth_frames import blosc2_module
from stereogenbench_data.media.picture_encoding import QUALITIES, write_pictures
from stereogenbench_data.media.video import VideoReader, read_rgb
from stereogenbench_data.samples.size import parse_size
from stereogenbench_data.schema.records import DepthEncoding, Scene

FRAMES: Final = 24
"""Frames of a scene that are encoded: several groups of pictures of the longest kind."""

MATCHED: Final = 4
"""Of how many frames the stereo errors are measured: matching takes a second a pair."""


@dataclass(frozen=True, slots=True)
class Pictures:
    """What is encoded: the left and right pictures of a pair at training size.

    Attributes:
        name: What tables call it.
        left: (t, h, w, 3) uint8.
        right: (t, h, w, 3) uint8.
        disparity_px: (t, h, w) float32, of the left pictures.
        valid: (t, h, w) bool, where it is known and the right camera sees the point.
        released_ms: Processor time a frame to decode and scale the released video; nan of stills.
        released_random_ms: The same of one random frame, opened anew.
        released_bytes: Bytes a frame of the released video.
    """

    name: str
    left: np.ndarray
    right: np.ndarray
    disparity_px: np.ndarray
    valid: np.ndarray
    released_ms: float = float("nan")
    released_random_ms: float = float("nan")
    released_bytes: float = float("nan")


@dataclass(frozen=True, slots=True)
class Codec:
    """A way to store pictures: a video encoder with options, or JPEG files one after another."""

    name: str
    encoder: str
    pixel_format: str
    options: dict[str, str] = field(default_factory=dict)
    gop: int = 1


def codecs() -> Iterator[Codec]:
    """Yield what is compared: the qualities of training shards, and ways beside them."""
    for quality in QUALITIES:
        yield Codec(f"quality {quality}", "quality", "", {"quality": quality})
    for gop in (1, 2, 8, 16):
        for rate in (10, 14, 18, 23, 28):
            for tune in ("fastdecode", "") if gop == 8 else ("fastdecode",):
                options = {"crf": str(rate), "preset": "medium"}
                name = f"H.264 key {gop} crf {rate}"
                if tune:
                    options["tune"], name = tune, name + " fast"
                yield Codec(name, "libx264", "yuv420p", options, gop)
    for rate in (10, 14, 18, 23):
        options = {"crf": str(rate), "preset": "medium", "tune": "fastdecode"}
        yield Codec(f"H.264 4:4:4 key 8 crf {rate} fast", "libx264", "yuv444p", options, 8)
    for quality in (85, 90, 95, 98):
        for siting, subsampling in (("4:2:0", 2), ("4:4:4", 0)):
            options = {"quality": str(quality), "subsampling": str(subsampling)}
            yield Codec(f"JPEG {siting} q{quality}", "jpeg", "", options)
    for rate in (18, 24):
        options = {"crf": str(rate), "preset": "medium", "x265-params": "log-level=none"}
        yield Codec(f"H.265 key 8 crf {rate}", "libx265", "yuv420p", options, 8)
    lossless = {"qp": "0", "preset": "medium", "tune": "fastdecode"}
    yield Codec("H.264 RGB lossless key 8", "libx264rgb", "rgb24", lossless, 8)
    yield Codec("FFV1 RGB lossless", "ffv1", "bgr0", {"level": "3", "slices": "4"})
    yield Codec("PNG lossless", "png", "")


def encoded(codec: Codec, pictures: np.ndarray) -> list[bytes]:
    """Return the encoded pictures: one video, or one file a picture."""
    if codec.encoder == "quality":
        with tempfile.TemporaryDirectory() as folder:
            video = Path(folder, "pictures.mp4")
            quality: Any = codec.options["quality"]
            planes = pictures.transpose(0, 3, 1, 2)
            write_pictures(planes, video, quality=quality, rate_hz=Fraction(30))
            return [video.read_bytes()]
    if codec.encoder in ("jpeg", "png"):
        options: dict[str, Any] = {name: int(value) for name, value in codec.options.items()}
        files = []
        for picture in pictures:
            file = io.BytesIO()
            Image.fromarray(picture).save(file, codec.encoder, **options)
            files.append(file.getvalue())
        return files
    file = io.BytesIO()
    is_mp4 = codec.encoder.startswith("libx26")
    with av.open(file, "w", format="mp4" if is_mp4 else "matroska") as container:
        stream: Any = container.add_stream(codec.encoder, rate=30, options=dict(codec.options))
        stream.height, stream.width = pictures.shape[1:3]
        stream.pix_fmt = codec.pixel_format
        stream.codec_context.gop_size = codec.gop
        stream.codec_context.thread_count = 1
        if is_mp4:
            stream.codec_context.options |= {"sc_threshold": "0", "keyint_min": str(codec.gop)}
        for picture in pictures:
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return [file.getvalue()]


def decoded(codec: Codec, files: list[bytes], *, frames: Sequence[int], count: int) -> np.ndarray:
    """Return some frames as RGB, (t, h, w, 3)."""
    if codec.encoder in ("jpeg", "png"):
        return np.stack([np.asarray(Image.open(io.BytesIO(files[frame]))) for frame in frames])
    with VideoReader(io.BytesIO(files[0]), name=codec.name, frames=count) as reader:
        return np.stack([read_rgb(reader, frame).transpose(1, 2, 0) for frame in frames])


def cpu_ms(work: Callable[[], object], *, rounds: int) -> float:
    """Return the median processor time of some work."""
    spent = []
    for _ in range(rounds):
        began = time.process_time()
        work()
        spent.append(time.process_time() - began)
    return statistics.median(spent) * 1e3


def matched_px(left: np.ndarray, right: np.ndarray, *, most_px: int) -> np.ndarray:
    """Return the disparity that semi-global matching finds, in pixels; negative where none."""
    matcher = cv2.StereoSGBM.create(
        minDisparity=0,
        numDisparities=-(-(most_px + 16) // 16) * 16,
        blockSize=5,
        P1=8 * 3 * 25,
        P2=32 * 3 * 25,
        disp12MaxDiff=1,
        uniquenessRatio=10,
        mode=cv2.STEREO_SGBM_MODE_HH,
    )
    return matcher.compute(left, right).astype(np.float32) / 16


def stereo_errors(
    pictures: Pictures, left: np.ndarray, right: np.ndarray, frames: Sequence[int]
) -> dict[str, float]:
    """Return what warping by the true disparity and matching find in some pictures."""
    photometric, endpoint, bad = [], [], []
    for place, frame in enumerate(frames):
        disparity, valid = pictures.disparity_px[frame], pictures.valid[frame]
        columns, rows = np.meshgrid(
            np.arange(left.shape[2], dtype=np.float32), np.arange(left.shape[1], dtype=np.float32)
        )
        warped = cv2.remap(right[place], columns - disparity, rows, cv2.INTER_LINEAR)
        error = np.abs(warped.astype(np.float32) - left[place])[valid]
        photometric.append(float(error.mean()))
        found = matched_px(left[place], right[place], most_px=int(disparity[valid].max()))
        both = valid & (found >= 0)
        off = np.abs(found - disparity)[both]
        endpoint.append(float(off.mean()))
        bad.append(float((off > 1).mean()))
    return {
        "warp_error": float(np.mean(photometric)),
        "sgbm_epe_px": float(np.mean(endpoint)),
        "sgbm_bad1": float(np.mean(bad)),
    }


def compared(codec: Codec, pictures: Pictures, *, rounds: int) -> dict[str, Any]:
    """Return the row of one codec on some pictures."""
    count = len(pictures.left)
    files = encoded(codec, pictures.left), encoded(codec, pictures.right)
    every = range(count)
    whole = decoded(codec, files[0], frames=every, count=count)
    frames = sorted({round(place) for place in np.linspace(0, count - 1, min(MATCHED, count))})
    right = decoded(codec, files[1], frames=frames, count=count)
    draw = np.random.default_rng(0).integers(0, count, 8).tolist()
    psnr = [
        peak_signal_noise_ratio(one, two) if (one != two).any() else float("inf")
        for one, two in zip(pictures.left, whole, strict=True)
    ]
    return {
        "codec": codec.name,
        "material": pictures.name,
        "bytes_a_frame": sum(map(len, files[0])) / count,
        "released_bytes": pictures.released_bytes,
        "ms": cpu_ms(lambda: decoded(codec, files[0], frames=every, count=count), rounds=rounds)
        / count,
        "random_ms": cpu_ms(
            lambda: [decoded(codec, files[0], frames=[frame], count=count) for frame in draw],
            rounds=rounds,
        )
        / len(draw),
        "released_ms": pictures.released_ms,
        "released_random_ms": pictures.released_random_ms,
        "psnr_db": float(np.mean(psnr)),
        "worst_psnr_db": float(np.min(psnr)),
        "ssim": float(
            np.mean(
                [
                    structural_similarity(pictures.left[frame], whole[frame], channel_axis=-1)
                    for frame in frames
                ]
            )
        ),
        **stereo_errors(pictures, whole[frames], right, frames),
    }


def _within(size: tuple[int, int], scene: Scene) -> tuple[int, int]:
    """Return the training size, or that of the scene's pictures if those are smaller."""
    own = scene.rig.image_height_px, scene.rig.image_width_px
    return own if own[0] < size[0] or own[1] < size[1] else size


def drawn(data: Path, *, size: tuple[int, int]) -> Pictures:
    """Return the primary pair of the first scene of some data, at training size or its own."""
    index = SceneIndex.open(data)
    size = _within(size, index.scene(0))
    pairs = StereoPairs(
        index,
        frames="all",
        size=size,
        fields=["left", "right", "disparity", "valid", "visible"],
        scenes=[index.scene(0).id.key],
    )
    samples = [pairs[number] for number in range(min(FRAMES, len(pairs)))]
    scene = index.scene(0)
    name = f"cam_{scene.rig.primary_pair[0]:02d}_rgb.mp4"
    path = Path(index.root, scene.members[name].path)
    count = min(FRAMES, scene.frames)

    def in_order() -> None:
        with VideoReader(path, name=name, frames=scene.frames) as reader:
            for frame in range(count):
                read_rgb(reader, frame, size=size)

    def at_random() -> None:
        for frame in np.random.default_rng(0).integers(0, scene.frames, 3).tolist():
            with VideoReader(path, name=name, frames=scene.frames) as reader:
                read_rgb(reader, frame, size=size)

    def stacked(field: str) -> np.ndarray:
        return np.stack([sample[field].numpy() for sample in samples])

    return Pictures(
        data.name if scene.id.map_name is None else f"{data.name} ({scene.id.map_name})",
        stacked("left").transpose(0, 2, 3, 1).copy(),
        stacked("right").transpose(0, 2, 3, 1).copy(),
        stacked("disparity")[:, 0],
        (stacked("valid") & stacked("visible"))[:, 0],
        cpu_ms(in_order, rounds=3) / count,
        cpu_ms(at_random, rounds=3) / 3,
        path.stat().st_size / scene.frames,
    )


def middlebury(folder: Path) -> Iterator[Pictures]:
    """Yield the Middlebury pairs of a folder, as stills."""
    for name, left, right, disparity in (
        ("cloth3", "view1.png", "view5.png", "disp1.png"),
        ("cones", "left.png", "right.png", "disp_left.tif"),
        ("motorcycle", "motorcycle_left.png", "motorcycle_right.png", "motorcycle_disp.npz"),
    ):
        place = folder / name
        if not place.is_dir():
            continue
        if disparity.endswith(".npz"):
            stored = np.load(place / disparity, allow_pickle=False)
            disparity_px = stored[stored.files[0]].astype(np.float32)
        else:
            disparity_px = np.asarray(Image.open(place / disparity)).astype(np.float32)
        if name == "cloth3":
            disparity_px /= 2  # stored twice as large in the half-size set
        known = np.isfinite(disparity_px) & (disparity_px > 0)
        # A point of the left picture that leaves the right one has nothing to be compared with.
        columns = np.arange(disparity_px.shape[1])
        known &= columns - np.where(known, disparity_px, 0) >= 0
        views = [np.asarray(Image.open(place / each).convert("RGB")) for each in (left, right)]
        even = tuple(2 * (side // 2) for side in disparity_px.shape)
        cut = (slice(even[0]), slice(even[1]))
        yield Pictures(
            f"Middlebury {name}",
            views[0][cut][None],
            views[1][cut][None],
            np.where(known, disparity_px, 0)[cut][None],
            known[cut][None],
        )


def depth_rows(data: Path, *, size: tuple[int, int], rounds: int) -> list[dict[str, Any]]:
    """Return the rows of the ways to store depth without loss."""
    index = SceneIndex.open(data)
    scene = index.scene(0)
    size = _within(size, scene)
    name = "cam_00_depth.mkv"
    path = Path(index.root, scene.members[name].path)
    count = min(FRAMES, scene.frames)

    def released() -> np.ndarray:
        with open_depth(path, name=name, frames=scene.frames) as reader:
            return np.stack(
                [
                    resized_nearest(
                        read_depth_units(reader, frame, encoding=DepthEncoding()), size=size
                    )
                    for frame in range(count)
                ]
            )

    units = released()
    rows = [
        {
            "codec": "released FFV1, scaled",
            "material": data.name,
            "bytes_a_frame": path.stat().st_size / scene.frames,
            "ms": cpu_ms(released, rounds=rounds) / count,
        }
    ]
    for way, (write, read) in _depth_ways(units.shape).items():
        files = write(units)
        if not np.array_equal(read(files), units):
            raise ValueError(f"{way}: does not give the depth back that was stored")
        rows.append(
            {
                "codec": way,
                "material": data.name,
                "bytes_a_frame": sum(map(len, files)) / count,
                "ms": cpu_ms(lambda read=read, files=files: read(files), rounds=rounds) / count,
            }
        )
    return rows


Write = Callable[[np.ndarray], list[bytes]]
Read = Callable[[list[bytes]], np.ndarray]


def _depth_ways(shape: tuple[int, ...]) -> dict[str, tuple[Write, Read]]:
    blosc2 = blosc2_module()
    ways: dict[str, tuple[Write, Read]] = {}
    for codec_name, level in (("LZ4", 5), ("LZ4", 9), ("ZSTD", 1), ("ZSTD", 5), ("ZSTD", 9)):
        for filters in (
            ["SHUFFLE"],
            ["BITSHUFFLE"],
            ["DELTA", "SHUFFLE"],
            ["SHUFFLE", "BYTEDELTA"],
        ):
            options = {
                "codec": getattr(blosc2.Codec, codec_name),
                "clevel": level,
                "typesize": 2,
                "filters": [getattr(blosc2.Filter, name) for name in filters],
                "filters_meta": [2 if name == "BYTEDELTA" else 0 for name in filters],
                "nthreads": 1,
            }

            def write(units: np.ndarray, options: dict[str, Any] = options) -> list[bytes]:
                return [blosc2.compress2(unit, **options) for unit in units]

            def read(files: list[bytes]) -> np.ndarray:
                found = np.empty(shape, dtype=np.uint16)
                for place, file in enumerate(files):
                    blosc2.decompress2(file, dst=found[place], nthreads=1)
                return found

            ways[f"blosc2 {codec_name.lower()} {level} {'+'.join(filters).lower()}"] = write, read
    for slices in (4, 16):
        codec = Codec("FFV1", "ffv1", "gray16le", {"level": "3", "slices": str(slices)})
        ways[f"FFV1, {slices} slices"] = (
            lambda units, codec=codec: _grey_video(codec, units),
            _grey_frames,
        )
    ways["PNG, 16 bits"] = (
        _grey_png,
        lambda files: np.stack(
            [np.asarray(Image.open(io.BytesIO(file))).astype(np.uint16) for file in files]
        ),
    )
    return ways


def _grey_video(codec: Codec, units: np.ndarray) -> list[bytes]:
    file = io.BytesIO()
    with av.open(file, "w", format="matroska") as container:
        stream: Any = container.add_stream(codec.encoder, rate=30, options=dict(codec.options))
        stream.height, stream.width, stream.pix_fmt = *units.shape[1:], codec.pixel_format
        for unit in units:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(unit, format="gray16le")))
        container.mux(stream.encode(None))
    return [file.getvalue()]


def _grey_frames(files: list[bytes]) -> np.ndarray:
    with av.open(io.BytesIO(files[0])) as container:
        container.streams.video[0].codec_context.thread_count = 1
        return np.stack([frame.to_ndarray() for frame in container.decode(video=0)])


def _grey_png(units: np.ndarray) -> list[bytes]:
    files = []
    for unit in units:
        file = io.BytesIO()
        Image.fromarray(unit).save(file, "png")
        files.append(file.getvalue())
    return files


def _videos(rows: list[dict[str, Any]]) -> dict[str, list[dict[str, Any]]]:
    """Return the rows of each video, not those of stills."""
    found: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        if row["codec"] != "original" and row["released_ms"] > 0:
            found.setdefault(row["material"], []).append(row)
    return found


def table(content: dict[str, Any]) -> str:
    """Return what was measured as Markdown: the videos one by one, then the stills."""
    rows, here = content["pictures"], content["machine"]
    lines = [
        f"# Codecs for training shards at {content['size']}",
        "",
        f"Measured {here['when']} on {here['cpu']}, PyAV {here['versions']['av']}, blosc2",
        f"{here['versions']['blosc2']}.",
        "",
        "Processor time of one thread; speed is a multiple of decoding and scaling the released",
        "video. A scene whose pictures are smaller keeps their size. Made by",
        "`python -m benchmarks.codecs`.",
    ]
    for name, found in _videos(rows).items():
        lines += [
            "",
            f"## {name}",
            "",
            "| pictures | speed in order | random | ms | kB a frame | of released | PSNR dB |"
            " worst | SSIM | warp error | SGBM px | over 1 px |",
            "|---|---|---|---|---|---|---|---|---|---|---|---|",
        ]
        lines += [
            f"| {row['codec']} | {row['released_ms'] / row['ms']:.1f} "
            f"| {row['released_random_ms'] / row['random_ms']:.0f} | {row['ms']:.1f} "
            f"| {row['bytes_a_frame'] / 1e3:.0f} "
            f"| {row['bytes_a_frame'] / row['released_bytes']:.2f} "
            f"| {row['psnr_db']:.1f} | {row['worst_psnr_db']:.1f} | {row['ssim']:.4f} "
            f"| {row['warp_error']:.2f} | {row['sgbm_epe_px']:.3f} | {row['sgbm_bad1']:.1%} |"
            for row in found
        ]
    lines += ["", "## Originals and stills"]
    lines += [
        "",
        "| pictures | material | PSNR dB | warp error | SGBM px |",
        "|---|---|---|---|---|",
    ]
    lines += [
        f"| {row['codec']} | {row['material']} | {row.get('psnr_db', float('inf')):.1f} "
        f"| {row['warp_error']:.2f} | {row['sgbm_epe_px']:.3f} |"
        for row in rows
        if row["codec"] == "original" or not row["released_ms"] > 0
    ]
    lines += [
        "",
        "## Depth, lossless",
        "",
        "| depth | material | ms | kB a frame |",
        "|---|---|---|---|",
    ]
    lines += [
        f"| {row['codec']} | {row['material']} | {row['ms']:.2f} "
        f"| {row['bytes_a_frame'] / 1e3:.0f} |"
        for row in content["depth"]
    ]
    return "\n".join(lines) + "\n"


def plot(rows: list[dict[str, Any]], place: Path) -> None:
    """Draw error against bytes and against time for each video, a line for each kind of codec."""
    videos = _videos(rows)
    figure, axes = plt.subplots(
        len(videos), 2, figsize=(11, 4.2 * len(videos)), sharey="row", squeeze=False,
        layout="constrained",
    )  # fmt: skip
    for (name, found), (in_bytes, in_time) in zip(videos.items(), axes, strict=True):
        kinds: dict[str, list[dict[str, Any]]] = {}
        for row in found:
            kind = row["codec"].replace(" fast", "").rsplit(" crf", 1)[0].rsplit(" q", 1)[0]
            kind = kind.replace("quality ", "--quality ")
            if " fast" in row["codec"]:
                kind += ", fast decode"
            kinds.setdefault(kind, []).append(row)
        for number, (kind, same) in enumerate(kinds.items()):
            style = {"marker": "osv^D<>pP*"[number % 10], "color": f"C{number % 10}"}
            style |= {"linestyle": "--" if "fast" in kind else "-", "label": kind}
            style |= {"markersize": 9 if "--quality" in kind else 4}
            for axis, key, unit in ((in_bytes, "bytes_a_frame", 1e3), (in_time, "ms", 1)):
                axis.plot(
                    [row[key] / unit for row in same],
                    [row["sgbm_epe_px"] for row in same],
                    **style,
                )
        original = next(
            row["sgbm_epe_px"]
            for row in rows
            if row["codec"] == "original" and row["material"] == name
        )
        for axis, label in ((in_bytes, "kB a frame"), (in_time, "processor time a frame, ms")):
            axis.axhline(original, color="grey", linewidth=0.8)
            axis.set_xscale("log")
            axis.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            axis.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axis.xaxis.set_minor_formatter(NullFormatter())
            axis.set_xlabel(label)
        # What lies above ruins matching, whatever it saves: the table has its numbers.
        in_bytes.set_ylim(0.96 * original, 1.3 * original)
        in_bytes.set_ylabel("SGBM end-point error, px")
        in_bytes.set_title(f"{name}; grey: original pictures", fontsize=10, loc="left")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside right center", fontsize=8)
    figure.savefig(place, dpi=110)


def main() -> None:
    """Measure, and write codecs.md and codecs.png."""
    parser = argparse.ArgumentParser(prog="benchmarks.codecs", description=__doc__)
    parser.add_argument("scenes", nargs="+", type=Path, help="folders in the released layout")
    parser.add_argument("--middlebury", type=Path)
    parser.add_argument("--size", default="832x480")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--only", action="append", help="codecs whose name holds this text")
    parser.add_argument("--out", type=Path, default=Path("docs/performance"))
    options = parser.parse_args()
    size = parse_size(options.size)
    material = [drawn(data, size=size) for data in options.scenes]
    if options.middlebury is not None:
        material += middlebury(options.middlebury)
    rows = []
    for pictures in material:
        frames = sorted({round(p) for p in np.linspace(0, len(pictures.left) - 1, MATCHED)})
        errors = stereo_errors(pictures, pictures.left[frames], pictures.right[frames], frames)
        moves = pictures.released_ms > 0
        rows.append({"codec": "original", "material": pictures.name, "moves": moves, **errors})
        for codec in codecs():
            if options.only is None or any(text in codec.name for text in options.only):
                rows.append(compared(codec, pictures, rounds=options.rounds))
                sys.stderr.write(json.dumps(rows[-1]) + "\n")
    depth = [
        row for data in options.scenes for row in depth_rows(data, size=size, rounds=options.rounds)
    ]
    options.out.mkdir(parents=True, exist_ok=True)
    content = {"machine": machine(), "size": options.size, "pictures": rows, "depth": depth}
    (options.out / "codecs.md").write_text(table(content))
    plot(rows, options.out / "codecs.png")


if __name__ == "__main__":
    main()
