"""Token keys: signing keys in an HSM, a TPM, a smart card or SoftHSM, used through PKCS #11.

I/O; loads the token's library into this process. Needs the extra ``pkcs11``.
Source: PKCS #11, version 2.40, sections 2.3.1 (EC keys) and 2.3.6 (``CKM_ECDSA``): the token gets a digest and returns
r || s. The private key never enters this process. A token that was removed and inserted again is reopened once.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Protocol, cast

import pkcs11
import pkcs11.util.ec
from cryptography.hazmat.primitives.asymmetric import ec

from gdp.crypto.keys import SIGNATURE_BYTES, PublicKey, SigningKey
from gdp.errors import GdpError, LocalError, StatementError
from gdp.stores.files import read_private
from gdp.stores.passphrase import passphrase_for
from gdp_extensions.pkcs11.token_uri import TokenUri

_DIGEST_BYTES: Final = 32
_POINT_BYTES: Final = 65
_TRIAL: Final = b"gdp-token-trial-1"  # no statement begins with these bytes


class _PrivateKey(Protocol):
    """The parts of the library's ``PrivateKey`` that are used here."""

    id: bytes
    label: str

    @property
    def session(self) -> pkcs11.Session: ...

    def sign(self, data: bytes, *, mechanism: pkcs11.Mechanism) -> bytes: ...


@dataclass(slots=True)
class TokenKey(SigningKey):
    """A private key that its token uses for us; the token determines the cost of a signature."""

    uri: str
    public: PublicKey
    _open: Callable[[], _PrivateKey] = field(repr=False)
    _key: _PrivateKey = field(repr=False)

    def sign(self, data: bytes) -> bytes:
        """Return r || s (64 bytes) over the SHA-256 digest of the data.

        Raises:
            LocalError: the token does not sign.
        """
        return self.sign_digest(hashlib.sha256(data).digest())

    def sign_digest(self, digest: bytes) -> bytes:
        """Return r || s (64 bytes) over a SHA-256 digest (32 bytes).

        Raises:
            LocalError: the digest is not 32 bytes, or the token does not sign.
        """
        if len(digest) != _DIGEST_BYTES:
            raise LocalError("a SHA-256 digest has 32 bytes")
        try:
            signature = self._ask(digest)
        except pkcs11.PKCS11Error:
            try:
                self._key = self._open()
                signature = self._ask(digest)
            except pkcs11.PKCS11Error as error:
                raise LocalError(f"the token does not sign ({_said(error)}): {self.uri}") from error
        if len(signature) != SIGNATURE_BYTES:
            raise LocalError(f"the token's signature has {len(signature)} bytes, not {SIGNATURE_BYTES}")
        return signature

    def to_file(self, protect: Callable[[bytes], bytes] | None = None) -> bytes:
        """Return the line of a key file: the URI of the key; ``protect`` is ignored, because a URI is no secret."""
        del protect  # nothing to protect: the file only names the key
        return self.uri.encode() + b"\n"

    def _ask(self, digest: bytes) -> bytes:
        return self._key.sign(digest, mechanism=pkcs11.Mechanism.ECDSA)


def open_token_key(text: str, file: Path) -> TokenKey:
    """Open a key in a token.

    Args:
        file: file that names it, for messages and the prompt of the PIN.

    Raises:
        LocalError: the URI is invalid, the library, token or key does not exist, the PIN is wrong, or the key is not on
            P-256.
    """
    uri = TokenUri.from_text(text)
    pin = _pin(uri, file)

    def opened() -> _PrivateKey:
        """Return the private key in a new session."""
        session = _session(uri, pin)
        wanted = {**_attributes(uri), pkcs11.Attribute.CLASS: pkcs11.ObjectClass.PRIVATE_KEY}
        found = list(session.get_objects(wanted))
        if len(found) != 1:
            raise LocalError(f"{len(found)} private keys in the token fit, not one: {text}")
        return cast("_PrivateKey", found[0])

    try:
        key = opened()
        made = TokenKey(text, _public_key(uri, key), opened, key)
    except pkcs11.PKCS11Error as error:
        raise LocalError(f"the token does not open the key ({_said(error)}): {text}") from error
    try:  # before the confinement of rights: a library may read files at its first signature
        made.public.verify(made.sign(_TRIAL), _TRIAL)
    except StatementError as error:
        raise LocalError(f"the public key of the token does not match its private key: {text}") from error
    return made


