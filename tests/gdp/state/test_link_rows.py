"""Rows of links for ``gdp status`` and metrics."""

from __future__ import annotations

from gdp.ports.plane import Port
from gdp.state.link_rows import LinkRows, link_status
from gdp.telemetry.sources import LinkRow
from tests.gdp.control.members import at
from tests.gdp.control.test_keepalive import B, Pair, up


def test_a_row_shows_what_was_measured_of_a_neighbour() -> None:
    pair = up(Pair())
    links = LinkRows(pair.ends["a"], {0: Port(0, "eth0", bytes(6), 1_500, up=True)})
    links.refresh(at(pair.now_s))
    (row,) = links.rows
    shown = link_status(row)
    assert (shown["port"], shown["neighbour"], shown["cost"]) == ("eth0", B.name.short, 10)
    assert (shown["loss_in"], shown["loss_out"]) == (0.0, 0.0)
    assert isinstance(shown["rtt_ms"], float)


def test_a_neighbour_that_is_lost_has_no_row() -> None:
    pair = up(Pair())
    links = LinkRows(pair.ends["a"], {})
    pair.ends["a"].port_changed(0, False, pair.now_s)
    links.refresh(at(pair.now_s))
    assert links.rows == []


def test_a_link_that_is_not_measured_has_no_round_trip_time() -> None:
    shown = link_status(LinkRow("wg0", "abcd", None, 0.0, 0.0, 0.0, 100))
    assert (shown["rtt_ms"], shown["rtt_var_ms"], shown["cost"]) == (None, None, 100)
