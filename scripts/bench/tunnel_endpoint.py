"""Endpoint processes of the tunnel bench: owner of a tunnel device, members of the overlay, and plain TCP and UDP.

Processes of their own, started by ``tunnel.py``::

    device                   at s1 and s2: WireGuard over the cable between them, and a VXLAN port in it
    read, images, ping       members at B and A: images, and a round trip of 100 bytes
    tcp-read, tcp-images     at s2 and s1: the same images over TCP in the same WireGuard
    udp-echo, udp-ping       at s2 and s1: the same round trip over UDP in it
"""

from __future__ import annotations

import json
import os
import selectors
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from typing import Any, Final

from member_endpoint import PATIENCE_S, End, run_role
from peers.jsonl import say

from gdp.control.endpoints import Endpoint
from gdp.nodes.memory_tuning import tune_memory
from gdp.ports.tunnel.path_mtu import route_mtu, tunnel_mtu
from gdp.ports.tunnel.vxlan import make_vxlan
from gdp.ports.tunnel.wireguard import open_wireguard

__all__ = ["IMAGES", "IMAGE_BYTES", "PING", "PONG"]

IMAGES: Final = "/images"
PING: Final = "/ping"
PONG: Final = "/pong"
IMAGE_BYTES: Final = 921_600
_PING_BYTES: Final = 100
_WARM_UP: Final = 100
_PORT: Final = 51820
_TEST_PORT: Final = 7_000
_CABLE: Final = "cable"
_ALIAS: Final = "gdp-switch bench"

Settings = Mapping[str, Any]


def device(settings: Settings) -> None:
    """Lead the port ``iface`` through a tunnel over the cable that had its name, until standard input ends."""
    iface, ifname = settings["iface"], settings["ifname"]
    for words in (
        f"link set {iface} down",
        f"link set {iface} name {_CABLE}",
        f"address add {settings['address']}/24 dev {_CABLE}",
        f"link set {_CABLE} up",
    ):
        subprocess.run(["ip", *words.split()], check=True)
    peer = Endpoint(settings["peer_address"], _PORT)
    wireguard_mtu, mtu = tunnel_mtu(route_mtu(peer), is_ipv6=False)
    tunnel = open_wireguard(
        ifname=ifname,
        private_key=bytes.fromhex(settings["key"]),
        listen_port=_PORT,
        inner=settings["inner"],
        mtu=wireguard_mtu,
        alias=_ALIAS,
    )
    key = bytes.fromhex(settings["peer_key"])
    tunnel.set_peer(key, inner=settings["peer_inner"], endpoint=peer, keepalive_s=25)
    link = {"local": settings["inner"], "remote": settings["peer_inner"], "underlay": ifname, "alias": _ALIAS}
    make_vxlan(ifname=iface, vni=1, mtu=mtu, **link)
    say(event="ready", backend=tunnel.backend, mtu=mtu)
    with selectors.DefaultSelector() as selector:
        for source in (sys.stdin, tunnel):
            selector.register(source, selectors.EVENT_READ)
        while not any(key.fileobj is sys.stdin for key, _ in selector.select()):
            tunnel.handle_events()
    tunnel.close()


def images(end: End, settings: Settings) -> None:
    """Run as A: publish images for some seconds as fast as they are confirmed; report bytes a second."""
    publisher, image = end.advertise(IMAGES, reliable=True), os.urandom(IMAGE_BYTES)
    tune_memory()
    end.wait_for_readers([publisher])
    begun_s, count = time.monotonic(), 0
    while time.monotonic() < begun_s + float(settings["seconds"]) or not publisher.is_acknowledged():
        if publisher.has_space() and time.monotonic() < begun_s + float(settings["seconds"]):
            publisher.publish(image)
            count += 1
        end.runtime.step(time.monotonic() + PATIENCE_S)
    say(bytes_s=count * IMAGE_BYTES / (time.monotonic() - begun_s))
    end.leave()


