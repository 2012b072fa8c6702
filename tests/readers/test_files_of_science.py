"""Files of motion capture, simulated traffic and robots are read, or refused with the options that read them."""

from __future__ import annotations

import re

import numpy as np
import pytest

from torchfra.readers import read

ROWS = 120
X, Y = 100 + 2.0 * np.arange(ROWS), 50 + np.sin(np.arange(ROWS) / 9)


def options_of(error):
    """What the message says that the columns look like, as keywords."""
    pairs = re.findall(r"--([a-z-]+) ('[^']*'|[^ ,]+)", str(error.value).partition("looks like")[2])
    return {name.replace("-", "_"): value.strip("'") for name, value in pairs}


def marker(i, x=X, y=Y):
    return f"{x[i]:.3f},{y[i]:.3f},0.99"


DEEPLABCUT = [
    "scorer,net,net,net,net,net,net", "bodyparts,nose,nose,nose,tail,tail,tail",
    "coords,x,y,likelihood,x,y,likelihood", *(f"{i},{marker(i)},{marker(i, X - 9)}" for i in range(ROWS)),
]  # fmt: skip
SLEAP = [
    "track,frame_idx,instance.score,nose.x,nose.y,nose.score",
    *(f"track_0,{i},0.9,{marker(i)}" for i in range(ROWS)),
]  # fmt: skip
VICON = [
    "Trajectories", "100", ",,Cube:M1,,,Cube:M2,,", "Frame,Sub Frame,X,Y,Z,X,Y,Z", ",,mm,mm,mm,mm,mm,mm",
    *(f"{i + 1},0,{marker(i, 1000 * X, 1000 * Y)},{marker(i)}" for i in range(ROWS)),
]  # fmt: skip
QUALISYS = [
    "NO_OF_FRAMES\t120", "FREQUENCY\t100", "MARKER_NAMES\thip", "Frame\tTime\thip X\thip Y\thip Z",
    *(f"{i + 1}\t{i / 100:.5f}\t{X[i]}\t{Y[i]}\t{i}" for i in range(ROWS)),
]  # fmt: skip


def test_simulated_traffic_in_xml_is_read_by_the_attributes_of_its_elements(write):
    lines = ["<fcd-export>"]
    for i in range(ROWS):
        cars = (f'<vehicle id="v{k}" x="{X[i] + 30 * k}" y="{Y[i]}" speed="2"/>' for k in range(2))
        lines += [f'<timestep time="{i}.00">', *cars, "</timestep>"]
    tracks = read(write([*lines, "</fcd-export>"], "a.xml"))
    assert [track.name for track in tracks] == ["v0", "v1"]
    np.testing.assert_allclose(tracks[1].position, np.stack([X + 30, Y], 1))


def test_other_xml_is_refused_with_what_to_write(write):
    with pytest.raises(ValueError, match="received other XML: write its points as CSV under time,x,y or"):
        read(write(["<VOTABLE><TR><TD>1</TD></TR></VOTABLE>"], "a.xml"))


@pytest.mark.parametrize("header", [
    "# timestamp tx ty tz qx", "#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w []",
])  # fmt: skip
def test_trajectories_of_robots_have_their_header_in_a_comment(write, header):
    sign = "," if "," in header else " "
    start = 1403636580838555648 if "," in header else 1403636580
    step = 10**8 if "," in header else 1
    rows = [sign.join(map(str, (start + i * step, X[i], Y[i], i, 0.5))) for i in range(ROWS)]
    (track,) = read(write(["# a trajectory", header, *rows], "a.txt"))
    np.testing.assert_allclose(track.position, np.stack([X, Y, np.arange(ROWS)], 1))
