"""A name that is none is answered with the one that may have been meant."""

import pytest

import torchfra
from torchfra.catalogue import make_filter
from torchfra.cli import main as cli
from torchfra.motion import ConstantVelocity
from torchfra.sensors import Position
from torchfra.suggestions import meant


@pytest.mark.parametrize(("received", "known", "said"), [
    ("gbp", ["ukf", "gpb"], " (did you mean 'gpb'?)"), ("GPB", ["gpb"], " (did you mean 'gpb'?)"),
    ("nothing", ["ukf", "gpb"], ""), (3, [], ""),
])  # fmt: skip
def test_only_what_is_close_is_suggested(received, known, said):
    assert meant(received, known) == said


@pytest.mark.parametrize(("arguments", "said"), [
    (["compar"], "(did you mean 'compare'?)"),
    (["compare", "--scenario", "bearing-outliers"], "(did you mean 'bearings-outliers'?)"),
    (["compare", "--scenario", "bearings-outliers", "--filters", "gbp"], "(did you mean 'gpb'?)"),
    (["compare", "--filtres", "gpb"], "(did you mean '--filters'?)"),
    (["track", "{file}", "--x", "eastng", "--y", "north"], "(did you mean 'easting'?)"),
])  # fmt: skip
def test_commands_suggest_words_options_filters_and_columns(arguments, said, tmp_path, capsys):
    file = tmp_path / "track.csv"
    file.write_text("time,easting,north\n0,1,2\n1,2,3\n")
    try:
        status = cli.main([argument.format(file=file) for argument in arguments])
    except SystemExit as ended:
        status = ended.code
    assert status == 2
    assert said in capsys.readouterr().err


def test_functions_do_so_too():
    models = ConstantVelocity(1.0), Position(2.0)
    with pytest.raises(ValueError, match=r"received 'srkcf' \(did you mean 'srckf'\?\)"):
        make_filter("srkcf", *models)
    with pytest.raises(ValueError, match=r"received 'hrad' \(did you mean 'hard'\?\)"):
        torchfra.presets.gpb(*models, manoeuvres="hrad")
