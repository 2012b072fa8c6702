"""A large step is compiled in parts, by as many processes as there are cores, and no result shows it."""

import pytest
import torch
from test_regions import make_small, scan_of

from torchfra.compiler import build, cache, parts
from torchfra.compiler.compilers import CompileError
from torchfra.compiler.program import Program


@pytest.fixture
def large(monkeypatch, tmp_path):
    """Whatever has two functions is large; and a cache of its own."""
    make_small(monkeypatch.setattr)
    monkeypatch.setattr(parts, "_LARGE", 1)
    monkeypatch.setenv("TORCHFRA_CACHE", str(tmp_path))
    monkeypatch.setattr(cache, "_unkept", {})
    return tmp_path


@pytest.mark.slow
@pytest.mark.parametrize("cores", [1, 2, 3])
@pytest.mark.parametrize("narrow", [False, True], ids=["wide", "narrow"])
def test_a_step_in_parts_says_what_the_whole_says(large, monkeypatch, cores, narrow):
    tracks = 1 if narrow else 37
    draw = torch.Generator().manual_seed(0)
    tensors = [torch.rand(tracks, *shape, dtype=torch.float64, generator=draw) * 4 - 2 for shape in ((3,), (5, 4))]
    monkeypatch.setattr(build, "_cores", lambda: cores)
    scan, before = scan_of(7, 400), build.compiled
    assert scan.source(narrow).count("#if PARTS & ") > 3
    found = Program(scan, narrow)(torch.Size([tracks]), 5, tensors)
    assert build.compiled == before + 1
    assert len(list(large.iterdir())) == 1
    monkeypatch.setattr(parts, "_LARGE", 10**9)
    expected = Program(scan, narrow)(torch.Size([tracks]), 5, tensors)
    assert build.compiled == before + 2
    for a, b in zip(expected, found, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("cores", [1, 2, 5, 100])
def test_each_part_is_taken_once_and_none_has_much_more_to_do_than_another(cores):
    functions = {f"f{k}()": ["int x;"] * (200 + 97 * k % 800) for k in range(70)}
    source = parts.apart(functions)
    taken = parts.shares(source, cores)
    assert sum(taken) == sum({1 << k % 60 for k in range(70)})
    assert len(taken) == min(cores, 60)
    if cores < 10:
        work = [sum(200 + 97 * k % 800 for k in range(70) if mask >> k % 60 & 1) for mask in taken]
        assert max(work) < 1.1 * min(work)
    assert len(parts.shares(parts.together(functions), cores)) == 1


@pytest.mark.slow
def test_a_part_that_does_not_compile_is_named_with_its_compiler(large, monkeypatch):
    monkeypatch.setattr(build, "_cores", lambda: 2)
    monkeypatch.setenv("CXXFLAGS", "-O0 -Dpiece1=1")
    with pytest.raises(CompileError, match=r"(?s)-Dpiece1=1.*failed \(exit status 1\)"):
        Program(scan_of(7, 400))
    assert list(large.iterdir()) == []


def test_what_is_written_for_others_is_one_whole(large):
    scan = scan_of(7, 400)
    assert "PARTS &" not in scan.cuda()
    assert all("PARTS" not in text for text in scan.parts(narrow=True))
