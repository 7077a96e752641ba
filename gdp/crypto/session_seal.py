"""Session secret of a unicast stream: only its two ends can derive it, so its messages need no signature.

Sans-I/O. Source: X25519 (RFC 7748), HKDF (RFC 5869). ``frame/spec.md`` gives each byte.

The X25519 key of each end belongs to one incarnation and is in its signed advertisement. The secret is derived from
their agreement, the topic's secret of the epoch, and the stream's name. That name covers the service, both names, both
incarnations and the kind of authentication. The envelope derives its keys from the session secret as from a topic's
secret. So another member of the topic, which has the topic's secret, can neither open nor make a frame of the stream.

A stream has no signatures only if both ends advertise that, and both have it in their configuration. The signed and the
unsigned stream of two nodes have different names and keys. So a receiver without the option has no state for unsigned
frames, and drops them.

What is lost compared with signatures:

- Both ends have the key. A message proves its writer to the other end, and to no third party.
- Who reads the memory of one end can write to that end as any of its peers, until it restarts. With signatures, that
  takes the peer's identity key.
"""

from __future__ import annotations

from typing import Final

from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.kdf.hkdf import HKDF

_INFO: Final = b"gdp-session-1"


def session_secret(shared: bytes, secret: bytes, stream: bytes) -> bytes:
    """Return the 32-byte secret of one unicast stream under one epoch.

    Args:
        shared: the secret that the X25519 keys of both incarnations agree on.
        secret: topic secret of the epoch.
        stream: the stream's name.
    """
    return HKDF(algorithm=hashes.SHA256(), length=32, salt=secret, info=_INFO + stream).derive(shared)
