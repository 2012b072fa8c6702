"""Counts of seconds of the day go on after midnight for all targets of a file at once."""

from torchfra.readers import read

DAY = 86_400


def lines(times, targets):
    return ["id,t,x,y", *(f"{name},{t % DAY},{i}.5,2" for i, (t, name) in enumerate(zip(times, targets, strict=True)))]


def test_a_target_behind_the_rows_of_another_begins_anew(write):
    times = [600 * i for i in range(144)] * 2
    one, two = read(write(lines(times, ["a"] * 144 + ["b"] * 144)))
    assert one.time.tolist() == two.time.tolist()
