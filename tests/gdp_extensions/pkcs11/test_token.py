"""Keys in tokens: a domain and its nodes sign by a PKCS #11 library, and verifiers see no difference."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from gdp.crypto.certificates import Role
from gdp.crypto.identity import Identity
from gdp.crypto.keys import SIGNATURE_BYTES
from gdp.crypto.x509_profile import read_request
from gdp.errors import LocalError
from gdp.stores.files import private, write_all
from gdp.stores.issue import admit_node, make_domain, make_node_keys, make_owner
from gdp.stores.keyring import load_domain, load_identity, load_owner, storage
from gdp.stores.private_keys import Storage
from gdp_extensions.pkcs11.token import TokenKey, generate_token_key, open_token_key
from gdp_extensions.pkcs11.token_uri import TokenUri
from tests.gdp_extensions.pkcs11.tokens import PIN, SoftToken, soft_token

NOW = 1_800_000_000.0


@pytest.fixture
def token(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[SoftToken]:
    monkeypatch.setenv("GDP_PASSPHRASE", PIN)
    monkeypatch.setattr("gdp.crypto.pbes2._COST", 16)
    with soft_token(tmp_path / "token", monkeypatch) as made:
        yield made


def key(token: SoftToken, label: str) -> TokenKey:
    return generate_token_key(token.uri(label))


def test_a_token_signs_what_the_public_key_verifies(token: SoftToken) -> None:
    made = key(token, "node")
    signature = made.sign(b"data")
    assert len(signature) == SIGNATURE_BYTES
    made.public.verify(signature, b"data")
    made.public.verify_der(made.sign_der(b"data"), b"data")
    with pytest.raises(LocalError, match="32 bytes"):
        made.sign_digest(b"short")


def test_a_domain_and_a_node_in_a_token(token: SoftToken, tmp_path: Path) -> None:
    make_domain(tmp_path / "school", "school", key=key(token, "root"), unix_s=NOW)
    keys = make_node_keys(tmp_path / "node", Role.PROXY, "robot", key=key(token, "node"))
    assert read_request(keys.request()).key == keys.key.public  # openssl's form, signed by the token
    admit_node(tmp_path / "school", tmp_path / "node", unix_s=NOW)
    identity: Identity = load_identity(tmp_path / "node", NOW)
    assert isinstance(identity.key, TokenKey)
    assert isinstance(load_domain(tmp_path / "school").key, TokenKey)
    assert storage(tmp_path / "node") == {
        tmp_path / "node/node.key": Storage.TOKEN,
        tmp_path / "node/kem.key": Storage.PLAIN,
    }


def test_openssl_verifies_what_a_token_signed(token: SoftToken, tmp_path: Path) -> None:
    make_domain(tmp_path / "school", "school", key=key(token, "root"))
    keys = make_node_keys(tmp_path / "node", Role.PROXY, "robot", key=key(token, "node"))
    assert keys.role is Role.PROXY
    request = ["req", "-in", "node/node.csr", "-verify"]
    for command in (request, ["verify", "-CAfile", "school/root.crt", "school/root.crt"]):
        subprocess.run(["openssl", *command], cwd=tmp_path, check=True, capture_output=True, timeout=60)


def test_an_owner_in_a_token_keeps_its_master_secret_in_a_file(token: SoftToken, tmp_path: Path) -> None:
    made = make_owner(tmp_path / "owner", key=key(token, "owner"), passphrase=PIN.encode())
    assert load_owner(tmp_path / "owner").master == made.master
    assert [each.value for each in storage(tmp_path / "owner").values()] == ["token", "passphrase"]


def test_the_pin_may_lie_in_a_private_file(token: SoftToken, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = key(token, "node")
    monkeypatch.delenv("GDP_PASSPHRASE")
    write_all(tmp_path / "pin", {"pin": private(PIN.encode() + b"\n")})
    opened = open_token_key(f"{token.uri('node')}&pin-source=file:{tmp_path}/pin/pin", tmp_path)
    assert opened.public == made.public


def test_no_key_a_wrong_token_and_a_second_key_are_reported(token: SoftToken) -> None:
    key(token, "node")
    with pytest.raises(LocalError, match="0 private keys"):
        open_token_key(token.uri("other"), Path("node.key"))
    with pytest.raises(LocalError, match="0 tokens fit"):
        open_token_key(token.uri("node").replace("token=test", "token=none"), Path("node.key"))
    with pytest.raises(LocalError, match="already"):
        key(token, "node")


def test_a_wrong_pin_is_reported(token: SoftToken, monkeypatch: pytest.MonkeyPatch) -> None:
    key(token, "node")
    token.forget()
    monkeypatch.setenv("GDP_PASSPHRASE", "0000")
    with pytest.raises(LocalError, match="Pin"):
        open_token_key(token.uri("node"), Path("node.key"))


def test_a_token_that_was_logged_out_is_opened_again(token: SoftToken) -> None:
    made = key(token, "node")
    made._key.session.close()
    made.public.verify(made.sign(b"data"), b"data")


@pytest.mark.parametrize(
    ("uri", "why"),
    [
        ("file:key", "not a PKCS #11 URI"),
        ("pkcs11:token=a", "module-path"),
        ("pkcs11:token=a?module-path=lib.so", "absolute"),
        ("pkcs11:token=a?module-path=/lib.so&pin-value=1234", "pin-value"),
        ("pkcs11:token=a;colour=red?module-path=/lib.so", "colour"),
        ("pkcs11:token=a;token=b?module-path=/lib.so", "token"),
        ("pkcs11:type=public?module-path=/lib.so", "type=private"),
        ("pkcs11:token=a?module-path=/lib.so&pin-source=pin", "pin-source"),
    ],
)
def test_an_address_of_another_form_is_refused(uri: str, why: str) -> None:
    with pytest.raises(LocalError, match=why):
        TokenUri.from_text(uri)


def test_an_address_is_read_with_its_escapes() -> None:
    where, how = "token=my%20token;object=a%3Bb;id=%01%FF;type=private", "module-path=/l.so&pin-source=/p"
    uri = TokenUri.from_text(f"pkcs11:{where}?{how}")
    assert (uri.token, uri.label, uri.key_id, uri.pin_file) == ("my token", "a;b", b"\x01\xff", Path("/p"))


def test_an_invalid_library_is_reported(tmp_path: Path) -> None:
    pytest.importorskip("pkcs11", reason="python-pkcs11 is not installed")
    write_all(tmp_path / "pin", {"pin": private(b"1234")})
    with pytest.raises(LocalError, match="no library"):
        open_token_key(f"pkcs11:token=a?module-path={tmp_path}/none.so&pin-source={tmp_path}/pin/pin", Path("k"))
