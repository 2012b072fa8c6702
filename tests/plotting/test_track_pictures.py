"""Pictures of cleaned tracks answer: where it was, how sure that is, what was rejected and where, what was flown."""

from dataclasses import replace

import numpy as np
import pytest
from cleaned_tracks import straight
from matplotlib.colors import to_rgb
from matplotlib.text import Text

import torchfra
from torchfra import plotting
from torchfra.cleaning import Segment, figures
from torchfra.cleaning.outputs.view import Band, placed, view
from torchfra.pictures import APART, BLUE, GREY, ORANGE, RED, REGIMES
from torchfra.plotting.style import line_styles


def panels(figure):
    return {axes.get_label(): axes for axes in figure.axes}


def texts(axes):
    return [text.get_text() for text in axes.texts]


def marks(axes, marker):
    """Places ``(k, 2)`` of the marks of a kind."""
    found = [line.get_xydata() for line in axes.lines if line.get_marker() == marker and line.get_linestyle() == "None"]
    return np.concatenate(found) if found else np.empty((0, 2))


# ---------------------------------------------------------------- one target


def test_a_rejected_fix_is_drawn_where_it_was_recorded():
    of = straight(40)
    axes = panels(figures.cleaned(of))["map"]
    np.testing.assert_allclose(marks(axes, "x"), of.raw[[7], :2] / 1000)
    assert {"cleaned", "recorded", "rejected", "manoeuvre"} <= set(texts(axes))
    assert axes.get_title(loc="left") == ""


def test_the_map_shows_the_track_and_lists_at_its_edge_what_is_far_off():
    of = straight(40, rejected=(7, 9), off=3.5e6)
    axes = panels(figures.cleaned(of))["map"]
    limits = np.array([axes.get_xlim(), axes.get_ylim()])
    assert (np.diff(limits) < 20).all()  # km; the track is 8 km long
    assert axes.get_title(loc="left").startswith("outside: 2 rejected, up to 4,950 km off")
    triangles = [line.get_xydata()[0] for line in axes.lines if isinstance(line.get_marker(), tuple)]
    assert len(triangles) == 2
    on_edge = np.isclose(np.array(triangles)[:, :, None], limits[None]).any((1, 2))
    assert on_edge.all()


def test_what_is_listed_at_the_edge_is_below_the_title():
    of = replace(straight(40, rejected=(7, 9), off=3.5e6), segments=())  # whose names would make room
    figure = figures.cleaned(of)
    figure.draw_without_rendering()
    listed = next(text for text in figure.findobj(Text) if text.get_text().startswith("outside"))
    assert not listed.get_window_extent().overlaps(figure._suptitle.get_window_extent())


def test_a_map_has_the_same_scale_along_both_axes():
    figure = figures.cleaned(straight(40))
    axes = panels(figure)["map"]
    box = axes.get_window_extent()
    assert np.ptp(axes.get_xlim()) / box.width == pytest.approx(np.ptp(axes.get_ylim()) / box.height)


def test_the_band_is_two_standard_deviations_across_to_each_side():
    of = straight(40)
    shown = view(of)
    middle = shown.sides.mean(1)
    np.testing.assert_allclose(middle, shown.path)
    across = np.array([60.0, -80.0]) / 100
    std = np.sqrt(across @ of.covariance[0, :2, :2] @ across)
    np.testing.assert_allclose(np.linalg.norm(shown.sides[:, 0] - shown.sides[:, 1], axis=1) * 1000, 4 * std, rtol=1e-3)


def test_panels_over_time_are_speed_altitude_and_manoeuvres_where_one_is_likely():
    assert panels(figures.cleaned(straight(40))).keys() == {"map", "speed", "altitude"}
    flat = replace(straight(40, d=2), manoeuvre=np.linspace(0.0, 1.0, 40))
    shown = panels(figures.cleaned(flat))
    assert shown.keys() == {"map", "speed", "manoeuvre"}
    (area,) = shown["manoeuvre"].collections
    assert area.get_paths()[0].get_extents().ymax == 1.0


def test_turns_are_shaded_and_named_beside_the_speed_and_climbs_beside_the_altitude():
    of = replace(straight(40), segments=(Segment(10, 30, "left turn", 2.5), Segment(40, 60, "climbing", 5.0)))
    shown = panels(figures.cleaned(of))
    for name, seconds, kind in (("speed", (10, 30), "left turn, 2.5 deg/s"), ("altitude", (40, 60), "climbing, 5 m/s")):
        spans = [
            (p.get_x(), p.get_x() + p.get_width())
            for p in shown[name].patches
            if to_rgb(p.get_facecolor()) == to_rgb(ORANGE)
        ]
        assert spans == [seconds]
        assert texts(shown[name]) == [kind]


