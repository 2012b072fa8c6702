"""What kernels write for many tracks lies in large pages, where the system has some to give."""

import re
from pathlib import Path

import pytest
import torch

from torchfra.compiler import pages

ENABLED = Path("/sys/kernel/mm/transparent_hugepage/enabled")
SMAPS = Path("/proc/self/smaps")


@pytest.mark.skipif(not SMAPS.exists() or not ENABLED.exists(), reason="this system gives none, or does not say")
def test_the_memory_of_a_large_tensor_is_marked_for_large_pages():
    assert "hg" in flags(pages.in_large_pages(torch.empty(1 << 23, dtype=torch.float64)))


def flags(x):
    """What the system says of the memory in the middle of a tensor."""
    place, inside = x.data_ptr() + x.numel() * x.element_size() // 2, False
    for line in SMAPS.read_text().splitlines():
        if found := re.match(r"([0-9a-f]+)-([0-9a-f]+) ", line):
            inside = int(found[1], 16) <= place < int(found[2], 16)
        elif inside and line.startswith("VmFlags:"):
            return line.split()[1:]
    raise AssertionError("expected the tensor in the memory of this process")
