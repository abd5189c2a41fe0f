"""The program of a Blender process: requests in, answers out.

`process.py` starts it by its path in a Python that has bpy, which may be another one than that of
the rest of the package. So it imports only the standard library and NumPy, and loads `stage.py` by
its path too.

It reads requests from its standard input and writes answers to what was its standard output; what
Blender prints goes to standard error. A message is its length (8 bytes, little-endian), a JSON
object, and the bytes of the arrays that the object lists under "arrays".
"""

import json
import math
import os
import struct
import sys
from collections.abc import Sequence
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any, BinaryIO, Final

import numpy as np

Array = Any

_KINDS: Final = ("<f8", "|u1")


def read_message(stream: BinaryIO) -> tuple[dict[str, Any], list[Array]]:
    """Return the object and the arrays of the next message.

    Raises:
        EOFError: If the stream ends before it does.
    """
    (length,) = struct.unpack("<Q", _exactly(stream, 8))
    message: dict[str, Any] = json.loads(_exactly(stream, length))
    arrays = []
    for kind, shape in message.pop("arrays"):
        if kind not in _KINDS:
            raise EOFError(f"an array of the message has the type {kind!r}")
        size = math.prod(shape) * np.dtype(kind).itemsize
        arrays.append(np.frombuffer(_exactly(stream, size), kind).reshape(shape))
    return message, arrays


def write_message(stream: BinaryIO, message: dict[str, Any], arrays: Sequence[Array]) -> None:
    """Send an object and arrays of float64 or uint8."""
    contiguous = [np.ascontiguousarray(each) for each in arrays]
    listed = [[each.dtype.str, each.shape] for each in contiguous]
    text = json.dumps(message | {"arrays": listed}).encode()
    stream.write(struct.pack("<Q", len(text)) + text)
    for each in contiguous:
        stream.write(each.tobytes())
    stream.flush()


def _exactly(stream: BinaryIO, size: int) -> bytes:
    data = stream.read(size)
    if len(data) < size:
        raise EOFError(f"the stream ended {size - len(data)} bytes early")
    return data


def main() -> None:
    """Answer requests until the standard input ends."""
    answers = os.fdopen(os.dup(1), "wb")
    requests = os.fdopen(os.dup(0), "rb")
    os.dup2(2, 1)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    spec = spec_from_file_location("stereogenbench_stage", Path(__file__).with_name("stage.py"))
    assert spec is not None
    assert spec.loader is not None
    stage = module_from_spec(spec)
    try:
        spec.loader.exec_module(stage)
    except ImportError as error:
        write_message(answers, {"error": f"bpy cannot be imported ({error})."}, [])
        return
    server = stage.Server()
    while True:
        try:
            call, arrays = read_message(requests)
        except EOFError:
            break
        try:
            answer, found = server.answer(call, arrays)
        except stage.AssetError as error:
            answer, found = {"error": str(error)}, []
        write_message(answers, answer, found)
    sys.stderr.flush()
    os._exit(0)  # Blender's own clean-up takes long and may crash.


if __name__ == "__main__":
    main()
