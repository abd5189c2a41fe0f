"""The drawn pictures at lower bit rates: the same scenes, their H.264 encoded again, depth linked.

What a faster depth codec gives depends on what decoding the pictures costs, and that on their rate.
"""

import os
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from fractions import Fraction
from pathlib import Path
from typing import Final

import av

from stereogenbench_data.schema.release import FRAME_RATE_HZ

Say = Callable[[str], None]

DRAWN_CRF: Final = 18
"""The constant rate factor of the drawn pictures."""

OTHER_CRFS: Final = (26, 34)
"""Those of the trees made here."""

_RATE_HZ: Final = int(FRAME_RATE_HZ)


def reencode_tree(release: Path, tree: Path, *, crf: int, workers: int, say: Say) -> None:
    """Make a tree like another, with the pictures at another constant rate factor.

    All other files are hard links. What is there already is kept.

    Args:
        release: The tree to encode again, in the released layout.
        tree: Where the new one goes.
        crf: The constant rate factor; all else is x264's default, as where pictures are drawn.
        workers: Processes that encode, one thread each.
        say: Is told what is being done.
    """
    todo = []
    for file in sorted(path for path in release.rglob("scene_*/*") if path.is_file()):
        made = tree / file.relative_to(release)
        made.parent.mkdir(parents=True, exist_ok=True)
        if made.exists():
            continue
        if file.suffix == ".mp4":
            todo.append((file, made))
        else:
            os.link(file, made)
    if not todo:
        return
    say(f"encoding {len(todo)} videos at rate factor {crf}")
    with ProcessPoolExecutor(workers) as pool:
        running = [pool.submit(reencode, file, made, crf=crf) for file, made in todo]
        for encoded in running:
            encoded.result()


def reencode(file: Path, made: Path, *, crf: int) -> None:
    """Encode an H.264 video again at another constant rate factor, whole or not at all."""
    part = made.with_name(f"{made.name}.part")
    options = {"crf": str(crf), "x264-params": "cpu-independent=1"}
    with (
        av.open(file) as source,
        av.open(part, "w", format="mp4", container_options={"fflags": "+bitexact"}) as target,
    ):
        stream = target.add_stream("libx264", rate=_RATE_HZ, options=options)
        told = source.streams.video[0]
        stream.width, stream.height, stream.pix_fmt = told.width, told.height, "yuv420p"
        stream.codec_context.thread_count = 1
        for number, decoded in enumerate(source.decode(told)):
            frame = decoded.reformat(format="yuv420p")
            frame.pts, frame.time_base = number, Fraction(1, _RATE_HZ)
            frame.pict_type = av.video.frame.PictureType.NONE  # the encoder's own choice
            target.mux(stream.encode(frame))
        target.mux(stream.encode(None))
    part.replace(made)
