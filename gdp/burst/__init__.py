"""Burst core: work on many frames in one call.

Sans-I/O. Each part has two twins. The one in Python is normative and works everywhere. ``core.c`` is the compiled one,
over OpenSSL's libcrypto; ``scripts/setup.sh`` builds it where a compiler is. Tests hold both equal, byte for byte. With
``GDP_BURST=python`` in its environment a process uses Python.

Attributes:
    CIPHER: the cipher of a message.
    received: makes received frames of the slots of a pool.
    runs: finds the slots that leave together.
    VARIANT: which twins are in use, in words.
"""

from __future__ import annotations

import os
from importlib import import_module
from typing import Any, Final

from gdp.burst.cipher import MessageCipher
from gdp.burst.slots import received, runs

__all__ = ["CIPHER", "VARIANT", "received", "runs"]

_INTERFACE: Final = 3  # as in ``core.c``


def _compiled() -> Any:
    """Return the module of the compiled twins; None: it is not there, or of an older source."""
    try:
        module = import_module("gdp.burst.core")
    except ImportError:
        return None
    return None if os.environ.get("GDP_BURST") == "python" or module.INTERFACE != _INTERFACE else module


_core: Final = _compiled()
CIPHER, VARIANT = MessageCipher, "Python"
if _core is not None:
    CIPHER, received, runs = _core.MessageCipher, _core.received, _core.runs
    VARIANT = f"compiled, {_core.LIBRARY}"
