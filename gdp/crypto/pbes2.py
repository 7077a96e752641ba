"""Private files under a passphrase: PBES2 with scrypt and AES-256-CBC.

Sans-I/O; randomness comes in as an argument. Source: RFC 8018 (PBES2), RFC 7914 (scrypt and its use in PBES2), RFC 5958
(EncryptedPrivateKeyInfo). A signing key is a PKCS #8 file that ``openssl pkey`` reads. Other secrets, for which PKCS #8
has no algorithm, use the same structure under a PEM label of this project. The library's own
``BestAvailableEncryption`` derives its key with 2,048 rounds of PBKDF2, which is why it is not used.
"""

from __future__ import annotations

import base64
import binascii
from functools import lru_cache
from typing import Final

from cryptography.hazmat.primitives import padding
from cryptography.hazmat.primitives.ciphers import Cipher, algorithms, modes
from cryptography.hazmat.primitives.kdf.scrypt import Scrypt

from gdp.crypto.keys import WRONG_PASSPHRASE
from gdp.errors import LocalError

KEY_LABEL: Final = "ENCRYPTED PRIVATE KEY"  # RFC 7468, section 11
SECRET_LABEL: Final = "ENCRYPTED GDP SECRET"
_SALT_BYTES: Final = 16
_BLOCK_BYTES: Final = 16
RANDOM_BYTES: Final = _SALT_BYTES + _BLOCK_BYTES  # salt, then the first block's vector
# 16 MiB and about 0.3 s, as costly to guess as n = 2**17, p = 1; openssl(1) refuses to read more than 32 MiB.
_COST: Final = 1 << 14
_BLOCK: Final = 8
_PARALLEL: Final = 5
_KEY_BYTES: Final = 32
_LINE_CHARS: Final = 64
_DERIVED_KEPT: Final = 16  # an attacker that reads this process's memory finds the keys themselves

_PBES2: Final = bytes.fromhex("06092a864886f70d01050d")  # 1.2.840.113549.1.5.13
_SCRYPT: Final = bytes.fromhex("06092b06010401da47040b")  # 1.3.6.1.4.1.11591.4.11
_AES_256_CBC: Final = bytes.fromhex("060960864801650304012a")  # 2.16.840.1.101.3.4.1.42
_SEQUENCE: Final = 0x30
_OCTETS: Final = 0x04
_INTEGER: Final = 0x02


def protect(plain: bytes, passphrase: bytes, random: bytes, label: str) -> bytes:
    """Return ``plain`` under a passphrase, as PEM; costs about 0.3 s.

    Args:
        plain: a PrivateKeyInfo, DER, under ``KEY_LABEL``; any bytes under ``SECRET_LABEL``.
        passphrase: not empty.
        random: ``RANDOM_BYTES``, new for each file.

    Raises:
        LocalError: an empty passphrase.
    """
    if not passphrase:
        raise LocalError("a passphrase is not empty")
    salt, vector = random[:_SALT_BYTES], random[_SALT_BYTES:RANDOM_BYTES]
    padder = padding.PKCS7(8 * _BLOCK_BYTES).padder()
    cipher = Cipher(algorithms.AES(_derived(passphrase, salt)), modes.CBC(vector)).encryptor()
    sealed = cipher.update(padder.update(plain) + padder.finalize()) + cipher.finalize()
    text = base64.b64encode(_header(salt, vector, sealed)).decode()
    lines = [text[at : at + _LINE_CHARS] for at in range(0, len(text), _LINE_CHARS)]
    return "\n".join([f"-----BEGIN {label}-----", *lines, f"-----END {label}-----", ""]).encode()


def is_own_form(pem: bytes) -> bool:
    """Return whether ``open_secret`` can open a file with any label; other tools may protect keys in other forms."""
    try:
        _parts(pem)
    except LocalError:
        return False
    return True


def is_secret(data: bytes) -> bool:
    """Return whether a file holds a secret under a passphrase."""
    return data.startswith(f"-----BEGIN {SECRET_LABEL}-----".encode())


