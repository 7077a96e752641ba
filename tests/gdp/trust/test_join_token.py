"""Join tokens: their text, and the proof of their secret."""

from __future__ import annotations

import string

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gdp.errors import LocalError
from gdp.trust.join_token import JoinRole, JoinToken, join_id, join_key, join_proof

TOKEN = JoinToken(
    root=bytes(range(32)),
    secret=bytes(range(100, 116)),
    role=JoinRole.SWITCH,
    expires_unix_s=1_800_000_000,
    servers=("192.0.2.1:51820", "[2001:db8::1]:51820", "border.example.org:443"),
)


def _read(text: str) -> JoinToken | None:
    try:
        return JoinToken.from_text(text)
    except LocalError:
        return None


def test_the_text_of_a_token_holds_all_of_it() -> None:
    assert JoinToken.from_text(TOKEN.to_text()) == TOKEN


def test_letter_case_and_line_breaks_do_not_matter() -> None:
    text = TOKEN.to_text().upper()
    assert JoinToken.from_text(f" {text[:40]}\n{text[40:]} ") == TOKEN


def test_a_token_does_not_show_its_secret_in_a_log() -> None:
    assert repr(TOKEN.secret) not in repr(TOKEN)


def test_every_single_wrong_character_is_recognised() -> None:
    text = TOKEN.to_text()
    for at in range(len(text)):
        for letter in set(string.ascii_lowercase + string.digits) - {text[at]}:
            read = _read(text[:at] + letter + text[at + 1 :])
            assert read is None or (read == TOKEN and at == len(text) - 1)  # its last bits carry nothing


@given(st.text(max_size=200))
def test_any_text_is_a_token_or_an_error_of_ours(text: str) -> None:
    for each in (text, f"gdp1{text}"):
        with pytest.raises(LocalError):
            JoinToken.from_text(each)


def test_a_cut_token_is_recognised() -> None:
    with pytest.raises(LocalError, match="typed or copied wrong"):
        JoinToken.from_text(TOKEN.to_text()[:-3])


def test_other_text_is_no_token() -> None:
    with pytest.raises(LocalError, match="begins with gdp1"):
        JoinToken.from_text("--label")


def test_the_id_and_the_key_of_a_secret_differ() -> None:
    assert join_id(TOKEN.secret) != join_key(TOKEN.secret)[:16]


def test_a_proof_holds_for_one_connection_only() -> None:
    key = join_key(TOKEN.secret)
    proofs = {
        join_proof(key, binding, nonce, request)
        for binding in (b"a" * 32, b"b" * 32)
        for nonce in (b"c" * 32, b"d" * 32)
        for request in (b"e", b"f")
    }
    assert len(proofs) == 8
