"""Private keys on disk under a passphrase, which only its holder can open."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from gdp.cli.gdp import main
from gdp.crypto.certificates import Role
from gdp.crypto.keys import SigningKey
from gdp.crypto.pbes2 import KEY_LABEL, SECRET_LABEL, open_secret, protect
from gdp.errors import LocalError
from gdp.stores.files import private, write_all
from gdp.stores.issue import make_domain, make_node, make_owner
from gdp.stores.keyring import load_domain, load_identity, load_owner, storage
from gdp.stores.private_keys import Storage, read_signing_key

PASSPHRASE = b"correct horse battery staple"
RANDOM = bytes(range(32))
NOW = 1_800_000_000.0


@pytest.fixture(autouse=True)
def alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gdp.crypto.pbes2._COST", 16)
    for name in ("GDP_PASSPHRASE", "GDP_PASSPHRASE_FILE", "CREDENTIALS_DIRECTORY"):
        monkeypatch.delenv(name, raising=False)


@pytest.fixture
def keys(tmp_path: Path) -> Path:
    make_domain(tmp_path / "school", "school", unix_s=NOW, passphrase=PASSPHRASE)
    make_owner(tmp_path / "owner", passphrase=PASSPHRASE)
    return tmp_path


def gdp(*arguments: object) -> int:
    with pytest.raises(SystemExit) as ended:
        main([*map(str, arguments)])
    return int(ended.value.code or 0)


def test_a_secret_opens_with_its_passphrase_only() -> None:
    sealed = protect(bytes(32), PASSPHRASE, RANDOM, SECRET_LABEL)
    assert open_secret(sealed, PASSPHRASE) == bytes(32)
    with pytest.raises(LocalError, match="wrong passphrase"):
        open_secret(sealed, b"another")


@pytest.mark.parametrize("cut", [b"", b"-----BEGIN ENCRYPTED GDP SECRET-----", b"-----BEGIN X-----\nMAA=\n-----"])
def test_what_is_not_in_the_form_is_refused(cut: bytes) -> None:
    with pytest.raises(LocalError, match="form"):
        open_secret(cut, PASSPHRASE)


def test_no_altered_byte_of_a_secret_raises_another_error() -> None:
    lines = protect(bytes(16), PASSPHRASE, RANDOM, SECRET_LABEL).split(b"\n")
    for at in range(0, len(lines[1]), 7):
        body = bytearray(lines[1])
        body[at] = ord("B") if body[at] != ord("B") else ord("C")
        altered = b"\n".join([lines[0], bytes(body), *lines[2:]])
        try:
            opened = open_secret(altered, PASSPHRASE)
        except LocalError:
            continue
        assert opened != bytes(16) or len(opened) != 16


def test_openssl_reads_a_protected_key(tmp_path: Path) -> None:
    key = SigningKey.generate()
    pem = key.to_file(lambda plain: protect(plain, PASSPHRASE, RANDOM, KEY_LABEL))
    (tmp_path / "k.pem").write_bytes(pem)
    (tmp_path / "pass").write_bytes(PASSPHRASE)
    command = ["openssl", "pkey", "-in", "k.pem", "-passin", "file:pass", "-pubout"]
    try:
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, check=True, timeout=60)
    except FileNotFoundError:
        pytest.skip("openssl is not installed")
    assert done.stdout == key.public.to_pem()


def test_a_protected_domain_holds_no_plain_key_and_opens(keys: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert b"BEGIN ENCRYPTED PRIVATE KEY" in (keys / "school/root.key").read_bytes()
    assert set(storage(keys / "owner").values()) == {Storage.PASSPHRASE}
    monkeypatch.setenv("GDP_PASSPHRASE", PASSPHRASE.decode())
    assert load_domain(keys / "school").root.label == "school"
    assert len(load_owner(keys / "owner").master) == 32


@pytest.mark.parametrize("name", ["school", "owner"])
def test_a_wrong_passphrase_names_the_file(keys: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GDP_PASSPHRASE", "another")
    with pytest.raises(LocalError, match=rf"{name}/\w+.key: does not open: a wrong passphrase"):
        (load_domain if name == "school" else load_owner)(keys / name)


def test_without_a_terminal_the_error_says_where_a_passphrase_may_come_from(keys: Path) -> None:
    with pytest.raises(LocalError, match="GDP_PASSPHRASE_FILE"):
        load_domain(keys / "school")


def test_a_passphrase_comes_from_a_file_or_from_systemd(keys: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_all(keys / "credentials", {"gdp.passphrase": private(PASSPHRASE + b"\n")})
    monkeypatch.setenv("CREDENTIALS_DIRECTORY", str(keys / "credentials"))
    load_domain(keys / "school")
    monkeypatch.setenv("GDP_PASSPHRASE", "another")
    monkeypatch.setenv("GDP_PASSPHRASE_FILE", str(keys / "credentials/gdp.passphrase"))
    load_domain(keys / "school")


def test_a_passphrase_file_for_everybody_is_refused(keys: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (keys / "pass").write_bytes(PASSPHRASE)
    (keys / "pass").chmod(0o644)
    monkeypatch.setenv("GDP_PASSPHRASE_FILE", str(keys / "pass"))
    with pytest.raises(LocalError, match="0644"):
        load_domain(keys / "school")


def test_keys_are_protected_changed_and_taken_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make_domain(tmp_path / "school", "school", unix_s=NOW)
    make_node(tmp_path / "node", Role.PROXY, "robot", tmp_path / "school", unix_s=NOW)
    before = load_identity(tmp_path / "node", NOW)
    monkeypatch.setenv("GDP_PASSPHRASE", "first")
    assert gdp("key", "protect", tmp_path / "node") == 0
    assert set(storage(tmp_path / "node").values()) == {Storage.PASSPHRASE}
    write_all(tmp_path / "new", {"pass": private(b"second")})
    gdp("key", "protect", tmp_path / "node", "--new-passphrase-file", tmp_path / "new/pass")
    with pytest.raises(LocalError, match="wrong passphrase"):
        load_identity(tmp_path / "node", NOW)
    monkeypatch.setenv("GDP_PASSPHRASE", "second")
    assert load_identity(tmp_path / "node", NOW).kem == before.kem
    gdp("key", "unprotect", tmp_path / "node")
    monkeypatch.delenv("GDP_PASSPHRASE")
    assert load_identity(tmp_path / "node", NOW).key.public == before.key.public
    assert all((tmp_path / "node" / name).stat().st_mode & 0o777 == 0o600 for name in ("node.key", "kem.key"))


def test_a_wrong_passphrase_leaves_every_file_as_it_was(keys: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = {path: path.read_bytes() for path in (keys / "owner").iterdir()}
    monkeypatch.setenv("GDP_PASSPHRASE", "another")
    assert gdp("key", "unprotect", keys / "owner") == 2
    assert before == {path: path.read_bytes() for path in (keys / "owner").iterdir()}


def test_commands_take_a_passphrase_from_no_argument(capsys: pytest.CaptureFixture[str]) -> None:
    for command in ("protect", "unprotect"):
        gdp("key", command, "--help")
        assert "--passphrase " not in capsys.readouterr().out


def test_a_key_that_openssl_protected_opens_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    key = SigningKey.generate()
    (tmp_path / "plain.pem").write_bytes(key.to_pem())
    command = ["openssl", "pkcs8", "-topk8", "-in", "plain.pem", "-passout", "pass:x", "-out", "sealed.pem"]
    try:
        subprocess.run(command, cwd=tmp_path, capture_output=True, check=True, timeout=60)
    except FileNotFoundError:
        pytest.skip("openssl is not installed")
    (tmp_path / "sealed.pem").chmod(0o600)
    monkeypatch.setenv("GDP_PASSPHRASE", "x")
    assert read_signing_key(tmp_path / "sealed.pem").public == key.public
