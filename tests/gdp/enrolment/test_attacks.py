"""Attacks on an enrolment: each is refused with a sentence, and leaves nothing behind."""

from __future__ import annotations

import os
import socket
import ssl
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest

from gdp.crypto.cbor import encode
from gdp.crypto.certificates import Role
from gdp.crypto.identity import NodeKeys
from gdp.enrolment import server as server_module
from gdp.enrolment.channel import client_context, connect
from gdp.enrolment.desk import EnrolmentDesk
from gdp.enrolment.domain_join import Joined, JoinRequest, join_domain
from gdp.errors import LocalError
from gdp.trust.enrolment_wire import MEMBERS, EnrolmentError, Refusal, UnreachableError, apply, encode_message
from gdp.trust.join_token import JoinRole, JoinToken, join_id, join_key, join_proof
from tests.gdp.enrolment.lab import Lab, running_lab


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Lab]:
    with running_lab(tmp_path_factory.mktemp("attacks")) as made:
        yield made


def _request(token: JoinToken, label: str, role: JoinRole = JoinRole.LEAF) -> dict[str, object]:
    nodes = []
    for _, node_role in role.nodes:
        keys = NodeKeys.generate(node_role, label)
        nodes.append(apply(join_id(token.secret), keys.key, keys.request(), keys.kem.public).to_fields())
    return {"op": "join", "id": join_id(token.secret), "nodes": nodes}


def _signed(token: JoinToken, untagged: dict[str, object], binding: bytes, nonce: bytes) -> dict[str, object]:
    return {**untagged, "mac": join_proof(join_key(token.secret), binding, nonce, encode(untagged))}


def _refused(lab: Lab, token: JoinToken, untagged: dict[str, object]) -> EnrolmentError:
    with connect(f"127.0.0.1:{lab.port}", token.root) as channel, pytest.raises(EnrolmentError) as refusal:
        channel.request(_signed(token, untagged, channel.binding, channel.nonce))
    return refusal.value


def _plain(lab: Lab) -> ssl.SSLSocket:
    plain = socket.create_connection(("127.0.0.1", lab.port), timeout=5.0)
    return client_context().wrap_socket(plain)


def test_a_token_works_once(lab: Lab) -> None:
    token = lab.token()
    lab.join("once", token)
    with pytest.raises(EnrolmentError, match=r"used already by 'once' at .*remove that machine") as refusal:
        lab.join("twice", token)
    assert refusal.value.code is Refusal.USED
    assert not (lab.folder / "twice").exists()
    assert not list(lab.folder.glob(".twice*"))


def test_of_many_machines_with_one_token_exactly_one_joins(lab: Lab) -> None:
    token = lab.token()

    def attempt(number: int) -> Joined | EnrolmentError:
        try:
            return lab.join(f"racer-{number}", token)
        except EnrolmentError as error:
            return error

    with ThreadPoolExecutor(6) as pool:
        ended = list(pool.map(attempt, range(6)))
    winners = [each for each in ended if isinstance(each, Joined)]
    assert len(winners) == 1
    assert {each.code for each in ended if isinstance(each, EnrolmentError)} == {Refusal.USED}
    assert len(list(lab.folder.glob("*racer*"))) == 1


def test_an_expired_token_is_refused(lab: Lab) -> None:
    token = lab.token(valid_s=-1.0)
    with pytest.raises(EnrolmentError, match=r"expired at .*gdp domain token"):
        lab.join("late", token)


def test_a_token_that_this_domain_did_not_make_is_refused(lab: Lab) -> None:
    with pytest.raises(EnrolmentError, match="did not make the token"):
        lab.join("forged", replace(lab.token(), secret=os.urandom(16)))


def test_a_token_of_another_domain_is_refused_before_anything_is_sent(lab: Lab, tmp_path: Path) -> None:
    with running_lab(tmp_path, "other") as other:
        token = replace(other.token(), servers=lab.token().servers)
        with pytest.raises(EnrolmentError, match=r"another domain \('lab'\).*nothing was sent"):
            lab.join("stray", token)


