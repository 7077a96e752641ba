"""Veth pairs that a switch creates for nodes on its own host."""

from __future__ import annotations

import contextlib
import hashlib
import threading

import pytest

from gdp.errors import LocalError
from gdp.links.uplink import wait_for_device
from gdp.links.veth import attach_pairs
from gdp.names import Name
from gdp.ports.rtnetlink import LinkMonitor
from lab.namespaces import Space

pytestmark = [pytest.mark.netns, pytest.mark.usefixtures("space")]

ONE, OTHER = (Name(hashlib.sha256(text).digest()) for text in (b"one", b"other"))
PAIR = {"rib0", "rib0-s"}


def devices() -> dict[str, int]:
    """Return the MTU of every device except the loopback."""
    with contextlib.closing(LinkMonitor()) as links:
        return {link.ifname: link.mtu for link in links.all() if link.ifname != "lo"}


def test_a_pair_has_the_wanted_mtu_and_goes_with_its_switch() -> None:
    with attach_pairs(["rib0"], ONE, 9_000):
        assert devices() == dict.fromkeys(PAIR, 9_000)
    assert devices() == {}


def test_a_pair_that_a_killed_run_left_is_replaced() -> None:
    left = attach_pairs(["rib0"], ONE, 1_500)
    left.__enter__()  # and never left
    with attach_pairs(["rib0"], ONE, 1_400):
        assert devices() == dict.fromkeys(PAIR, 1_400)


def test_the_pair_of_another_switch_is_left_alone() -> None:
    with attach_pairs(["rib0"], ONE, 1_500):
        with pytest.raises(LocalError, match="not ours"), attach_pairs(["rib0"], OTHER, 1_500):
            pass
        assert devices().keys() == PAIR


def test_somebody_elses_device_is_refused_and_what_was_made_before_it_is_gone(space: Space) -> None:
    space.ip("link", "add", "rib0-s", "type", "bridge")
    with pytest.raises(LocalError, match="rib0-s exists"), attach_pairs(["px0", "rib0"], ONE, 1_500):
        pass
    assert devices().keys() == {"rib0-s"}


def test_a_node_waits_for_the_device_that_its_switch_is_just_making() -> None:
    waiting = threading.Thread(target=wait_for_device, args=("rib0", 600.0))
    waiting.start()
    with attach_pairs(["px0", "rib0"], ONE, 1_500):
        waiting.join(20.0)
        assert not waiting.is_alive()


def test_a_device_that_is_there_is_not_waited_for() -> None:
    with attach_pairs(["rib0"], ONE, 1_500):
        wait_for_device("rib0", 600.0)


def test_a_node_whose_devices_all_exist_does_not_wait() -> None:
    wait_for_device("rib0", 0.01)
