"""Formats of figures by file extension; apart from plotting, as matplotlib takes long to import."""

from __future__ import annotations

from pathlib import Path

FORMATS = ("pdf", "svg", "png")


def picture_format(path: str | Path, argument: str = "path") -> str:
    """The format of a figure by its file extension; PNG without one.

    Args:
        path: of the file.
        argument: name of the argument, for error messages.

    Raises:
        ValueError: an extension that is not among ``FORMATS``.
    """
    extension = Path(path).suffix.lower().removeprefix(".") or "png"
    if extension not in FORMATS:
        endings = ", ".join(f".{known}" for known in FORMATS)
        raise ValueError(f"{argument}: expected a file that ends in {endings}, received {path}")
    return extension