def test_a_man_in_the_middle_with_the_domains_root_certificate_is_refused(lab: Lab, tmp_path: Path) -> None:
    """It shows the true root, which is public, but a TLS certificate of its own domain."""
    with running_lab(tmp_path, "evil") as evil, pytest.MonkeyPatch.context() as patch:
        stolen = (lab.files.config.domain / "root.crt").read_bytes()

        def greeting(self: EnrolmentDesk, nonce: bytes, unix_s: float) -> dict[str, object]:
            return {"v": 1, "root": stolen, "nonce": nonce, "now": int(unix_s)}

        patch.setattr(EnrolmentDesk, "greeting", greeting)
        token = replace(lab.token(), servers=evil.token().servers)
        with pytest.raises(
            EnrolmentError, match=r"not its key .*between this machine and the server; nothing was sent"
        ):
            lab.join("victim", token)


def test_a_request_that_was_overheard_does_not_count_on_another_connection(lab: Lab) -> None:
    token = lab.token(JoinRole.LEAF)
    with connect(f"127.0.0.1:{lab.port}", token.root) as channel:
        overheard = _signed(token, _request(token, "replay"), channel.binding, channel.nonce)
    with connect(f"127.0.0.1:{lab.port}", token.root) as channel, pytest.raises(EnrolmentError) as refusal:
        channel.request(overheard)
    assert refusal.value.code is Refusal.WRONG_PROOF


def test_the_secret_is_not_in_the_request_and_not_in_the_registry(lab: Lab) -> None:
    token = lab.token(JoinRole.LEAF)
    sent = encode_message(_signed(token, _request(token, "quiet"), bytes(32), bytes(32)))
    assert token.secret not in sent
    for each in (each for each in lab.files.config.state.iterdir() if each.is_file()):
        assert token.secret not in each.read_bytes()


def test_a_lost_response_is_sent_again_to_the_same_keys(lab: Lab) -> None:
    token = lab.token(JoinRole.LEAF)
    untagged = _request(token, "again")
    answers = []
    for _ in range(2):
        with connect(f"127.0.0.1:{lab.port}", token.root) as channel:
            answers.append(channel.request(_signed(token, untagged, channel.binding, channel.nonce)))
    assert MEMBERS.read(answers[0]) == MEMBERS.read(answers[1])


def test_a_token_allows_only_its_role(lab: Lab) -> None:
    token = lab.token(JoinRole.LEAF)
    assert _refused(lab, token, _request(token, "greedy", JoinRole.SWITCH)).code is Refusal.WRONG_NODES
    lab.join("greedy", token)  # the wrong request did not use the token up


def test_a_token_for_a_label_allows_only_that_label(lab: Lab) -> None:
    token = lab.token(label="exact")
    with pytest.raises(EnrolmentError, match="for the label 'exact', not 'other'"):
        lab.join("other", token)
    lab.join("exact", token)


def test_a_taken_label_is_refused_and_the_token_stays_good(lab: Lab) -> None:
    lab.join("taken")
    token = lab.token()
    with pytest.raises(EnrolmentError, match=r"the label 'taken' is taken.*--label"):
        join_domain(JoinRequest(token=token, label="taken", directory=lab.folder / "elsewhere"))
    lab.join("free", token)


def test_a_second_machine_with_the_same_keys_is_refused(lab: Lab) -> None:
    first, second = lab.token(JoinRole.LEAF), lab.token(JoinRole.LEAF)
    keys = NodeKeys.generate(Role.LEAF, "clone")
    requests = list[dict[str, object]]()
    for token in (first, second):
        node = apply(join_id(token.secret), keys.key, keys.request(), keys.kem.public).to_fields()
        requests.append({"op": "join", "id": join_id(token.secret), "nodes": [node]})
    with connect(f"127.0.0.1:{lab.port}", first.root) as channel:
        channel.request(_signed(first, requests[0], channel.binding, channel.nonce))
    assert _refused(lab, second, requests[1]).code is Refusal.IDENTITY_TAKEN


