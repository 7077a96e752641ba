"""``gdp decrypt-pcap``, as called by a person."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from gdp.cli.gdp import main
from gdp.crypto.certificates import Role
from gdp.crypto.envelope import KeyContext, Sealer
from gdp.crypto.keys import SigningKey
from gdp.frame.codec import Kind, ethernet
from gdp.metadata import Metadata
from gdp.names import Name
from gdp.stores.issue import delegate, install_delegation, make_domain, make_node, make_owner
from gdp.stores.keyring import CARD, load_card, load_owner
from gdp.trust.grants import topic_secret
from gdp.trust.right import Right
from gdp_extensions.dissector.capture_opener import Outcome
from tests.gdp_extensions.dissector.tshark import needs_tshark, tshark, write_pcap

META = Metadata({"kind": "topic", "name": "/camera", "type": "std_msgs/msg/String"})
ETHER = ethernet(b"\x02\0\0\0\0\x01", b"\x02\0\0\0\0\x02")
VLAN = ETHER[:12] + b"\x81\x00\x00\x07" + ETHER[12:]
LARGE = 300_000


def _decrypt(*words: object) -> int:
    try:
        main(["decrypt-pcap", *map(str, words)])
    except SystemExit as leaving:
        return int(leaving.code or 0)
    return 0


@pytest.fixture
def secret(tmp_path: Path) -> bytes:
    """Make an owner, a reader with a delegation, and a capture; return the secret of the topic."""
    make_domain(tmp_path / "lab", "lab")
    make_owner(tmp_path / "owner")
    make_node(tmp_path / "reader", Role.PROXY, "reader", tmp_path / "lab")
    face = load_card(tmp_path / "reader" / CARD)
    given = delegate(tmp_path / "owner", face, META, [Right.READ], [0], days=1)
    install_delegation(tmp_path / "reader", given)
    secret = topic_secret(load_owner(tmp_path / "owner").master, given.name, 0)
    frames = [*_sealed(given.name, secret, b"hello", 1), *_sealed(given.name, secret, bytes(LARGE), 2)]
    other = _sealed(Name(b"o" * 32), b"x" * 32, b"shut", 1)
    write_pcap(tmp_path / "seen.pcap", [*(ETHER + each for each in (*frames, *other)), VLAN + frames[0], ETHER[:12]])
    return secret


def _sealed(topic: Name, secret: bytes, body: bytes, number: int) -> list[bytes]:
    sealer = Sealer(
        secret=secret,
        epoch=0,
        context=KeyContext(Kind.DATA, b"w" * 32, 1, topic),
        signer=SigningKey.generate(),
        random_bytes=os.urandom,
    )
    return list(sealer.seal(number, 0, number.to_bytes(8, "big") + body, 9_000))


@pytest.mark.parametrize("keys", [("--node", "reader"), ("--owner", "owner")])
def test_messages_are_written_and_each_name_says_what_could_not_be_opened(
    tmp_path: Path, secret: bytes, keys: tuple[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    plain = tmp_path / "plain.pcapng"
    assert _decrypt(tmp_path / "seen.pcap", keys[0], tmp_path / keys[1], "-o", plain, "--json") == 0
    result = json.loads(capsys.readouterr().out)
    assert (result["messages"], result["cut"]) == (2, 1)
    opened, shut = sorted(result["names"], key=lambda row: -int(row["opened"]))
    assert (opened["repeated"], opened["not_opened"]) == (1, {})
    assert opened["opened"] == opened["frames"] - 1
    assert (shut["name"], shut["not_opened"]) == ("6f" * 32, {Outcome.NO_KEY.value: 1})
    written = plain.read_bytes()
    assert b"hello" in written
    assert plain.stat().st_mode & 0o077 == 0
    masters = [secret, load_owner(tmp_path / "owner").master]
    assert [each for each in masters if each in written or each.hex().encode() in written] == []


@needs_tshark
def test_wireshark_shows_the_opened_messages_behind_their_frames(tmp_path: Path, secret: bytes) -> None:
    assert secret
    plain = tmp_path / "plain.pcapng"
    assert _decrypt(tmp_path / "seen.pcap", "--node", tmp_path / "reader", "-o", plain) == 0
    fields = ("gdp.number", "gdp_opened.number", "gdp_opened.sequence", "exported_pdu.orig_fno", "gdp_opened.body")
    lines = tshark(plain, "-T", "fields", *(word for each in fields for word in ("-e", each)), folder=tmp_path)
    rows = [line.split("\t") for line in lines.splitlines()]
    assert rows[1][1:] == ["1", "1", "1", b"hello".hex()]
    assert [row[1] for row in rows if row[1]] == ["1", "2"]
    again = tmp_path / "again.pcapng"  # what it wrote is a capture, too
    assert _decrypt(plain, "--node", tmp_path / "reader", "-o", again) == 0
    assert len(tshark(again, folder=tmp_path).splitlines()) == len(rows) + 2


def test_wrong_use_ends_with_two_and_a_remedy(
    tmp_path: Path, secret: bytes, capsys: pytest.CaptureFixture[str]
) -> None:
    assert secret
    seen, plain, reader = tmp_path / "seen.pcap", tmp_path / "plain.pcapng", tmp_path / "reader"
    (tmp_path / "text").write_text("no capture")
    wrong = {
        (seen, "-o", plain): "no keys",
        (seen, "-o", seen, "--node", reader): "exists already",
        (seen, "-o", seen, "--node", reader, "--force"): "is the capture itself",
        (tmp_path / "none", "-o", plain, "--node", reader): "No such file",
        (tmp_path / "text", "-o", plain, "--node", reader): "text: neither pcap nor pcapng",
        (seen, "-o", tmp_path / "none" / "plain", "--node", reader): "No such file",
    }
    for words, text in wrong.items():
        assert _decrypt(*words) == 2, words
        assert text in capsys.readouterr().err
    assert not plain.exists()
