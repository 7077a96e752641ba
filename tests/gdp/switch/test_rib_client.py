"""RIB client of a switch: a RIB that restarted gets all advertisements at once, not when leases are renewed."""

from __future__ import annotations

from unittest.mock import patch

import pytest

from tests.journeys.flows import advertise, ring


@pytest.mark.parametrize("has_restarted", [True, False])
def test_a_rib_with_another_session_gets_all_advertisements_again_and_the_same_one_none(has_restarted: bool) -> None:
    world = ring()
    advertise(world)
    world.network.run(2)
    client = world.switches["nuc1"].rib_client
    paths, now_s = client._state.paths, world.network.now.mono_s
    known = paths.ribs()
    seen = {name: each._replace(session=b"restart!") if has_restarted else each for name, each in known.items()}
    with patch.object(paths, "ribs", return_value=seen), patch.object(client, "relay") as relay:
        client.links_changed(now_s)
        client.send_due(now_s + 0.5)
    assert client.rib in known
    assert (relay.call_count > 0) is has_restarted