def test_a_proof_by_another_key_is_refused(lab: Lab) -> None:
    token = lab.token(JoinRole.LEAF)
    untagged, other = _request(token, "mixed"), _request(token, "mixed")
    nodes, foreign = untagged["nodes"], other["nodes"]
    assert isinstance(nodes, list)
    assert isinstance(foreign, list)
    nodes[0]["proof"] = foreign[0]["proof"]
    assert _refused(lab, token, untagged).code is Refusal.WRONG_PROOF


def test_a_clock_that_is_hours_off_is_named(lab: Lab) -> None:
    with pytest.raises(EnrolmentError, match=r"clock is 3\.0 hours ahead of the server's: set the clock"):
        connect(f"127.0.0.1:{lab.port}", lab.token().root, clock=lambda: time.time() + 3 * 3_600)


def test_an_unreachable_server_is_named(lab: Lab) -> None:
    with socket.create_server(("127.0.0.1", 0)) as closed:
        port = closed.getsockname()[1]
    token = replace(lab.token(), servers=(f"127.0.0.1:{port}",))
    with pytest.raises(UnreachableError, match=f"not reachable: 127.0.0.1:{port}.*refused"):
        lab.join("lonely", token)


def test_a_full_disk_is_found_before_the_token_is_used(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    token = lab.token()
    with monkeypatch.context() as patch:
        patch.setattr(os, "posix_fallocate", full)
        with pytest.raises(LocalError, match=r"No space left on device.*the token was not used"):
            lab.join("full", token)
    assert not list(lab.folder.glob("*full*"))
    lab.join("full", token)


def test_a_directory_that_exists_is_not_touched(lab: Lab) -> None:
    (lab.folder / "here").mkdir()
    (lab.folder / "here/file").write_text("mine")
    with pytest.raises(LocalError, match="is there already"):
        lab.join("here")
    assert [each.name for each in (lab.folder / "here").iterdir()] == ["file"]


def test_too_long_a_request_ends_the_connection(lab: Lab) -> None:
    with _plain(lab) as peer:
        peer.recv(65_536)
        peer.sendall((1 << 20).to_bytes(4, "big") + b"x" * 1_000)
        assert b"too-big" in peer.recv(65_536)
        assert peer.recv(1) == b""


def test_older_tls_is_refused(lab: Lab) -> None:
    context = client_context()
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    context.maximum_version = ssl.TLSVersion.TLSv1_2
    with (
        socket.create_connection(("127.0.0.1", lab.port), timeout=5.0) as plain,
        pytest.raises(ssl.SSLError),
        context.wrap_socket(plain),
    ):
        pass


def test_a_slow_stranger_is_closed(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server_module, "STRANGER_S", 0.5)
    with _plain(lab) as peer:
        peer.recv(65_536)
        peer.sendall(b"\0\0")  # half a length, and nothing more
        assert peer.recv(1) == b""


def test_idle_strangers_do_not_exclude_a_machine(lab: Lab) -> None:
    idle = [socket.create_connection(("127.0.0.1", lab.port)) for _ in range(40)]
    try:
        lab.join("patient")
    finally:
        for each in idle:
            each.close()


def test_arbitrary_bytes_do_not_stop_the_server(lab: Lab) -> None:
    for payload in (b"\xa0", b"\xff" * 50, encode({"op": "poll"}), encode({"op": "join"}), encode({"op": 1})):
        with _plain(lab) as peer:
            peer.recv(65_536)
            peer.sendall(len(payload).to_bytes(4, "big") + payload)
            assert b"malformed" in peer.recv(65_536)
    lab.join("survivor")


def test_no_thread_outlives_a_refusal(lab: Lab) -> None:
    before = threading.active_count()
    with pytest.raises(EnrolmentError):
        lab.join("gone", lab.token(valid_s=-1.0))
    assert threading.active_count() == before
