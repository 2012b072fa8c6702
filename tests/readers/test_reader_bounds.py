"""No file is read beyond a bound, and rows take little more memory than their numbers."""

import gzip
import json
import time
import tracemalloc

import numpy as np
import pytest

from torchfra.cli.main import main
from torchfra.readers import read, read_ranges


def megabytes(work):
    """What a call needs at its peak; it may be refused."""
    tracemalloc.start()
    try:
        work()
    except ValueError:
        pass
    finally:
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    return peak / 2**20


@pytest.mark.parametrize("name", ["a.csv", "a.csv.gz", "a.json", "a.json.gz"])
def test_a_file_that_holds_more_than_it_may_is_refused_and_the_message_says_how_to_raise_that(tmp_path, name):
    rows = [{"t": i, "x": i, "y": i} for i in range(100)]
    table = "t,x,y\n" + "".join("{t},{x},{y}\n".format(**row) for row in rows)
    content = (json.dumps(rows) if "json" in name else table).encode()
    (tmp_path / name).write_bytes(gzip.compress(content) if name.endswith("gz") else content)
    size = len(content) * (24 if "json" in name else 1)
    assert len(read(tmp_path / name, max_bytes=size)[0].time) == 100
    with pytest.raises(ValueError, match=rf"{name}: expected at most {size - 1} bytes.*--max-bytes\) raises that"):
        read(tmp_path / name, max_bytes=size - 1)
    for bound in (0, -1, 1.5, True, "1", None):
        with pytest.raises(ValueError, match="max_bytes: expected a whole number above 0, received"):
            read(tmp_path / name, max_bytes=bound)


def seconds(work):
    begin = time.process_time()
    work()
    return time.process_time() - begin


@pytest.mark.slow
def test_many_anchors_do_not_take_the_square_of_their_number(tmp_path):
    took = []
    for count in (500, 8_000):
        path = tmp_path / f"{count}.csv"
        path.write_text("t,anchor,range,x,y\n" + "".join(f"1,a{i},2,0,0\n" for i in range(count)))
        took.append(seconds(lambda path=path: read_ranges(path)))
    assert took[1] < 80 * took[0]  # the square would be 256


@pytest.mark.slow
def test_many_names_of_columns_in_json_do_not_take_the_square_of_their_number(tmp_path):
    took = []
    for count in (1_000, 4_000):
        path = tmp_path / f"{count}.json"
        path.write_text(json.dumps([{"t": i, "x": i, "y": i, f"more {i}": 0} for i in range(count)]))
        took.append(seconds(lambda path=path: read(path)))
    assert took[1] < 10 * took[0]  # 16 for the square


@pytest.mark.slow
def test_a_long_file_is_read_in_a_few_times_its_numbers(tmp_path):
    rows = 150_000
    path = tmp_path / "a.csv"
    path.write_text("t,x,y,z\n" + "".join(f"{i},{i}.25,{-i}.5,{i % 7}\n" for i in range(rows)))
    found = []
    peak = megabytes(lambda: found.extend(read(path)))
    np.testing.assert_array_equal(found[0].position[:, 0], np.arange(rows) + 0.25)
    np.testing.assert_array_equal(found[0].position[:, 2], np.arange(rows) % 7)
    assert peak < 20 + rows * 150 / 2**20  # 32 bytes of the result; cells as text would be 270 more


def test_the_commands_have_the_bound_as_an_option(tmp_path, capsys):
    path = tmp_path / "a.csv"
    path.write_text("t,x,y\n" + "".join(f"{i},{i},{i}\n" for i in range(100)))
    for command in (["track", path], ["compare", path], ["compare", "--ranges", path]):
        assert main([*map(str, command), "--max-bytes", "600"]) == 2
        assert "expected at most 600 bytes" in capsys.readouterr().err
    assert (
        main(["track", str(path), "--max-bytes", "6500", "--out", str(tmp_path / "out"), "--no-plots", "--quiet"]) == 0
    )
    assert main(["compare", "--scenario", "growth", "--max-bytes", "1"]) == 2
    assert "max_bytes: expected beside files or --ranges" in capsys.readouterr().err
