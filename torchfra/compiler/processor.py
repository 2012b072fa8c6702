"""What the processor of this machine can do."""

from __future__ import annotations

from functools import lru_cache

import torch

from torchfra.compiler.instructions import Lanes
from torchfra.compiler.llvm import binding


@lru_cache(maxsize=1)
def features() -> str:
    """The instructions that it has, as LLVM calls them."""
    text: str = binding().get_host_cpu_features().flatten()
    return text


@lru_cache(maxsize=1)
def registers() -> str:
    """Its registers for several numbers: ``"avx512"``, ``"avx2"`` or ``""`` for any others."""
    has = set(features().split(","))
    if {"+avx512f", "+avx512bw", "+avx512dq", "+avx512vl"} <= has:
        return "avx512"
    return "avx2" if {"+avx2", "+fma"} <= has else ""


def lanes_of(dtype: torch.dtype, narrow: bool = False) -> Lanes:
    """How tracks lie side by side in its registers; ``narrow``: one track alone."""
    kind = registers()
    size = {"avx512": 64, "avx2": 32}.get(kind, 16)
    return Lanes(1 if narrow else size // dtype.itemsize, dtype, kind)
