"""Sans-I/O parts of the message bench: the message, the loop, the addresses, the targets."""

from __future__ import annotations

import os
import sys
import time
from collections import deque
from ipaddress import ip_address, ip_network
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from cryptography import x509
from cryptography.hazmat.primitives.serialization import load_pem_private_key
from rosbags.typesys import Stores, get_typestore

sys.path.append(str(Path(__file__).resolve().parents[2] / "scripts" / "bench"))

from background_load import load_of
from messages import CPU, MEDIAN, UNSIGNED, case_of, measure_one, targets_of
from peers.certificates import make_certificates
from peers.chain import NODES, address, routes
from peers.exchange import ANSWER, IMAGE, SIZE_MIN, answer_to, exchange, image
from peers.systems import cyclone_xml
from report import Rounds

from lab.topology import LEFT, RIGHT, row

SIZE, COUNT = 100, 20


class Echo:
    """Path whose far end answers at once; each test breaks it in its own manner."""

    def __init__(self) -> None:
        self.sent: list[bytes] = []
        self.answers = deque[bytes]()

    def send(self, message: bytes) -> None:
        self.sent.append(message)
        self.answers.append(answer_to(message))

    def wait(self, deadline_s: float) -> bytes | None:
        return self.answers.popleft() if self.answers else None


@pytest.mark.parametrize("size", [SIZE_MIN, 100, 10_000, 921_600])
def test_a_message_is_an_image_of_exactly_so_many_bytes(size: int) -> None:
    raw = bytes(image(size))
    read: Any = get_typestore(Stores.ROS2_HUMBLE).deserialize_cdr(raw, IMAGE)  # a class that the type store generates
    assert len(raw) == size
    assert read.encoding == "mono8"
    assert read.height * read.step == len(read.data)
    assert bytes(np.asarray(read.data)[-8:]) == raw[-8:]


def test_a_message_too_short_for_its_number_is_refused() -> None:
    with pytest.raises(ValueError, match="at least"):
        image(SIZE_MIN - 1)


def test_as_many_round_trips_are_measured_as_asked_for_and_one_is_checked() -> None:
    way = Echo()
    found = exchange(way, SIZE, COUNT, {})
    assert isinstance(found["rtt_s"], list)
    assert len(found["rtt_s"]) == COUNT
    numbers = [int.from_bytes(message[-8:], "big") for message in way.sent[1:]]
    assert len(set(numbers)) == len(numbers)
    assert [number >> 63 for number in numbers].count(1) == 1


def test_an_answer_to_a_greeting_that_comes_late_is_not_taken_for_an_answer() -> None:
    class Late(Echo):
        def send(self, message: bytes) -> None:
            super().send(message)
            if len(self.sent) == 1:
                self.answers.append(answer_to(message))

    assert exchange(Late(), SIZE, COUNT, {})["rtt_s"]


def test_a_message_that_changed_on_the_way_ends_the_measurement() -> None:
    class Broken(Echo):
        def send(self, message: bytes) -> None:
            super().send(b"\xff" + message[1:])

    with pytest.raises(ValueError, match="something else"):
        exchange(Broken(), SIZE, COUNT, {})


def test_a_message_that_is_not_answered_ends_the_measurement() -> None:
    class Mute(Echo):
        def send(self, message: bytes) -> None:
            if not self.sent:
                super().send(message)

    with pytest.raises(TimeoutError, match="100 bytes"):
        exchange(Mute(), SIZE, COUNT, {})


def test_an_absent_far_end_is_an_error_and_not_an_endless_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    class Silent(Echo):
        def send(self, message: bytes) -> None:
            monkeypatch.setattr(time, "monotonic", lambda: float("inf"))

    with pytest.raises(TimeoutError, match="never answered"):
        exchange(Silent(), SIZE, COUNT, {})


def test_cpu_of_this_process_is_counted_where_it_is_named() -> None:
    class Busy(Echo):
        def send(self, message: bytes) -> None:
            until_s = time.process_time() + 0.0005
            while time.process_time() < until_s:
                pass
            super().send(message)

    cpu = exchange(Busy(), SIZE, 8, {"sender": [os.getpid()], "none": []})["cpu_s"]
    assert isinstance(cpu, dict)
    assert cpu["sender"] >= 0.0005
    assert cpu["none"] == 0


def test_an_answer_has_sixteen_bytes() -> None:
    assert len(answer_to(bytes(image(100)))) == ANSWER.size == 16


@pytest.mark.parametrize("start", NODES)
@pytest.mark.parametrize("end", NODES)
def test_every_machine_reaches_every_address_over_its_neighbours(start: str, end: str) -> None:
    topology = row(1_500)
    for link in topology.links_of(end):
        target, at, passed = ip_address(address(end, link.other(end))), start, [start]
        while at != end:
            own = {address(each.other(at), at): each.other(at) for each in topology.links_of(at)}
            gateway = next((way for net, way in routes(at).items() if target in ip_network(net)), None)
            if gateway is None:
                (gateway,) = (each for each in own if target in ip_network(f"{each}/24", strict=False))
            at = own[gateway]
            passed.append(at)
        assert len(passed) == abs(NODES.index(start) - NODES.index(end)) + 1


