"""What targets are is taken from the format, the columns and the species that a file names."""

import pytest

from torchfra.cleaning.kinds import kind_of
from torchfra.readers import read, species

ROWS = 30


def rows(header, *cells):
    """A file with a fix a minute, and cells beside each."""
    return [f"time,lat,lon,{header}", *(f"{60 * i},{47 + i / 1e4:.5f},8.3,{','.join(cells)}" for i in range(ROWS))]


@pytest.mark.parametrize(
    ("header", "cell", "kind"),
    [
        ("individual-taxon-canonical-name,individual-local-identifier", "Ciconia ciconia,Max", "bird"),
        ("individual-taxon-canonical-name,individual-local-identifier", "Chelonia mydas,Max", "marine"),
        ("individual-taxon-canonical-name,individual-local-identifier", "Canis lupus,Max", "animal"),
        ("Species", "Griffon Vulture", "bird"),
        ("DeployID,Error Semi-major axis", "Turtle7,400", "marine"),
        ("device_id,solar_I_mA", "201234,12", "bird"),
        ("height_above_takeoff(feet)", "12", "aircraft"),
        ("MMSI,species", "367123450,Thunnus", "ship"),
    ],
)
def test_columns_and_species_say_the_kind(write, header, cell, kind):
    (track,) = read(write(rows(header, cell)))
    assert kind_of(track) == (kind, "as the file says")


def test_several_species_of_different_kinds_are_animals(write):
    lines = rows("individual-taxon-canonical-name,individual-local-identifier", "Larus fuscus,Max")
    lines[-9:] = [line.replace("Larus fuscus,Max", "Lepus,Moritz") for line in lines[-9:]]
    assert {kind_of(track)[0] for track in read(write(lines))} == {"animal"}


def test_a_species_that_is_not_known_says_nothing(write):
    (track,) = read(write(rows("species", "Homo sapiens")))
    assert track.source.word == "target"


def test_gliders_are_aircraft_whose_altitudes_are_metres(tmp_path):
    fixes = [f"B1031{i:02}4702{i:03}N00818500EA0043000{480 + i}" for i in range(ROWS)]
    (tmp_path / "flight.igc").write_text("\n".join(["AXXX001", "HFDTE060524", *fixes]))
    (track,) = read(tmp_path / "flight.igc")
    assert (track.source.word, kind_of(track)[0]) == ("glider", "aircraft")
    assert track.position[-1, 2] - track.position[0, 2] == pytest.approx(ROWS - 1, abs=0.1)


def test_the_last_word_of_a_name_says_what_an_animal_is():
    names = ("Spotted eagle ray", "White stork", "Swift fox")
    assert [species.kind_of([name]) for name in names] == ["marine animal", "bird", ""]