def generate_token_key(text: str) -> TokenKey:
    """Make a P-256 key in a token, which it never leaves; return it opened.

    Raises:
        LocalError: the URI is invalid or lacks ``object``, a key of this label exists already, or the token refuses.
    """
    uri = TokenUri.from_text(text)
    if not uri.label:
        raise LocalError("the URI of a new key names it by object=LABEL")
    pin = _pin(uri, Path(text))
    try:
        with _session(uri, pin, is_writing=True) as session:
            wanted = {**_attributes(uri), pkcs11.Attribute.CLASS: pkcs11.ObjectClass.PRIVATE_KEY}
            if any(True for _ in session.get_objects(wanted)):
                raise LocalError(f"a private key of this label is in the token already: {text}")
            curve = pkcs11.util.ec.encode_named_curve_parameters("secp256r1")
            kind = pkcs11.KeyType.EC
            parameters = session.create_domain_parameters(kind, {pkcs11.Attribute.EC_PARAMS: curve}, local=True)
            private = {pkcs11.Attribute.SENSITIVE: True, pkcs11.Attribute.EXTRACTABLE: False}
            parameters.generate_keypair(
                id=uri.key_id or hashlib.sha256(uri.label.encode()).digest()[:8],
                label=uri.label,
                store=True,
                private_template=private,
            )
    except pkcs11.PKCS11Error as error:
        raise LocalError(f"the token makes no key ({_said(error)}): {text}") from error
    return open_token_key(text, Path(text))


def _pin(uri: TokenUri, file: Path) -> str:
    data = passphrase_for(file) if uri.pin_file is None else read_private(uri.pin_file).split(b"\n", 1)[0]
    try:
        return data.decode()
    except UnicodeDecodeError as error:
        raise LocalError(f"{uri.pin_file or file}: a PIN is UTF-8 text") from error


def _token(uri: TokenUri) -> pkcs11.Token:
    try:
        module = pkcs11.lib(str(uri.module))
        slots = module.get_slots(token_present=True)
    except (RuntimeError, pkcs11.PKCS11Error) as error:
        raise LocalError(f"{uri.module}: no library of PKCS #11 that works: {_said(error)}") from error
    tokens = [slot.get_token() for slot in slots]
    fitting = [
        token
        for token in tokens
        if (not uri.token or token.label == uri.token) and (not uri.serial or token.serial.decode() == uri.serial)
    ]
    if not uri.token and not uri.serial:
        fitting = [token for token in fitting if pkcs11.TokenFlag.TOKEN_INITIALIZED in token.flags]
    if len(fitting) != 1:
        raise LocalError(f"{len(fitting)} tokens fit, not one (token {uri.token!r}, serial {uri.serial!r})")
    return fitting[0]


def _session(uri: TokenUri, pin: str, *, is_writing: bool = False) -> pkcs11.Session:
    """Open a session; one open session of a process logs in all others (PKCS #11, section 5.6)."""
    token = _token(uri)
    try:
        return token.open(rw=is_writing, user_pin=pin)
    except pkcs11.UserAlreadyLoggedIn:
        return token.open(rw=is_writing)


def _attributes(uri: TokenUri) -> dict[pkcs11.Attribute, object]:
    names = pkcs11.Attribute
    attributes: dict[pkcs11.Attribute, object] = {}
    if uri.label:
        attributes[names.LABEL] = uri.label
    if uri.key_id:
        attributes[names.ID] = uri.key_id
    return attributes


def _public_key(uri: TokenUri, key: _PrivateKey) -> PublicKey:
    """Return the public key that the token stores with the private one, under the same id or label."""
    names = pkcs11.Attribute
    key_attributes = {names.ID: key.id} if key.id else {names.LABEL: key.label}
    found = list(key.session.get_objects({**key_attributes, names.CLASS: pkcs11.ObjectClass.PUBLIC_KEY}))
    if len(found) != 1:
        raise LocalError(f"{len(found)} public keys match the private key in the token, not one: {uri.label!r}")
    encoded = bytes(found[0][names.EC_POINT])
    try:  # some tokens wrap the point in an OCTET STRING, as specified; others do not
        point = ec.EllipticCurvePublicKey.from_encoded_point(ec.SECP256R1(), encoded[-_POINT_BYTES:])
        return PublicKey.from_point(point)
    except (ValueError, GdpError) as error:
        raise LocalError("the token's key is not ECDSA P-256") from error


def _said(error: Exception) -> str:
    return f"{type(error).__name__} {error}".strip()
