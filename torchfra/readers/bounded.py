"""What a file holds, gzipped or not, up to a bound."""

from __future__ import annotations

import gzip
import zlib
from pathlib import Path

from torchfra.numbers import is_integer

MAX_BYTES = 2**30
"""Bytes that a file may hold, unpacked, unless another bound is set."""
_PIECE = 2**20
PARSED = 24
"""What a byte of JSON and XML counts for, which take up more memory."""


def contents(path: Path, max_bytes: int) -> bytes:
    """All bytes of a file, unpacked.

    Raises:
        ValueError: there are too many, the file is no complete gzip file, or the bound is no whole number above 0.
    """
    if not is_integer(max_bytes, 1):
        raise ValueError(f"max_bytes: expected a whole number above 0, received {max_bytes!r}")
    with path.open("rb") as file:
        source = gzip.GzipFile(fileobj=file) if file.peek(2)[:2] == b"\x1f\x8b" else file
        data = bytearray()
        try:
            while piece := source.read(_PIECE):
                data += piece
                check_size(len(data), max_bytes)
        except (EOFError, gzip.BadGzipFile, zlib.error) as error:
            raise ValueError(f"expected a complete gzip file, received none ({error})") from error
    return bytes(data)


def check_size(size: int, max_bytes: int, what: str = "") -> None:
    """Refuses to read more than ``max_bytes``."""
    if size > max_bytes:
        raise ValueError(
            f"expected at most {max_bytes} bytes{what}, received more; max_bytes (--max-bytes) raises that"
        )
