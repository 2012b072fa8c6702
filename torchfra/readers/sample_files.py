"""Finds the recorded tracks that come with the package ``traffic``."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path


def samples(*groups: str) -> list[Path]:
    """The recorded tracks that come with the package ``traffic``.

    Args:
        groups: names of its folders of samples, such as "calibration", "gliders", "noisy".

    Returns:
        The files, sorted.

    Raises:
        ImportError: the package is not installed.
        ValueError: no group, or an unknown one.
    """
    spec = find_spec("traffic")
    roots = [Path(place) / "data" / "samples" for place in (spec and spec.submodule_search_locations) or ()]
    there = {file.parent.name for root in roots for file in root.glob("*/*.json.gz")}
    if not there:
        raise ImportError("the sample tracks are in the package traffic: pip install --no-deps traffic==2.13")
    if not groups or not there.issuperset(groups):
        raise ValueError(f"expected groups among {', '.join(sorted(there))}, received {', '.join(groups) or 'none'}")
    return sorted(file for root in roots for group in set(groups) for file in root.glob(f"{group}/*.json.gz"))
