"""Link events of the kernel, received over rtnetlink without a library."""

from __future__ import annotations

import select
import socket
from collections.abc import Callable, Iterator

import pytest

from gdp.ports.rtnetlink import Link, LinkMonitor
from lab.namespaces import Space

pytestmark = pytest.mark.netns

PATIENCE_S = 10.0
MAC, PEER_MAC = bytes([2, 0, 0, 0, 0, 1]), bytes([2, 0, 0, 0, 0, 2])


@pytest.fixture
def watch(space: Space) -> Iterator[LinkMonitor]:
    opened = LinkMonitor()
    yield opened
    opened.close()


def last(links: list[Link], ifname: str) -> Link:
    return [link for link in links if link.ifname == ifname][-1]


def test_every_device_is_listed_with_its_facts(watch: LinkMonitor, space: Space) -> None:
    space.veth("one", "two", MAC, PEER_MAC, mtu=1_400)
    one = last(watch.all(), "one")
    assert (one.mac, one.mtu, one.up, one.gone) == (MAC, 1_400, True, False)
    assert {link.ifname for link in watch.all()} >= {"lo", "one", "two"}


def test_one_device_is_found_by_its_name(watch: LinkMonitor, space: Space) -> None:
    space.veth("one", "two", MAC, PEER_MAC)
    assert watch.get("one") == last(watch.all(), "one")


def test_a_name_that_no_device_has_finds_none(watch: LinkMonitor) -> None:
    assert watch.get("nothing") is None
    assert watch.get("a-name-longer-than-any") is None


def test_nothing_new_is_an_empty_list(watch: LinkMonitor) -> None:
    watch.poll()
    assert watch.poll() == []


@pytest.mark.parametrize(
    ("words", "seen"),
    [
        (("set", "two", "down"), lambda link: not link.up),
        (("set", "one", "down"), lambda link: not link.up),
        (("set", "one", "mtu", "1300"), lambda link: link.mtu == 1_300),
        (("set", "one", "address", "02:00:00:00:00:09"), lambda link: link.mac[-1] == 9),
        (("del", "one"), lambda link: link.gone and not link.up),
    ],
    ids=["carrier lost", "switched off", "mtu", "address", "deleted"],
)
def test_a_change_is_news(
    words: tuple[str, ...], seen: Callable[[Link], bool], watch: LinkMonitor, space: Space
) -> None:
    space.veth("one", "two", MAC, PEER_MAC)
    watch.poll()
    space.ip("link", *words)
    news: list[Link] = []
    # the kernel may report a carrier a moment later
    while not any(link.ifname == "one" and seen(link) for link in news):
        assert select.select([watch], [], [], PATIENCE_S)[0], news
        news += watch.poll()
    assert seen(last(news, "one"))


def test_a_device_that_leaves_a_bridge_is_not_gone(watch: LinkMonitor, space: Space) -> None:
    space.veth("one", "two", MAC, PEER_MAC)
    space.ip("link", "add", "bridge", "type", "bridge")
    space.ip("link", "set", "one", "master", "bridge")
    watch.poll()
    space.ip("link", "set", "one", "nomaster")
    assert not any(link.gone for link in watch.poll())


def test_news_that_the_kernel_had_to_skip_is_made_up_for(watch: LinkMonitor, space: Space) -> None:
    space.veth("one", "two", MAC, PEER_MAC)
    space.veth("three", "four", MAC, PEER_MAC)
    watch.poll()
    watch._news._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2_048)  # space for one or two messages
    for mtu in range(1_000, 1_020):
        space.ip("link", "set", "one", "mtu", str(mtu))
    space.ip("link", "del", "three")
    news = watch.poll()
    assert last(news, "one").mtu == 1_019
    assert last(news, "three").gone