def test_two_ends_of_a_link_share_a_network_and_no_other_does() -> None:
    links = row(9_000).links
    nets = [{ip_network(f"{address(*pair)}/24", strict=False) for pair in ((x.a, x.b), (x.b, x.a))} for x in links]
    assert all(len(each) == 1 for each in nets)
    assert len(set.union(*nets)) == len(links)


def test_cyclone_knows_its_peer_by_address_and_queries_no_other() -> None:
    tree = ElementTree.fromstring(cyclone_xml("10.99.0.1", "10.99.3.2"))
    found = {each.tag: each for each in tree.iter()}
    assert found["AllowMulticast"].text == "false"
    assert [peer.get("address") for peer in tree.iter("Peer")] == ["10.99.3.2"]
    assert found["NetworkInterface"].get("address") == "10.99.0.1"


def test_a_certificate_holds_for_the_addresses_of_its_machine_only(tmp_path: Path) -> None:
    make_certificates(tmp_path / "tls", {"s1": ["10.99.0.2", "10.99.1.1"]})
    root, own = (
        x509.load_pem_x509_certificate((tmp_path / "tls" / f"{name}.crt").read_bytes()) for name in ("ca", "s1")
    )
    names = own.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert names.get_values_for_type(x509.IPAddress) == [ip_address("10.99.0.2"), ip_address("10.99.1.1")]
    own.verify_directly_issued_by(root)
    key = load_pem_private_key((tmp_path / "tls" / "s1.key").read_bytes(), None)
    assert key.public_key() == own.public_key()


def test_a_ratio_is_taken_within_one_round_and_one_case() -> None:
    over, case = Rounds(), case_of(921_600, 1_500, loaded=False)
    for ours, theirs in ((1.0, 4.0), (20.0, 40.0), (9.0, 10.0)):
        over.add("gdp-kernel", case, MEDIAN, ours)
        over.add("zenoh-mtls", case, MEDIAN, theirs)
    over.add("zenoh-mtls", case_of(921_600, 9_000, loaded=False), MEDIAN, 1.0)
    target, _ = targets_of(over, ["gdp-kernel"], [(921_600, 1_500, False)])
    assert target.measured is not None
    assert (target.measured.median, target.target, target.met) == (0.5, 0.6, True)


def test_only_what_was_run_is_asked_for() -> None:
    assert targets_of(Rounds(), ["gdp-kernel"], [(10_000, 1_500, False)]) == []
    targets = targets_of(Rounds(), ["gdp-kernel"], [(921_600, 9_000, False)])
    assert [target.what.split(",")[0] for target in targets] == ["gdp-kernel / zenoh-mtls", "gdp-kernel - cyclone"]
    assert [target.met for target in targets] == [None, None]


def test_the_processor_time_of_each_end_is_asked_for_a_small_message() -> None:
    over, case = Rounds(), case_of(100, 1_500, loaded=False)
    over.add("gdp-kernel", case, CPU["sender"], 0.1)
    over.add("gdp-kernel", case, CPU["receiver"], 0.2)
    targets = [each for each in targets_of(over, ["gdp-kernel"], [(100, 1_500, False)]) if "CPU" in each.what]
    assert [(each.target, each.met) for each in targets] == [(0.12, True), (0.12, False)]


def test_the_cost_of_ecdsa_is_taken_off_a_signed_small_message_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("messages.signature_pair_s", lambda: 0.000_1)
    over, case = Rounds(), case_of(100, 1_500, loaded=False)
    nowhere: Any = SimpleNamespace()

    def baseline(_: object, **__: int) -> dict[str, Any]:
        return {"rtt_s": [0.000_5], "cpu_s": {}}

    for name, pairs in (("gdp-kernel", 2), ("zenoh-mtls", 0)):
        for column, value in measure_one(baseline, nowhere, 100, 1, False, pairs, 0).items():
            over.add(name, case, column, value)
    (target,) = [each for each in targets_of(over, ["gdp-kernel"], [(100, 1_500, False)]) if "less two" in each.what]
    assert target.measured is not None
    assert target.measured.median == pytest.approx(0.6)
    assert (target.target, target.met) == (0.4, False)
    assert over.column("zenoh-mtls", case, UNSIGNED) == [pytest.approx(0.5)]


def test_a_ratio_with_the_cores_half_taken_has_a_target_of_its_own() -> None:
    over, case = Rounds(), case_of(100, 1_500, loaded=True)
    over.add("gdp-kernel", case, MEDIAN, 0.7)
    over.add("zenoh-mtls", case, MEDIAN, 1.0)
    (target,) = targets_of(over, ["gdp-kernel"], [(100, 1_500, True)])
    assert (target.target, target.met) == (0.8, True)


def test_the_background_load_ends_with_its_block() -> None:
    with load_of(loaded=True) as processes:
        assert len(processes) == len(os.sched_getaffinity(0))
        assert all(each.code is None for each in processes)
    assert all(each.code is not None for each in processes)


def test_the_ends_stand_at_the_two_ends() -> None:
    assert {at.switch for at in row(1_500).attached("proxy")} == {LEFT, RIGHT}
