"""Trajectories of robots are read, and other XML is refused with what to write."""

from __future__ import annotations

import numpy as np
import pytest

from torchfra.readers import read

ROWS = 120
X, Y = 100 + 2.0 * np.arange(ROWS), 50 + np.sin(np.arange(ROWS) / 9)


def test_other_xml_is_refused_with_what_to_write(write):
    with pytest.raises(ValueError, match=r"received other XML: .* write points as CSV under time,x,y or"):
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
