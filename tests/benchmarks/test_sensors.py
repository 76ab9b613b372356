"""The table of sensors: its false stops are a share of the stops."""

from benchmarks.sensors import Search, line

FOUND, FALSE, SPENT = (
    Search(True, True, 30.0, 40.0),
    Search(True, False, 20.0, 25.0),
    Search(False, False, 300.0, 345.0),
)


def test_false_stops_are_a_share_of_the_missions_that_ceased() -> None:
    """Of four missions two ceased, and one of these two was false."""
    row = line("as-modelled", "tgs2600:dwell=2", [FOUND, FALSE, SPENT, SPENT])
    ceased, located, false = (cell.split()[0] for cell in row[3:6])
    assert (ceased, located, false) == ("50.0", "25.0", "50.0")


def test_without_a_stop_no_share_of_them_is_false() -> None:
    """A row of missions that all spent their moves has no figure there, as it has no distance."""
    assert line("as-modelled", "tgs2600:dwell=2", [SPENT])[5:] == ["–", "–", "–"]
