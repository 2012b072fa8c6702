"""Files of tensors that tell when they are damaged, and what was learned back into a filter.

``torch.load`` reads such a file like any other, but does not compare the checksums that are in it: with one bit changed
it may give other numbers.  A file written here ends in the SHA-256 of all before, as the comment of the zip archive
that it is; one that ``torch.save`` wrote has the checksums of the archive.
"""

from __future__ import annotations

import hashlib
import io
import struct
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from torchfra.hyper import hypers

_MARK = b"torchfra sha256 "
_LENGTH = len(_MARK) + 64
_PLAIN = b"PK\x05\x06"
"""The last part of an archive begins with this, and takes 22 bytes where there is no comment."""


def pack(state: object) -> bytes:
    """The bytes of ``torch.save(state)``, followed by a digest."""
    buffer = io.BytesIO()
    torch.save(state, buffer)
    body = buffer.getvalue()[:-2] + struct.pack("<H", _LENGTH)
    return body + _digest(body)


def read(path: str | Path) -> Any:
    """The tensors of a file that ``pack`` or ``torch.save`` made, on the CPU.

    Raises:
        OSError: it cannot be read.
        ValueError: it is damaged, or something else.
    """
    data = Path(path).read_bytes()
    _check_archive(data, signed=data[-_LENGTH:] == _digest(data[:-_LENGTH]))
    try:
        return torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    except Exception as error:  # the reader of torch raises errors of many types
        raise ValueError(f"no tensors can be read ({_first_line(error)})") from None


def load_values(module: nn.Module, values: object) -> None:
    """Loads a state dictionary and checks that its values are within their ranges.

    Args:
        module: it gets the values; where it has infinite ones, they may stay so.
        values: as ``module.state_dict()`` gives them.

    Raises:
        ValueError: other names or shapes, a value that is not finite, or a hyperparameter out of its range.
    """
    if not isinstance(values, Mapping) or not all(isinstance(x, Tensor) for x in values.values()):
        raise ValueError(f"expected tensors by name, received {type(values).__name__}")
    finite = {name for name, x in _natural(module).items() if x.isfinite().all()}
    try:
        module.load_state_dict(dict(values))
    except (RuntimeError, AttributeError, TypeError) as error:
        raise ValueError(" ".join(str(error).split())) from None
    ranges, loaded = hypers(module), _natural(module)
    for name, x in loaded.items():
        possible = bool(ranges[name].constraint.check(x).all()) if name in ranges else not x.isnan().any()
        if not possible or (name in finite and not x.isfinite().all()):
            allowed = f"{ranges[name].describe()[1]} that is finite" if name in ranges else "finite numbers"
            raise ValueError(f"{name}: expected {allowed}, received {x.tolist()!s:.200}")


def _natural(module: nn.Module) -> dict[str, Tensor]:
    """Hyperparameters in natural units, and all else that a state dictionary holds, by path."""
    known = hypers(module)
    others = {name: x for name, x in module.state_dict().items() if name.removesuffix(".raw") not in known}
    return {path: hyper().detach() for path, hyper in known.items()} | others


def _digest(body: bytes) -> bytes:
    return _MARK + hashlib.sha256(body).hexdigest().encode()


def _check_archive(data: bytes, signed: bool) -> None:
    """Checks that the parts of an archive take no more memory than the file; without a digest, that checksums agree.

    ``torch.save`` compresses nothing, but ``torch.load`` would unpack what is compressed, to a thousand times its size.
    """
    if not data[-22 - _LENGTH * signed :].startswith(_PLAIN):
        raise ValueError("it is damaged, or torch.save did not write it")
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            unpacked = sum(part.file_size for part in archive.infolist())
            if unpacked > len(data):
                raise ValueError(f"{unpacked} bytes in a file of {len(data)}")
            damaged = None if signed else archive.testzip()
    except Exception as error:  # a damaged header can lead to errors of many types
        raise ValueError(f"it is damaged ({_first_line(error)})") from None
    if damaged is not None:
        raise ValueError(f"it is damaged ({damaged})")


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
