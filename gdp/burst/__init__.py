"""Burst core: work on many frames in one call.

Sans-I/O. Each part has two twins. The one in Python is normative and works everywhere. ``core.c`` is the compiled one,
over OpenSSL's libcrypto; ``scripts/setup.sh`` builds it where a compiler is. Tests hold both equal, byte for byte. With
``GDP_BURST=python`` in its environment a process uses Python.

Attributes:
    CIPHER: the cipher of a message.
    received: makes received frames of the slots of a pool.
    VARIANT: which twins are in use, in words.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from importlib import import_module
from typing import Any, Final

from gdp.burst import slots
from gdp.burst.cipher import MessageCipher
from gdp.sansio import ReceivedFrame

__all__ = ["CIPHER", "VARIANT", "received"]

_INTERFACE: Final = 1  # as in ``core.c``


def _compiled() -> Any:
    """Return the module of the compiled twins; None: it is not there, or of an older source."""
    try:
        module = import_module("gdp.burst.core")
    except ImportError:
        return None
    return None if os.environ.get("GDP_BURST") == "python" or module.INTERFACE != _INTERFACE else module


_core: Final = _compiled()
CIPHER: type[MessageCipher] = MessageCipher if _core is None else _core.MessageCipher
received: Callable[[bytearray, int, list[int], int, float], list[ReceivedFrame]] = (
    slots.received if _core is None else _core.received
)
VARIANT: Final = "Python" if _core is None else f"compiled, {_core.LIBRARY}"
