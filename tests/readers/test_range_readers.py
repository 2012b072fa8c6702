"""Reading ranges: every layout of files gives the same recording, repairs are counted, the rest is refused by name."""

import gzip
import json

import numpy as np
import pytest

from torchfra import readers
from torchfra.readers import range_folders, read_ranges

PLACES = {"A3": (0.0, 0.0, 2.0), "A5": (6.0, 0.0, 2.0), "A9": (0.0, 8.0, 1.0)}
TIMES = np.array([100.0, 100.1, 100.2, 100.3])
START = 1_700_000_000


def metres(name):
    """Ranges of an anchor at ``TIMES``."""
    return np.array([2.0, 2.5, 3.0, 3.5]) + list(PLACES).index(name)


def device(name, unit=1e9):
    """A file of an anchor as a device writes it: nanoseconds, long names, and columns that do not matter."""
    x, y, z = PLACES[name]
    rows = [f"{START + t + 9:.1f},{(START + t) * unit:.1f},{name[1:]},{x},{y},{z},{r},-79.5"
            for t, r in zip(TIMES, metres(name), strict=True)]  # fmt: skip
    return "\n".join(["%time,field.stamp,field.id,field.x,field.y,field.z,field.distanceFromTag,field.rssi", *rows])


def plain(name, places=True):
    rows = [",".join(map(str, (t, r, *(PLACES[name] if places else ())))) for t, r in
            zip(START + TIMES, metres(name), strict=True)]  # fmt: skip
    return "\n".join(["t,range" + ",x,y,z" * places, *rows])


def together(places=False):
    rows = [",".join(map(str, (START + t, n, r, *(PLACES[n] if places else ())))) for k, t in enumerate(TIMES)
            for n in PLACES for r in [metres(n)[k]]]  # fmt: skip
    return "\n".join(["t,anchor,range" + ",x,y,z" * places, *rows])


PATH = "timestamp,x,y,z,heading\n" + "\n".join(f"{(START + t) * 1e9:.0f},{t - 100},1,0.5,0" for t in TIMES)
ANCHORS = "anchor,x,y,z\n" + "\n".join(f"{name},{x},{y},{z}" for name, (x, y, z) in PLACES.items())


@pytest.fixture
def write(tmp_path):
    """Writes files into a folder by their names; returns the folder."""

    def write(folder="walk", **files):
        place = tmp_path / folder
        place.mkdir(parents=True, exist_ok=True)
        for name, content in files.items():
            (place / name.replace("_", ".")).write_bytes(
                gzip.compress(content.encode()) if name.endswith("gz") else content.encode()
            )
        return place

    return write


def check(recording, path=True):
    """The recording of all three anchors, whatever file it came from."""
    assert set(recording.names) == set(PLACES)
    for name, place, time, ranges in zip(
        recording.names, recording.anchors, recording.times, recording.ranges, strict=True
    ):
        np.testing.assert_array_equal(place, PLACES[name])
        np.testing.assert_allclose(time, START + TIMES, rtol=0, atol=1e-6)
        np.testing.assert_array_equal(ranges, metres(name))
    if path:
        np.testing.assert_allclose(recording.reference.time, START + TIMES, rtol=0, atol=1e-6)
        np.testing.assert_allclose(recording.reference.position[:, 0], TIMES - 100)
    assert recording.repairs == {}


# ---------------------------------------------------------------- layouts


def test_a_folder_with_a_file_for_each_anchor_and_the_path_is_a_recording(write):
    folder = write(**{f"{name}_csv": device(name) for name in PLACES}, trajectory_csv=PATH, results_txt="RMSD 0.3")
    recording = read_ranges(folder)
    check(recording)
    assert recording.name == folder.as_posix()


@pytest.mark.parametrize("unit", [1.0, 1e3, 1e6, 1e9])
def test_times_are_seconds_or_parts_of_them_since_1970(write, unit):
    check(read_ranges(write(**{f"{name}_csv": device(name, unit) for name in PLACES})), path=False)


def test_plain_columns_compressed_files_and_json_are_read_too(write):
    records = [{"t": START + t, "range": r, "x": 0, "y": 8, "z": 1} for t, r in zip(TIMES, metres("A9"), strict=True)]
    check(read_ranges(write(A3_csv=plain("A3"), A5_csv_gz=plain("A5"), A9_json=json.dumps(records), path_csv=PATH)))


def test_one_file_with_a_column_of_anchors_and_places_from_columns_or_a_file(write):
    folder = write(ranges_csv=together(), anchors_csv=ANCHORS, path_csv=PATH)
    check(read_ranges(folder))
    check(read_ranges([folder / "ranges.csv", folder / "path.csv"], anchors=folder / "anchors.csv"))
    check(read_ranges(folder / "ranges.csv", anchors=folder / "anchors.csv", reference=folder / "path.csv"))
    check(read_ranges(write("other", ranges_csv=together(places=True)) / "ranges.csv"), path=False)


