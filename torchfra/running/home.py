"""A home for a process that has none, which kernels and figures keep their caches in: made when this is imported."""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile
from pathlib import Path


def known() -> bool:
    """Whether the environment or the system's list of users says where the home is."""
    try:
        Path.home()
    except RuntimeError:
        return False
    return True


if not known():
    os.environ["HOME"] = tempfile.mkdtemp(prefix="torchfra-home-")
    atexit.register(shutil.rmtree, os.environ["HOME"], ignore_errors=True)
