"""Files that are changed in some places are read or refused, as ``scripts/fuzz.py`` tries for hours."""

import os

import fuzz
import numpy as np
import pytest

TRIES = {"tracks": 10, "ranges": 60, "values": 150, "kernels": 300}
"""Changes of each example."""


@pytest.mark.parametrize("target", fuzz.TARGETS)
def test_no_change_of_a_good_file_gives_anything_but_what_is_promised(target, tmp_path, monkeypatch):
    os.chmod(tmp_path, 0o700)
    monkeypatch.setenv("TORCHFRA_CACHE", str(tmp_path))
    random = np.random.default_rng(0)
    for example in fuzz.examples(target):
        fuzz.TARGETS[target](tmp_path, example)
        for _ in range(TRIES[target]):
            changed = bytearray(example)
            for place in random.integers(1, len(example), random.integers(1, 4)):
                changed[place] = random.integers(256)
            end = random.choice([len(example), random.integers(1, len(example))])
            fuzz.TARGETS[target](tmp_path, bytes(changed[:end]))