def test_files_of_single_anchors_find_their_places_by_name_or_by_number(write):
    files = write(**{f"{name}_csv": plain(name, places=False) for name in PLACES})
    places = write("more", anchors_csv=ANCHORS, numbers_csv=ANCHORS.replace("\nA", "\n"))
    check(read_ranges(files, anchors=places / "anchors.csv"), path=False)
    files = write("by-number", **{f"{name}_csv": device(name).replace(f",{PLACES[name][0]},", ",,") for name in PLACES})
    check(read_ranges(files, anchors=places / "numbers.csv"), path=False)


def test_a_file_of_places_goes_before_the_columns(write):
    moved = ANCHORS.replace("A3,0.0", "A3,7.0")
    recording = read_ranges(write(ranges_csv=together(places=True)), anchors=write("m", a_csv=moved) / "a.csv")
    assert recording.anchors[0].tolist() == [7.0, 0.0, 2.0]


def test_anchors_in_the_plane_have_two_coordinates(write):
    folder = write(
        ranges_csv=together(), anchors_csv="anchor,x,y\nA3,0,0\nA5,6,0\nA9,0,8", path_csv="t,x,y\n0,1,1\n1,2,2"
    )
    recording = read_ranges(folder)
    assert recording.anchors.tolist() == [[0, 0], [6, 0], [0, 8]]
    assert recording.reference.position.tolist() == [[1, 1], [2, 2]]


def test_folders_below_one_are_recordings_of_their_own(write):
    one, two = write("day/a", A3_csv=plain("A3")), write("day/b/c", A3_csv=plain("A3"))
    (one.parent / "notes").mkdir()
    assert range_folders(one.parent) == [one, two]
    assert range_folders(two) == [two]
    with pytest.raises(ValueError, match=r"notes: expected CSV or JSON files there or below, received none"):
        range_folders(one.parent / "notes")


# ---------------------------------------------------------------- repairs


def test_rows_are_repaired_and_counted(write):
    lines = plain("A3").splitlines()
    first, second, third, fourth = lines[1:]
    broken = [
        lines[0], third, first, second, second.replace("2.5", "9.0"), fourth, "nan,3.0,0,0,2",
        f"{START + 102},,0,0,2", f"{START + 103},-1.0,0,0,2", f"{START + 104},nan,0,0,2",
    ]  # fmt: skip
    recording = read_ranges(write(A3_csv="\n".join(broken)))
    np.testing.assert_array_equal(recording.ranges[0], metres("A3"))
    assert recording.repairs == {
        "rows without time dropped": 1, "rows without range dropped": 2, "rows put in time order": 3,
        "duplicate times dropped": 1, "ranges that are not above 0 dropped": 1,
    }  # fmt: skip


def test_the_path_is_repaired_and_keeps_its_stops(write):
    path = "t,x,y\n2,1,1\n0,0,0\n1,1,1\n1,5,5\n3,,1\n"
    recording = read_ranges(write(A3_csv=plain("A3"), path_csv=path))
    assert recording.reference.position.tolist() == [[0, 0], [1, 1], [1, 1]]
    assert recording.reference.repairs == {
        "rows without position dropped": 1, "rows put in time order": 3, "duplicate times dropped": 1
    }  # fmt: skip


def test_what_is_no_part_of_a_recording_is_counted_in_a_folder(write):
    folder = write(A3_csv=plain("A3"), A5_csv="t,range,x,y,z", results_csv="case,rmsd\n1,0.3")
    recording = read_ranges(folder)
    assert recording.names == ("A3",)
    assert recording.repairs == {"files of another kind left out": 1, "anchors without ranges dropped": 1}
    unnamed = together(places=True) + f"\n{START + 101},,3.0,0,0,2"
    assert read_ranges(write("b", r_csv=unnamed)).repairs == {"rows without anchor dropped": 1}


# ---------------------------------------------------------------- the grid


def recording(times, ranges, path=None):
    names = tuple(f"A{i}" for i in range(len(times)))
    reference = None if path is None else readers.Recording("p", *map(np.array, path), None, {})
    arrays = [tuple(map(np.array, x)) for x in (times, ranges)]
    return readers.RangeRecording("walk", names, np.zeros((len(times), 2)), *arrays, reference, {})


def test_ranges_stand_at_the_nearest_step_and_missing_ones_are_nan():
    grid = recording([[0.0, 1.04, 2.96], [0.9, 2.2]], [[1.0, 2.0, 3.0], [4.0, 5.0]]).on_grid(1.0)
    np.testing.assert_allclose(grid.time, [0, 1, 2])
    np.testing.assert_array_equal(grid.ranges, [[1, np.nan], [2, 4], [np.nan, 5]])
    assert grid.reference is None
    assert grid.dropped == 0


def test_of_two_ranges_in_a_step_the_later_one_counts():
    grid = recording([[0.0, 0.96, 1.04, 2.0]], [[1.0, 2.0, 3.0, 4.0]]).on_grid(1.0)
    np.testing.assert_array_equal(grid.ranges[:, 0], [1, 3, 4])
    assert grid.dropped == 1