def open_secret(pem: bytes, passphrase: bytes) -> bytes:
    """Return the plaintext that ``protect`` encrypted; costs about 0.3 s the first time in a process.

    Raises:
        LocalError: a wrong passphrase, or an altered file.
    """
    salt, vector, sealed = _parts(pem)
    cipher = Cipher(algorithms.AES(_derived(passphrase, salt)), modes.CBC(vector)).decryptor()
    unpadder = padding.PKCS7(8 * _BLOCK_BYTES).unpadder()
    try:
        return unpadder.update(cipher.update(sealed) + cipher.finalize()) + unpadder.finalize()
    except ValueError as error:
        raise LocalError(WRONG_PASSPHRASE) from error


def _parts(pem: bytes) -> tuple[bytes, bytes, bytes]:
    """Return salt, vector and ciphertext of a file in exactly the form that ``protect`` writes."""
    text = b"".join(pem.split(b"-----")[2:3]).split()
    try:
        der = base64.b64decode(b"".join(text), validate=True)
    except binascii.Error as error:
        raise _unknown() from error
    algorithm, rest = _taken(_SEQUENCE, _taken(_SEQUENCE, der)[0])
    derivation, encryption = _taken(_SEQUENCE, _taken(_SEQUENCE, algorithm[len(_PBES2) :])[0])
    salt = _taken(_OCTETS, _taken(_SEQUENCE, derivation[len(_SCRYPT) :])[0])[0]
    vector = _taken(_OCTETS, _taken(_SEQUENCE, encryption)[0][len(_AES_256_CBC) :])[0]
    sealed = _taken(_OCTETS, rest)[0]
    if _header(salt, vector, sealed) != der or (len(salt), len(vector)) != (_SALT_BYTES, _BLOCK_BYTES):
        raise _unknown()
    return salt, vector, sealed


def _unknown() -> LocalError:
    return LocalError("not in the form that this program writes: PBES2, scrypt and AES-256-CBC")


def _taken(tag: int, der: bytes) -> tuple[bytes, bytes]:
    """Return the content of the first element, and the rest."""
    if len(der) < 2 or der[0] != tag:
        raise _unknown()
    size = der[1] & 0x7F if der[1] & 0x80 else 0
    length = int.from_bytes(der[2 : 2 + size], "big") if size else der[1]
    end = 2 + size + length
    if end > len(der):
        raise _unknown()
    return der[2 + size : end], der[end:]


def _header(salt: bytes, vector: bytes, sealed: bytes) -> bytes:
    """Return an EncryptedPrivateKeyInfo in DER."""
    costs = b"".join(der_element(_INTEGER, _unsigned(each)) for each in (_COST, _BLOCK, _PARALLEL))
    derivation = der_element(_SEQUENCE, _SCRYPT + der_element(_SEQUENCE, der_element(_OCTETS, salt) + costs))
    encryption = der_element(_SEQUENCE, _AES_256_CBC + der_element(_OCTETS, vector))
    algorithm = der_element(_SEQUENCE, _PBES2 + der_element(_SEQUENCE, derivation + encryption))
    return der_element(_SEQUENCE, algorithm + der_element(_OCTETS, sealed))


def der_element(tag: int, content: bytes) -> bytes:
    """Return one element of DER: tag, length, content (X.690, section 8.1)."""
    length = len(content)
    if length < 0x80:
        return bytes((tag, length)) + content
    size = _unsigned(length).lstrip(b"\0")
    return bytes((tag, 0x80 | len(size))) + size + content


def _unsigned(number: int) -> bytes:
    return number.to_bytes(number.bit_length() // 8 + 1, "big")


@lru_cache(maxsize=_DERIVED_KEPT)
def _derived(passphrase: bytes, salt: bytes) -> bytes:
    return Scrypt(salt, _KEY_BYTES, _COST, _BLOCK, _PARALLEL).derive(passphrase)
