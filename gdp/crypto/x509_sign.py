"""X.509 signing with any key, also one in a token.

Sans-I/O except for the randomness of a token. Source: RFC 5280, section 4.1; RFC 2986, section 4; RFC 6979 for the
signatures of this process. The library signs with its own keys only. For another key, a temporary key signs first; the
part to be signed is taken from its result and gets the real key's signature.
"""

from __future__ import annotations

from typing import Final

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat

from gdp.crypto.keys import PublicKey, SigningKey, SoftwareKey
from gdp.crypto.pbes2 import der_element

_SEQUENCE: Final = 0x30
_BITS: Final = 0x03
_ECDSA_SHA256: Final = bytes.fromhex("300a06082a8648ce3d040302")  # RFC 5758, section 3.2


def signed_certificate(builder: x509.CertificateBuilder, key: SigningKey) -> bytes:
    """Return a certificate, DER."""
    if isinstance(key, SoftwareKey):
        return builder.sign(key.private, hashes.SHA256(), ecdsa_deterministic=True).public_bytes(Encoding.DER)
    draft = builder.sign(SigningKey.generate().private, hashes.SHA256())
    return _completed(draft.tbs_certificate_bytes, key)


def signed_request(builder: x509.CertificateSigningRequestBuilder, key: SigningKey) -> bytes:
    """Return a certificate request, PEM."""
    if isinstance(key, SoftwareKey):
        return builder.sign(key.private, hashes.SHA256(), ecdsa_deterministic=True).public_bytes(Encoding.PEM)
    drawn = SigningKey.generate()
    draft = builder.sign(drawn.private, hashes.SHA256()).tbs_certrequest_bytes
    # Both are P-256 keys, so that the temporary one has the same length.
    wire = _completed(draft.replace(_info(drawn.public), _info(key.public)), key)
    return x509.load_der_x509_csr(wire).public_bytes(Encoding.PEM)


def _completed(signed_part: bytes, key: SigningKey) -> bytes:
    signature = der_element(_BITS, b"\0" + key.sign_der(signed_part))
    return der_element(_SEQUENCE, signed_part + _ECDSA_SHA256 + signature)


def _info(key: PublicKey) -> bytes:
    return key.point.public_bytes(Encoding.DER, PublicFormat.SubjectPublicKeyInfo)
