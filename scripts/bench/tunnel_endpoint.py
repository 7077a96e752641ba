"""Endpoint processes of the tunnel bench: owner of a tunnel device, members of the overlay, and plain TCP and UDP.

Processes of their own, started by ``tunnel.py``::

    device                   at s1 and s2: WireGuard over the cable between them, and a VXLAN port in it
    route                    at A and B: an IPv4 route to the other through s1 and s2, whose half is made by ``device``
    read, images, ping       members at B and A: images, and a round trip of 100 bytes
    tcp-read, tcp-images     the same images over TCP in the same WireGuard, at A and B or at s1 and s2
    udp-echo, udp-ping       the same round trip over UDP in it
"""

from __future__ import annotations

import base64
import json
import os
import selectors
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

from member_endpoint import PATIENCE_S, End, run_role
from peers.jsonl import say

from gdp.control.endpoints import Endpoint
from gdp.ports.tunnel.path_mtu import route_mtu, tunnel_mtu
from gdp.ports.tunnel.vxlan import make_vxlan
from gdp.ports.tunnel.wireguard import open_wireguard
from gdp.runtime.memory_tuning import tune_memory

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
    _ip(
        f"link set {iface} down",
        f"link set {iface} name {_CABLE}",
        f"address add {settings['address']}/24 dev {_CABLE}",
        f"link set {_CABLE} up",
    )
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
    _route_between(settings)
    say(event="ready", backend=tunnel.backend, mtu=mtu)
    with selectors.DefaultSelector() as selector:
        for source in (sys.stdin, tunnel):
            selector.register(source, selectors.EVENT_READ)
        while not any(key.fileobj is sys.stdin for key, _ in selector.select()):
            tunnel.handle_events()
    tunnel.close()


def _ip(*changes: str) -> None:
    for words in changes:
        subprocess.run(["ip", *words.split()], check=True)


def _route_between(settings: Settings) -> None:
    """Route between the own member and the network of the other one, through the tunnel."""
    ifname, member, peer = settings["ifname"], settings["member"], settings["peer_network"]
    allowed = f"{settings['peer_inner']}/128,{peer}.0/24"
    key = base64.b64encode(bytes.fromhex(settings["peer_key"])).decode()
    Path("/proc/sys/net/ipv4/ip_forward").write_text("1", encoding="ascii")
    _ip(f"address add {settings['member_network']}.1/24 dev {member}", f"route add {peer}.0/24 dev {ifname}")
    subprocess.run(["wg", "set", ifname, "peer", key, "allowed-ips", allowed], check=True)


def route(settings: Settings) -> None:
    """Give a member an address, and a route to the other one."""
    (iface,) = (name for _, name in socket.if_nameindex() if name != "lo")
    network = settings["member_network"]
    _ip(f"address add {network}.2/24 dev {iface}", f"route add {settings['peer_network']}.0/24 via {network}.1")
    say(event="over")


def images(end: End, settings: Settings) -> None:
    """Run as A: publish images for some seconds as fast as they are confirmed; report what that took."""
    publisher, image = end.advertise(IMAGES, reliable=True), os.urandom(IMAGE_BYTES)
    tune_memory()
    end.wait_for_readers([publisher])
    begun_s, begun_cpu_s, count = time.monotonic(), time.process_time(), 0
    while time.monotonic() < begun_s + float(settings["seconds"]) or not publisher.is_acknowledged():
        if publisher.has_space() and time.monotonic() < begun_s + float(settings["seconds"]):
            publisher.publish(image)
            count += 1
        end.runtime.step(time.monotonic() + PATIENCE_S)
    passed_s, sent = time.monotonic() - begun_s, float(count * IMAGE_BYTES)
    again = publisher.repairs * (publisher.mtu or 0) / sent
    say(bytes=sent, seconds=passed_s, cpu_s=time.process_time() - begun_cpu_s, again=again)
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
    """Read one connection to its end, and report what that took."""
    with socket.create_server((settings["server"], _TEST_PORT), family=_family(settings["server"])) as listener:
        say(event="ready")
        connection, _ = listener.accept()
        with connection:
            begun_s, begun_cpu_s, total, buffer = time.monotonic(), time.process_time(), 0, bytearray(1 << 20)
            while count := connection.recv_into(buffer):
                total += count
    say(bytes=float(total), seconds=time.monotonic() - begun_s, cpu_s=time.process_time() - begun_cpu_s)


def tcp_images(settings: Settings) -> None:
    """Send images for some seconds; report the processor time."""
    image = os.urandom(IMAGE_BYTES)
    with socket.create_connection((settings["server"], _TEST_PORT)) as connection:
        begun_cpu_s = time.process_time()
        until_s = time.monotonic() + float(settings["seconds"])
        while time.monotonic() < until_s:
            connection.sendall(image)
    say(cpu_s=time.process_time() - begun_cpu_s)


def udp_echo(settings: Settings) -> None:
    """Send every datagram back, until ended."""
    with socket.socket(_family(settings["server"]), socket.SOCK_DGRAM) as echo:
        echo.bind((settings["server"], _TEST_PORT))
        say(event="ready")
        while True:
            datagram, sender = echo.recvfrom(2_000)
            echo.sendto(datagram, sender)


def udp_ping(settings: Settings) -> None:
    """Send 100 bytes, wait until they are back, and go on; report every time in seconds."""
    with socket.socket(_family(settings["server"]), socket.SOCK_DGRAM) as probe:
        probe.connect((settings["server"], _TEST_PORT))
        probe.settimeout(PATIENCE_S)

        def once() -> None:
            """Send and wait."""
            probe.send(os.urandom(_PING_BYTES))
            probe.recv(2_000)

        say(times_s=_timed(once, float(settings["seconds"])))


def _family(address: str) -> socket.AddressFamily:
    return socket.AF_INET6 if ":" in address else socket.AF_INET


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
    "route": route,
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