def test_a_fix_that_is_off_in_height_alone_is_rejected_there_and_not_on_the_map():
    time = np.arange(60.0)
    fixes = np.stack([20 * time, 5 * time, 100 + 0 * time], 1) + np.random.default_rng(0).standard_normal((60, 3))
    fixes[20, 0] += 300
    fixes[40, 2] += 300
    shown = panels(figures.cleaned(torchfra.clean((time, fixes))))
    np.testing.assert_allclose(marks(shown["map"], "x"), fixes[[20], :2])
    np.testing.assert_allclose(marks(shown["altitude"], "x"), [[40, fixes[40, 2]]])


@pytest.mark.parametrize("change", [
    {"mean": np.full((40, 6), np.nan)}, {"nis": np.full(40, np.nan)}, {"covariance": np.full((40, 6, 6), np.nan)},
    {"flag": np.full(40, "outlier")}, {"outlier": np.full(40, np.nan)},
])  # fmt: skip
def test_nothing_that_a_filter_does_breaks_a_picture(change, tmp_path):
    figure = figures.cleaned(replace(straight(40), **change))
    assert plotting.save(figure, tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("steps", [1, 2, 3])
def test_a_short_track_makes_a_picture(steps, tmp_path):
    assert plotting.save(figures.cleaned(straight(steps)), tmp_path / "a.png").exists()


def test_words_on_the_map_do_not_cover_each_other():
    axes = panels(figures.cleaned(straight(40)))["map"]
    axes.figure.draw_without_rendering()
    boxes = [Text.get_window_extent(text) for text in axes.texts]
    assert len(boxes) == 4
    assert not [1 for i, a in enumerate(boxes) for b in boxes[:i] if a.overlaps(b)]


# ---------------------------------------------------------------- colours

# Machado, Oliveira & Fernandes (2009), severity 1, of linear RGB.
SEEN = {
    "all": np.eye(3),
    "without red": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "without green": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
    "without blue": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]],
}


def lab(colour, seen):
    """CIELAB of a colour, as people see it who lack a kind of cone."""
    rgb = np.array(to_rgb(colour))
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    linear = np.clip(np.array(SEEN[seen]) @ linear, 0, 1)
    xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]) @ linear
    f = np.where(
        xyz / [0.9505, 1, 1.089] > 0.008856,
        np.cbrt(xyz / [0.9505, 1, 1.089]),
        7.787 * xyz / [0.9505, 1, 1.089] + 16 / 116,
    )
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


@pytest.mark.parametrize("seen", SEEN)
@pytest.mark.parametrize("colours", [APART, REGIMES, (BLUE, GREY, RED, ORANGE)])
def test_colours_of_one_picture_are_told_apart_by_everybody(colours, seen):
    places = [lab(colour, seen) for colour in colours]
    distances = [np.linalg.norm(a - b) for i, a in enumerate(places) for b in places[:i]]
    assert min(distances) > 10  # 2.3 is just noticeable


def test_every_line_has_a_look_of_its_own_and_the_first_a_colour_of_their_own():
    looks = line_styles([f"filter {i}" for i in range(20)]).values()
    assert len({(look["color"], look["linestyle"]) for look in looks}) == 20
    assert len({look["color"] for look in list(looks)[: len(APART)]}) == len(APART) == 7


def test_the_axis_of_altitudes_has_room_for_what_is_recorded_but_for_outliers():
    rng = np.random.default_rng(0)
    recorded = 100.0 + 10.0 * rng.standard_normal(400)
    recorded[7] = 1e5
    low, high = Band(np.full(400, 100.0), np.full(400, 0.5), recorded).limits()
    assert ((recorded < low) | (recorded > high)).mean() < 0.02
    assert high < 200


def test_a_title_with_a_long_name_keeps_what_it_says_of_the_track():
    title = view(replace(straight(40), recording=replace(straight(40).recording, name="long" * 40))).title
    assert len(title) < 110
    assert "40 fixes" in title


def test_a_spike_of_the_path_does_not_set_the_scale_of_the_map_or_of_the_speed():
    of = straight(40)
    spiked = replace(of, mean=of.mean.copy())
    spiked.mean[20] += 1e6
    np.testing.assert_allclose(np.ptp(view(spiked).window, 0), np.ptp(view(of).window, 0), rtol=0.2)
    assert np.ptp(view(spiked).speed.limits()) < 2 * np.ptp(view(of).speed.limits())


def test_names_of_many_manoeuvres_do_not_lie_on_each_other():
    shown = view(straight(40))
    end, name = shown.time[-1], "left turn, 2.5 deg/s"
    many = shown.speed._replace(manoeuvres=[(end * i / 56, end * (i + 0.5) / 56, name) for i in range(56)])
    found = placed(shown, many, 76)
    assert len(found) >= 4
    for row in (0, 1):
        middles = sorted(middle for middle, at, _ in found if at == row)
        assert np.diff(middles).min() > len(name) / 76
        assert len(name) / 152 <= middles[0] <= middles[-1] <= 1 - len(name) / 152
