"""The checksums that FFV1 keeps in each slice of a picture.

FFmpeg's decoder does look at them, but puts the slice of the picture before in place of a damaged
one and says so in its log alone. So they are checked here before a packet is decoded.

Source: RFC 9043, sections 4.8 (slice footer) and 4.9.3 (CRC-32, most significant bit first).
"""

import zlib
from itertools import pairwise
from typing import Final

_SIZE_BYTES: Final = 3
_FOOTER_BYTES: Final = 8
"""A footer with a checksum: three bytes of size, one of error status, four of checksum."""

_MIRRORED: Final = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))
"""Bytes with their bits in reverse order: zlib's CRC-32 takes the least significant bit first."""

_CHECKSUM_STARTS: Final = (0xFFFFFFFF, 0xA1CEFD61)
"""What zlib's CRC-32 starts from, and ends at over a whole slice: FFV1 of version 3, and of
version 4 as FFmpeg's experimental encoder writes it."""


def fails_slice_checksums(packet: bytes) -> bool:
    """Return whether a packet of FFV1 version 3 or later contradicts its own checksums.

    A packet whose slices carry no checksums never does.
    """
    if _slice_ends(packet, footer_bytes=_SIZE_BYTES) is not None:
        return False
    ends = _slice_ends(packet, footer_bytes=_FOOTER_BYTES)
    if ends is None:
        return True
    slices = (packet[start:end].translate(_MIRRORED) for start, end in pairwise(ends))
    return any(
        all(zlib.crc32(mirrored, start) != start for start in _CHECKSUM_STARTS)
        for mirrored in slices
    )


def _slice_ends(packet: bytes, *, footer_bytes: int) -> list[int] | None:
    """Return 0 and where each slice ends, None if the sizes in the footers do not add up."""
    ends = [len(packet)]
    while ends[-1] > 0:
        footer = ends[-1] - footer_bytes
        size = int.from_bytes(packet[max(footer, 0) : footer + _SIZE_BYTES], "big")
        ends.append(footer - size)
    return ends[::-1] if ends[-1] == 0 else None
