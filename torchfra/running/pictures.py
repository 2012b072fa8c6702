"""Forms of figures by the ending of their file; apart from plotting, as matplotlib takes long to import."""

from __future__ import annotations

from pathlib import Path

FORMS = ("pdf", "svg", "png")


def picture_form(path: str | Path, argument: str = "path") -> str:
    """The form of a figure by the ending of its file; PNG without one.

    Args:
        path: of the file.
        argument: name of the argument, for error messages.

    Raises:
        ValueError: a name that ends in none of ``FORMS``.
    """
    form = Path(path).suffix.lower().removeprefix(".") or "png"
    if form not in FORMS:
        endings = ", ".join(f".{known}" for known in FORMS)
        raise ValueError(f"{argument}: expected a file that ends in {endings}, received {path}")
    return form
