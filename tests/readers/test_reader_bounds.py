"""No file takes more memory than it may: it is read piece by piece up to a bound, packed or plain, long or wide."""

import gzip
import json
import time
import tracemalloc
import zlib

import numpy as np
import pytest

from torchfra.cli.main import main
from torchfra.readers import read, read_ranges
from torchfra.readers.bounded import LONGEST_ROW


def packed(path, head, unit, count):
    """A gzip file of a unit that comes again and again, made without holding it."""
    packer = zlib.compressobj(1, zlib.DEFLATED, 31)
    with path.open("wb") as file:
        file.write(packer.compress(head))
        for _ in range(count):
            file.write(packer.compress(unit))
        file.write(packer.flush())
    return path


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


ROWS = b"0,1,2\n" * 2**17
BOMBS = {
    "zeros.csv.gz": (b"t,x,y\n0,0,0\n1,1,1\n", bytes(2**20), 200, "rows of at most 1048576 characters"),
    "spaces.json.gz": (b"[", b" " * 2**20, 200, "at most 1073741824 bytes of text, of which one of JSON counts for 24"),
    "names.csv.gz": (b"t,x,y", b",a234567" * 2**17, 130, "rows of at most 1048576 characters"),
    "quotes.csv.gz": (b"t,x,y\n0,0,0\n", b'"\n",' * 2**18, 100, "rows of at most 1048576 characters"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", BOMBS)
def test_a_packed_file_that_swells_is_refused_before_it_does(tmp_path, name):
    head, unit, count, said = BOMBS[name]
    path = packed(tmp_path / name, head, unit, count)
    assert path.stat().st_size < 2**20

    def refused():
        with pytest.raises(ValueError, match=f"{name}: expected {said}"):
            read(path)

    assert megabytes(refused) < 120


@pytest.mark.parametrize(
    ("name", "head", "unit", "said"),
    [
        ("rows.csv.gz", b"t,x,y\n", ROWS, "5000000 bytes of text, of which a row counts for 64 or more, received more"),
        ("blank.csv", b"t,x,y\n", b"\n" * 2**18, "of which a row counts for 64 or more"),
        ("rows.csv", b"t,x,y\n", ROWS[: 2**16 * 6], "5000000 bytes of text, of which a row counts for 64"),
        ("large.csv", b"t,x,y,note\n", b"0,1,2," + b"a" * 2**16 * 7 + b"\n", "5000000 bytes of text, received more"),
        ("large.csv.gz", b"t,x,y,note\n", (b"0,1,2," + b"a" * 2**16 + b"\n") * 7, "text, received more"),
        ("names.csv", b"time,icao24,lat,lon\n", b"".join(b"%d,%x,1,1\n" % (i, i) for i in range(2000)),
         "of which each name counts for 4096"),
        ("wide.csv", b"t,x,y" + b",a" * 2**20 + b"\n", b"1\n" * 2**15, "rows of at most"),
        ("list.json", b"[", b"[],", "of text, of which one of JSON counts for 24"),
    ],
)  # fmt: skip
def test_a_file_that_holds_more_than_it_may_is_refused_and_the_message_says_how_to_raise_that(
    tmp_path, name, head, unit, said
):
    content = head + unit * (2**17 if name.startswith("list") else 12)
    path = tmp_path / name
    path.write_bytes(gzip.compress(content) if name.endswith("gz") else content)
    with pytest.raises(ValueError, match=said) as raised:
        read(path, max_bytes=5_000_000)
    assert name.startswith("wide") or "max_bytes (--max-bytes) raises that" in str(raised.value)


def test_a_bound_that_is_raised_or_lowered_holds(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("t,x,y\n" + "".join(f"{i},{i},{i}\n" for i in range(100)))
    assert len(read(path, max_bytes=6500)[0].time) == 100
    with pytest.raises(ValueError, match="expected at most 6000 bytes"):
        read(path, max_bytes=6000)
    records = tmp_path / "a.json"
    records.write_text(json.dumps([{"t": i, "x": i, "y": i} for i in range(100)]))
    size = records.stat().st_size
    assert len(read(records, max_bytes=24 * size)[0].time) == 100
    with pytest.raises(ValueError, match="JSON counts for 24"):
        read(records, max_bytes=24 * size - 24)
    for bound in (0, -1, 1.5, True, "1", None):
        with pytest.raises(ValueError, match="max_bytes: expected a whole number above 0, received"):
            read(path, max_bytes=bound)


def test_the_bound_holds_for_every_file_of_ranges_too(tmp_path):
    for name, text in {
        "ranges.csv": "t,anchor,range\n" + "".join(f"{i},a,{i + 1}\n" for i in range(100)),
        "anchors.csv": "anchor,x,y\n" + "a,0,0\n" * 100,
        "path.csv": "t,x,y\n" + "".join(f"{i},{i},{i}\n" for i in range(100)),
    }.items():
        (tmp_path / name).write_text(text)
    ranges, anchors, path = (tmp_path / f"{name}.csv" for name in ("ranges", "anchors", "path"))
    assert read_ranges(tmp_path, max_bytes=6500).names == ("a",)
    for source, options in ((tmp_path, {}), (ranges, {"anchors": anchors}), (ranges, {"reference": path})):
        with pytest.raises(ValueError, match="csv: expected at most 6000 bytes of text, of which a row counts for 64"):
            read_ranges(source, **options, max_bytes=6000)


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


def test_rows_as_long_as_they_may_be_are_read_and_longer_ones_are_not(tmp_path):
    path = tmp_path / "a.csv"
    cells = ["a" * 100_000] * 10
    header = "t,x,y," + ",".join(map(str, range(10)))
    path.write_text(f"{header}\n" + "".join(f"{i},{i},{i},{','.join(cells)}\n" for i in range(5)))
    assert read(path)[0].time.tolist() == [0, 1, 2, 3, 4]
    path.write_text(f"{header}\n0,0,0,{','.join(cells * 3)}\n")
    with pytest.raises(ValueError, match=f"rows of at most {LONGEST_ROW} characters"):
        read(path)


def test_quotes_lines_and_line_ends_are_read_alike_wherever_a_piece_ends(tmp_path, monkeypatch):
    text = 't,x,y,note\r\n0,1,2,"a\r\nb"\r\n1,2,3,"c ""d"", e"\r\n\r\n2,3,4,f\r3,4,5,\n4,5,6,g'
    for length in range(25, len(text) + 2):
        monkeypatch.setattr("torchfra.readers.bounded.LONGEST_ROW", length)
        path = tmp_path / "a.csv"
        path.write_bytes(text.encode())
        np.testing.assert_array_equal(read(path)[0].position, [[1, 2], [2, 3], [3, 4], [4, 5], [5, 6]])


@pytest.mark.parametrize("end", ["", "\n"])
@pytest.mark.parametrize("of", [lambda k: f"2024-05-01T12:00:{k:02}Z", lambda k: str(1714564800000 + 1000 * k)])
def test_a_file_of_several_pieces_may_end_without_a_new_line(of, end, tmp_path, monkeypatch):
    monkeypatch.setattr("torchfra.readers.bounded.LONGEST_ROW", 100)
    path = tmp_path / "a.csv"
    path.write_text("\n".join(["time,x,y", *(f"{of(k)},{10 * k},{5 * k}" for k in range(50))]) + end)
    (recording,) = read(path)
    assert recording.time.tolist() == [1714564800.0 + k for k in range(50)]


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
        assert "expected at most 600 bytes of text" in capsys.readouterr().err
    assert (
        main(["track", str(path), "--max-bytes", "6500", "--out", str(tmp_path / "out"), "--no-plots", "--quiet"]) == 0
    )
    assert main(["compare", "--scenario", "growth", "--max-bytes", "1"]) == 2
    assert "max_bytes: expected beside files or --ranges" in capsys.readouterr().err