def test_the_grid_stays_within_the_path_which_goes_straight_between_its_fixes():
    one = recording([np.arange(10.0)], [np.arange(10.0)], ([1.5, 3.5, 7.0], [[0.0, 0.0], [2.0, 4.0], [2.0, 4.0]]))
    grid = one.on_grid(0.5)
    assert (grid.time[0], grid.time[-1]) == (1.5, 7.0)
    np.testing.assert_allclose(grid.reference[:4], [[0, 0], [0.5, 1], [1, 2], [1.5, 3]])
    np.testing.assert_allclose(grid.reference[5:], np.array([[2.0, 4.0]] * 7))


@pytest.mark.parametrize(
    ("path", "dt", "said"),
    [
        (None, 0.0, "dt: expected seconds above 0, received 0.0"),
        (None, np.nan, "dt: expected seconds above 0, received nan"),
        (None, 1e-9, "walk: expected at most 10000000 steps, received 1 s in steps of 1e-09 s"),
        (([5.0, 6.0], [[0.0, 0.0]] * 2), 0.1, "walk: expected ranges while the reference path was recorded"),
    ],
)
def test_what_does_not_fit_a_grid_is_named(path, dt, said):
    with pytest.raises(ValueError, match=said):
        recording([[0.0, 1.0]], [[1.0, 2.0]], path).on_grid(dt)


# ---------------------------------------------------------------- refusals


HEADER = r"expected a header with t,range\[,anchor\]\[,x,y\[,z\]\]; or t,x,y\[,z\]; or anchor,x,y\[,z\]"


@pytest.mark.parametrize(
    ("files", "said"),
    [
        ({"a_csv": "1,2,3\n4,5,6"}, rf"a\.csv: {HEADER}.*; received 1, 2, 3"),
        ({"a_csv": ""}, r"a\.csv: expected a track, received an empty file"),
        ({"a_csv": "case,rmsd\n1,0.3"}, "expected ranges above 0 with their times, received none"),
        ({"a_csv": "t,range,range\n1,2,3"}, r"a\.csv: expected every column once, received several named range"),
        ({"a_csv": "t,range,x,y\n1,far,0,0"},
         r"a\.csv: expected a number of metres in data row 1, column range, received 'far'"),
        ({"a_csv": "t,range,x,y\n1,2,0,0\nnoon,2,0,0"}, r"a\.csv: expected a number in data row 2, column t, .* 'noo"),
        ({"a_csv": "t,field.range,x,y\n1,2,0,0\n2,1e99,0,0"}, r"data row 2, column field\.range, received '1e99'"),
        ({"a_csv": "t,range,x,y\n1,2,0,0\n2,2,0,0.5"},
         r"a\.csv: expected an anchor that stands still, received a with y from 0 to 0\.5 m"),
        ({"a_csv": "anchor,x,y\nA3,0,0\nA3,1,0"}, r"a\.csv: expected an anchor that stands still, received A3 with x"),
        ({"a_csv": "t,range\n1,2"}, "expected x and y of every anchor, received none for a"),
        ({"a_csv": "t,range,x,y\n1,0,0,0"}, "expected ranges above 0 with their times, received none"),
        ({"a_csv": "t,range,x,y,z\n1,2,0,0,1", "b_csv": "t,range,x,y\n1,2,0,0"},
         "expected z of every anchor or of none, received none for b"),
        ({"a_csv": "t,range,x,y\n1,2,0,0", "p_csv": "t,x,y\n0,0,0"},
         r"p\.csv: expected 2 or more rows with time and position, received 1"),
        ({"a_csv": "t,range,x,y\n1,2,0,0", "p_csv": "t,x,y\n0,0,0\n1,1,1", "q_csv": "t,x,y\n0,0,0\n1,1,1"},
         "expected one reference path, received p, q"),
        ({"a_csv": "t,anchor,range,x,y\n1,A3,2,0,0", "b_csv": "t,anchor,range,x,y\n1,A3,2,0,0"},
         "expected every anchor in one file, received several with A3"),
        ({}, "expected CSV or JSON files, received none"),
    ],
)  # fmt: skip
def test_a_recording_that_cannot_be_used_is_refused_by_file_row_and_column(write, files, said):
    with pytest.raises(ValueError, match=said):
        read_ranges(write(**files))


def test_files_that_are_named_must_be_of_their_kind(write):
    folder = write(a_csv=plain("A3"), b_csv="case,rmsd\n1,0.3", p_csv=PATH)
    with pytest.raises(ValueError, match=rf"b\.csv: {HEADER}.*; received case, rmsd"):
        read_ranges([folder / "a.csv", folder / "b.csv"])
    with pytest.raises(
        ValueError, match=r"p\.csv: expected rows with the columns anchor,x,y\[,z\], received a file of"
    ):
        read_ranges(folder / "a.csv", anchors=folder / "p.csv")
    with pytest.raises(
        ValueError, match=r"a\.csv: expected rows with the columns t,x,y\[,z\], received a file of anoth"
    ):
        read_ranges(folder / "a.csv", reference=folder / "a.csv")
    with pytest.raises(ValueError, match="source: expected a folder or files, received none"):
        read_ranges([])
    with pytest.raises(FileNotFoundError):
        read_ranges(folder / "none.csv")
