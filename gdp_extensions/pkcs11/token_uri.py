"""PKCS #11 URIs: the object, its token, and the library.

Sans-I/O.
Source: RFC 7512. Supported are ``token``, ``serial``, ``object``, ``id`` and ``type=private`` in the path, and
``module-path`` and ``pin-source`` in the query. Another attribute is refused rather than ignored, because it would
select less than the URI states. ``pin-value`` is refused: a PIN is not part of an address.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final
from urllib.parse import unquote, unquote_to_bytes, urlsplit

from gdp.errors import LocalError
from gdp.stores.private_keys import SCHEME

_EXAMPLE: Final = "pkcs11:token=robot;object=node?module-path=/usr/lib/softhsm/libsofthsm2.so"


@dataclass(frozen=True, slots=True, kw_only=True)
class TokenUri:
    """URI of a key.

    Args:
        module: the library of the token, absolute path.
        token, serial: of the token; empty: any, of which there must be one.
        label, key_id: of the key; empty: any, of which there must be one.
        pin_file: a private file with the user's PIN; None: requested like a passphrase.
    """

    module: Path
    token: str = ""
    serial: str = ""
    label: str = ""
    key_id: bytes = b""
    pin_file: Path | None = None

    @classmethod
    def from_text(cls, text: str) -> TokenUri:
        """Read a URI. Raises ``LocalError``: the form is not supported; the text gives the reason."""
        if not text.startswith(SCHEME) or not text.isprintable():
            raise LocalError(f"not a PKCS #11 URI, such as {_EXAMPLE}")
        path, _, query = text.removeprefix(SCHEME).partition("?")
        where = _pairs(path, ";", ("token", "serial", "object", "id", "type"))
        how = _pairs(query, "&", ("module-path", "pin-source"))
        if where.get("type", "private") != "private":
            raise LocalError("a PKCS #11 URI names a private key: type=private")
        module = Path(unquote(how.get("module-path", "")))
        if not module.is_absolute():
            raise LocalError(f"a PKCS #11 URI names its library by an absolute module-path, as in {_EXAMPLE}")
        source = unquote(how.get("pin-source", ""))
        return cls(
            module=module,
            token=unquote(where.get("token", "")),
            serial=unquote(where.get("serial", "")),
            label=unquote(where.get("object", "")),
            key_id=unquote_to_bytes(where.get("id", "")),
            pin_file=_pin_file(source) if source else None,
        )


def _pairs(text: str, separator: str, known: tuple[str, ...]) -> dict[str, str]:
    found: dict[str, str] = {}
    for part in filter(None, text.split(separator)):
        key, equals, value = part.partition("=")
        if key == "pin-value":
            raise LocalError("pin-value in a PKCS #11 URI: put the PIN into a private file and say pin-source=FILE")
        if not equals or key not in known or key in found:
            raise LocalError(f"a PKCS #11 URI with {key[:40]!r}: expected each of {', '.join(known)} at most once")
        found[key] = value
    return found


def _pin_file(source: str) -> Path:
    path = Path(urlsplit(source).path if source.startswith("file:") else source)
    if not path.is_absolute():
        raise LocalError("pin-source of a PKCS #11 URI is the absolute path of a private file, or file:/PATH")
    return path
