"""Clips whose every frame carries its own number, written and read back by ffmpeg's own binary."""

import io
import subprocess
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path

import av
import imageio_ffmpeg
import numpy as np
import pytest
from scipy import ndimage

from stereogenbench_data.media.video import VideoReader, read_rgb

FRAMES, HEIGHT, WIDTH = 48, 64, 96
BLOCK = 8  # a painted bit is a square of so many pixels


def texture(height: int, width: int, *, sigmas_px: Sequence[int]) -> np.ndarray:
    """Return a picture (height, width, 3) with detail at some scales."""
    noise = np.random.default_rng(5).normal(size=(height, width, 3))
    layers = sum(ndimage.gaussian_filter(noise, (s, s, 0)) * s for s in sigmas_px)
    return np.uint8((layers - layers.min()) / np.ptp(layers) * 255)


def flipped(content: bytes, place: int, bit: int) -> bytes:
    """Return bytes of which one bit is another."""
    altered = bytearray(content)
    altered[place] ^= 1 << bit
    return bytes(altered)


def painted(frames: int = FRAMES) -> np.ndarray:
    """Return a moving texture, (frames, h, w, 3), with the frame's number in blocks at the top."""
    wide = texture(HEIGHT, WIDTH + 2 * frames, sigmas_px=[1])
    pictures = np.stack([wide[:, 2 * i : 2 * i + WIDTH] for i in range(frames)])
    for index, picture in enumerate(pictures):
        for bit in range(8):
            picture[:BLOCK, bit * BLOCK : (bit + 1) * BLOCK] = 255 * (index >> bit & 1)
    return pictures


class CountingFile(io.BytesIO):
    """A file in memory that counts the bytes read from it, and in how many reads."""

    bytes_read = 0
    reads = 0

    def read(self, size: int | None = -1) -> bytes:
        """Read, and count."""
        content = super().read(size)
        self.bytes_read += len(content)
        self.reads += 1
        return content


class Clips:
    """A folder of clips, each made once."""

    frames, height, width = FRAMES, HEIGHT, WIDTH

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.pictures = painted()

    def ffmpeg(self, *arguments: object, stdin: bytes = b"") -> bytes:
        """Run ffmpeg; return what it writes."""
        quiet = (imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", "-y")
        command = [*quiet, *map(str, arguments)]
        return subprocess.run(command, input=stdin, capture_output=True, check=True).stdout

    def encode(
        self,
        name: str,
        *codec: str,
        pictures: np.ndarray | None = None,
        pixel_format: str = "rgb24",
        rate: str = "15",
    ) -> Path:
        """Encode pictures, the painted ones unless others are given."""
        path = self.folder / name
        if not path.exists():
            pictures = self.pictures if pictures is None else pictures
            height, width = pictures.shape[1:3]
            source = ("-f", "rawvideo", "-pix_fmt", pixel_format, "-s", f"{width}x{height}")
            self.ffmpeg(*source, "-r", rate, "-i", "-", *codec, path, stdin=pictures.tobytes())
        return path

    def truth(self, path: Path) -> np.ndarray:
        """Return all frames as ffmpeg itself decodes them to rgb24, as (frames, 3, h, w)."""
        raw = self.ffmpeg(
            "-i", path, "-fps_mode", "passthrough", "-f", "rawvideo", "-pix_fmt", "rgb24", "-"
        )
        pictures = np.frombuffer(raw, np.uint8).reshape(-1, HEIGHT, WIDTH, 3)
        return pictures.transpose(0, 3, 1, 2)

    def remuxed(self, source: Path, name: str, *, without: Collection[int] = ()) -> Path:
        """Copy a clip's packets, but for some of them as stored."""
        path = self.folder / name
        if path.exists():
            return path
        with av.open(str(source)) as old, av.open(str(path), "w") as new:
            stream = new.add_stream_from_template(old.streams.video[0])
            packets = (packet for packet in old.demux(video=0) if packet.size)
            for number, packet in enumerate(packets):
                if number not in without:
                    packet.stream = stream
                    new.mux(packet)
        return path

    def damaged(self, source: Path, name: str, *, packet: int) -> Path:
        """Copy a clip and change a third of one of its packets, in the middle."""
        payload = self.packets(source)[packet]
        content = bytearray(source.read_bytes())
        start = content.index(payload) + len(payload) // 3
        for at in range(start, start + len(payload) // 3):
            content[at] ^= 0xA5
        path = self.folder / name
        path.write_bytes(content)
        return path

    def packets(self, path: Path) -> list[bytes]:
        """Return a clip's packets, as stored."""
        with av.open(str(path)) as container:
            return [bytes(packet) for packet in container.demux(video=0) if packet.size]

    def counting(self, path: Path) -> CountingFile:
        """Return a clip's bytes as a file that counts what is read."""
        return CountingFile(path.read_bytes())

    def number(self, rgb: np.ndarray) -> int:
        """Return the number painted into a frame, (3, h, w)."""
        blocks = rgb[1, :BLOCK, : 8 * BLOCK].reshape(BLOCK, 8, BLOCK).mean(axis=(0, 2))
        return sum(1 << bit for bit, level in enumerate(blocks) if level > 127)

    def shown(self, file: object, order: Iterable[int], *, frames: int = FRAMES) -> list[int]:
        """Return the numbers painted into frames of a clip, as a reader gives them."""
        with VideoReader(file, name="clip", frames=frames) as reader:
            return [self.number(read_rgb(reader, index)) for index in order]


@pytest.fixture(scope="session")
def clips(tmp_path_factory: pytest.TempPathFactory) -> Clips:
    return Clips(tmp_path_factory.mktemp("clips"))