def ping(end: End, settings: Settings) -> None:
    """Run as A: send 100 bytes, wait until they are back, and go on; report every time in seconds."""
    publisher = end.advertise(PING, reliable=True, urgent=True)
    end.subscribe(PONG)
    tune_memory()
    end.wait_for_readers([publisher])

    def once() -> None:
        """Send and wait."""
        publisher.publish(os.urandom(_PING_BYTES))
        end.member.flush(time.monotonic())
        end.runtime.send()
        deadline_s = time.monotonic() + PATIENCE_S
        if not end.runtime.run(lambda: bool(list(end.member.poll_messages())), deadline_s):
            raise TimeoutError("a ping was not answered")

    say(times_s=_timed(once, float(settings["seconds"])))
    end.leave()


def read(end: End, _: Settings) -> None:
    """Run as B: read images, and send pings back, until ended."""
    end.subscribe(IMAGES)
    asked = end.subscribe(PING)
    back = end.advertise(PONG, reliable=True, urgent=True)
    tune_memory()
    with end.runtime.signals():
        say(event="ready")
        while not end.runtime.is_stopped:
            end.runtime.step(time.monotonic() + PATIENCE_S)
            for each in end.member.poll_messages():
                if each.topic == asked:
                    if not back.readers:  # the first ping may come before its sender is known as a reader of answers
                        end.wait_for_readers([back])
                    back.publish(each.delivered.message)
                    end.member.flush(time.monotonic())
                    end.runtime.send()
        end.leave()


def tcp_read(settings: Settings) -> None:
    """Read one connection to its end, and report bytes a second."""
    with socket.create_server((settings["inner"], _TEST_PORT), family=socket.AF_INET6) as listener:
        say(event="ready")
        connection, _ = listener.accept()
        with connection:
            begun_s, total, buffer = time.monotonic(), 0, bytearray(1 << 20)
            while count := connection.recv_into(buffer):
                total += count
    say(bytes_s=total / (time.monotonic() - begun_s))


def tcp_images(settings: Settings) -> None:
    """Send images for some seconds."""
    image = os.urandom(IMAGE_BYTES)
    with socket.create_connection((settings["peer_inner"], _TEST_PORT)) as connection:
        until_s = time.monotonic() + float(settings["seconds"])
        while time.monotonic() < until_s:
            connection.sendall(image)
    say(event="over")


def udp_echo(settings: Settings) -> None:
    """Send every datagram back, until ended."""
    with socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as echo:
        echo.bind((settings["inner"], _TEST_PORT))
        say(event="ready")
        while True:
            datagram, sender = echo.recvfrom(2_000)
            echo.sendto(datagram, sender)


def udp_ping(settings: Settings) -> None:
    """Send 100 bytes, wait until they are back, and go on; report every time in seconds."""
    with socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as probe:
        probe.connect((settings["peer_inner"], _TEST_PORT))
        probe.settimeout(PATIENCE_S)

        def once() -> None:
            """Send and wait."""
            probe.send(os.urandom(_PING_BYTES))
            probe.recv(2_000)

        say(times_s=_timed(once, float(settings["seconds"])))


def _timed(once: Callable[[], None], seconds: float) -> list[float]:
    for _ in range(_WARM_UP):
        once()
    times_s: list[float] = []
    until_s = time.monotonic() + seconds
    while time.monotonic() < until_s:
        begun_s = time.monotonic()
        once()
        times_s.append(time.monotonic() - begun_s)
    return times_s


_PLAIN: Final = {
    "device": device,
    "tcp-read": tcp_read,
    "tcp-images": tcp_images,
    "udp-echo": udp_echo,
    "udp-ping": udp_ping,
}

if __name__ == "__main__":
    if sys.argv[1] in _PLAIN:
        _PLAIN[sys.argv[1]](json.loads(sys.argv[2]))
    else:
        run_role({"images": images, "ping": ping, "read": read})
