"""Private keys and secrets on disk: plain, under a passphrase, or in a token.

I/O, through ``files``. The content of a file shows its form::

    -----BEGIN PRIVATE KEY-----             a signing key, PKCS #8, guarded by the file's mode alone
    -----BEGIN ENCRYPTED PRIVATE KEY-----   the same under a passphrase (``gdp/crypto/pbes2``)
    pkcs11:token=...;object=...             the key is in a token (extension ``pkcs11``), and the file names it
    32 or 96 bytes                          an owner's master secret, a node's KEM key
    -----BEGIN ENCRYPTED GDP SECRET-----    the same under a passphrase

A file that is missing, not private, invalid, or does not open raises ``LocalError`` with its name; an empty passphrase
raises one, too.
"""

from __future__ import annotations

import secrets
from enum import Enum
from pathlib import Path
from typing import Final, Protocol

from gdp.crypto.keys import WRONG_PASSPHRASE, SigningKey, is_encrypted
from gdp.crypto.pbes2 import KEY_LABEL, RANDOM_BYTES, SECRET_LABEL, is_own_form, is_secret, open_secret, protect
from gdp.errors import GdpError, LocalError
from gdp.extras import Seam
from gdp.stores.files import NewFile, private, read_private
from gdp.stores.passphrase import passphrase_for

SCHEME: Final = "pkcs11:"  # RFC 7512


class TokenKeys(Protocol):
    """Signing keys in tokens, named by URIs."""

    def open_token_key(self, text: str, file: Path) -> SigningKey:
        """Return the key of a URI, which a file holds."""

    def generate_token_key(self, text: str) -> SigningKey:
        """Make the key that a URI describes."""


TOKEN_KEYS: Final[Seam[TokenKeys]] = Seam("gdp.token_keys")


class Storage(str, Enum):
    """Form in which a private key is stored."""

    PLAIN = "plain"
    PASSPHRASE = "passphrase"
    TOKEN = "token"


def storage_of(path: Path) -> Storage:
    """Return how a private file guards its content."""
    return _storage(read_private(path))


def read_signing_key(path: Path) -> SigningKey:
    """Read a signing key."""
    data = read_private(path)
    storage = _storage(data)
    try:
        if storage is Storage.TOKEN:
            return TOKEN_KEYS.get("pkcs11", str(path)).open_token_key(data.decode("utf-8", "replace").strip(), path)
        if storage is Storage.PASSPHRASE and is_own_form(data):
            return _opened_key(open_secret(data, passphrase_for(path)))
        return SigningKey.from_pem(data, passphrase_for(path) if storage is Storage.PASSPHRASE else None)
    except GdpError as error:
        raise _naming(path, error) from error


def _opened_key(plain: bytes) -> SigningKey:
    try:
        return SigningKey.from_der(plain)
    except LocalError as error:  # one wrong passphrase in 256 yields a valid padding
        raise LocalError(WRONG_PASSPHRASE) from error


def read_secret(path: Path) -> bytes:
    """Read another secret: an owner's master secret, a node's KEM key."""
    data = read_private(path)
    if _storage(data) is not Storage.PASSPHRASE:
        return data
    try:
        return open_secret(data, passphrase_for(path))
    except GdpError as error:
        raise _naming(path, error) from error


def key_file(key: SigningKey, passphrase: bytes | None = None) -> NewFile:
    """Return the file that holds a signing key, or names its token."""
    if passphrase is None:
        return private(key.to_file())
    return private(key.to_file(lambda plain: protect(plain, passphrase, secrets.token_bytes(RANDOM_BYTES), KEY_LABEL)))


def secret_file(secret: bytes, passphrase: bytes | None = None) -> NewFile:
    """Return the file that holds another secret."""
    if passphrase is None:
        return private(secret)
    return private(protect(secret, passphrase, secrets.token_bytes(RANDOM_BYTES), SECRET_LABEL))


def _storage(data: bytes) -> Storage:
    if data.startswith(SCHEME.encode()):
        return Storage.TOKEN
    has_passphrase = is_secret(data) or (data.startswith(b"-----BEGIN") and is_encrypted(data))
    return Storage.PASSPHRASE if has_passphrase else Storage.PLAIN


def _naming(path: Path, error: GdpError) -> LocalError:
    text = str(error)
    return LocalError(text if text.startswith(str(path)) else f"{path}: {text}")
