# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Unpacking: compressed bytes to plain ones, never more of them than was announced."""

from __future__ import annotations

from pathlib import Path
from typing import Callable

AT_ONCE = 128 * 2**20  # bytes: rosbag2's chunks have one megabyte, or one message where that is larger
ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'  # begins every frame; a CDR message begins with a zero
PIECE = 2**20  # bytes that are in memory while a file is unpacked


def unpacked(packed: bytes, compression: str, size: int) -> bytes:
    """
    Return the content of a chunk.

    :param compression: as MCAP names it: empty, ``zstd`` or ``lz4``.
    :param size: of the content [bytes], as announced; more is never made of it.
    :raises Exception: of any kind, where it is damaged, or has another size.
    """
    if size > AT_ONCE:
        raise ValueError(f'more than {AT_ONCE} bytes at once')
    content = packed
    if compression == 'zstd':
        content = _zstd(packed, size)
    elif compression == 'lz4':
        import lz4.frame

        content = lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=size + 1)
    elif compression:
        raise ValueError(f'unknown compression {compression[:20]!r}')
    if len(content) != size:
        raise ValueError('its size is not as announced')
    return content


def unpacked_message(octets: bytes) -> bytes:
    """Return the CDR bytes of a message, which rosbag2 may have compressed alone; see `unpacked`."""
    if octets[:4] != ZSTD_MAGIC:
        return octets
    import zstandard

    size = zstandard.get_frame_parameters(octets).content_size
    return unpacked(octets, 'zstd', size) if size != zstandard.CONTENTSIZE_UNKNOWN else _zstd(octets, AT_ONCE)


def unpack_file(packed: Path, target: Path, allow: Callable[[int], None]) -> None:
    """
    Write the content of a file that rosbag2 compressed.

    :param allow: called with the number of bytes before they are written; raises where they are too many.
    """
    import zstandard

    with packed.open('rb') as source, target.open('xb') as sink:
        for piece in zstandard.ZstdDecompressor().read_to_iter(source, write_size=PIECE):
            allow(len(piece))
            sink.write(piece)


def _zstd(packed: bytes, size: int) -> bytes:
    import zstandard

    # The library believes the frame's own announcement, and asks for that much memory.
    declared = zstandard.get_frame_parameters(packed).content_size
    if declared not in (size, zstandard.CONTENTSIZE_UNKNOWN):
        raise ValueError('its size is not as announced')
    return zstandard.ZstdDecompressor().decompress(packed, max_output_size=max(size, 1)) if size else b''
