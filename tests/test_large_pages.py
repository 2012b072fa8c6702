"""What kernels write for many tracks lies in large pages, where the system has some to give."""

import re
import sys
from pathlib import Path

import pytest
import torch

from torchfra.kernel import pages

ENABLED = Path("/sys/kernel/mm/transparent_hugepage/enabled")


@pytest.mark.skipif(not ENABLED.exists() or "[never]" in ENABLED.read_text(), reason="this system gives none")
def test_the_memory_of_a_large_tensor_is_in_large_pages_once_it_is_touched():
    before = large()
    x = pages.in_large_pages(torch.empty(1 << 23, dtype=torch.float64)).zero_()
    assert large() - before >= 1 << 21, f"expected large pages among the {x.numel() * 8} bytes"


def test_small_tensors_and_other_systems_are_left_alone(monkeypatch):
    asked = []
    monkeypatch.setattr(pages, "_advise", lambda: lambda *given: asked.append(given))
    if sys.platform != "linux":
        monkeypatch.setattr(pages.mmap, "MADV_HUGEPAGE", 14, raising=False)
    pages.in_large_pages(torch.empty(1000))
    assert not asked
    x = torch.empty(pages.LEAST // 4 + 3)
    assert pages.in_large_pages(x) is x
    ((first, size, _),) = asked
    assert first % pages.mmap.PAGESIZE == 0
    assert x.data_ptr() <= first
    assert first + size == x.data_ptr() + x.numel() * 4
    monkeypatch.setattr(pages, "_advise", lambda: None)
    assert pages.in_large_pages(x) is x


def large() -> int:
    """Bytes of this process in large pages."""
    return 1024 * int(re.search(r"AnonHugePages: +(\d+) kB", Path("/proc/self/smaps_rollup").read_text())[1])
