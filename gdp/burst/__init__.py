"""Burst core: work on many frames in one call.

Sans-I/O, but for what the compiled twins add for ``gdp/ports`` alone. Each part has two twins. The one in Python is
normative and works everywhere. The compiled one is in C, over OpenSSL's libcrypto; ``scripts/setup.sh`` builds it where
a compiler is. Tests hold both equal, byte for byte. With ``GDP_BURST=python`` in its environment a process uses Python.

Attributes:
    CIPHER: the cipher of a message.
    PLAINTEXT: the buffer of a message that is opened part by part.
    DIGEST: SHA-256, which a cipher's calls also feed.
    received: makes received frames of the slots of a pool.
    runs: finds the slots that leave together; compiled, ``SYSTEM_CALLS`` does that as it forwards.
    samples: finds the samples among frames.
    SYSTEM_CALLS: receives, sends or forwards many frames in one call; None: ``gdp/ports`` does, by ctypes or sockets.
    VARIANT: which twins are in use, in words.
"""

from __future__ import annotations

import hashlib
import os
from importlib import import_module
from typing import Any, Final

from gdp.burst.cipher import MessageCipher, Plaintext
from gdp.burst.slots import received, runs, samples

__all__ = ["CIPHER", "DIGEST", "PLAINTEXT", "SYSTEM_CALLS", "VARIANT", "received", "runs", "samples"]

_INTERFACE: Final = 6  # as in ``core.c``


def _compiled() -> Any:
    """Return the module of the compiled twins; None: it is not there, or of an older source."""
    try:
        module = import_module("gdp.burst.core")
    except ImportError:
        return None
    return None if os.environ.get("GDP_BURST") == "python" or module.INTERFACE != _INTERFACE else module


_core = SYSTEM_CALLS = _compiled()
CIPHER, PLAINTEXT, DIGEST, VARIANT = MessageCipher, Plaintext, hashlib.sha256, "Python"
if _core is not None:
    CIPHER, PLAINTEXT, DIGEST = _core.MessageCipher, _core.Plaintext, _core.RunningDigest
    received, samples = _core.received, _core.samples
    VARIANT = f"compiled, {_core.LIBRARY}"
