"""Decoders of extensions."""

from __future__ import annotations

from typing import Final

from gdp.errors import LocalError
from gdp_extensions.pkcs11.token_uri import TokenUri
from tests.fuzzing.decoder import Decoder

__all__ = ["DECODERS"]

_TOKEN: Final = b"pkcs11:token=a%20b;object=n;id=%01;type=private?module-path=/l.so&pin-source=file:/p"

DECODERS: Final = (
    Decoder("token-uri", lambda data: TokenUri.from_text(data.decode("latin-1")), (_TOKEN,), (LocalError,)),
)
