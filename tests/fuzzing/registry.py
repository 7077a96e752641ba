"""Every decoder of the project."""

from __future__ import annotations

from importlib.util import find_spec

from tests.fuzzing import far, files, ros, wire
from tests.fuzzing.decoder import Decoder

__all__ = ["DECODERS"]

DECODERS: tuple[Decoder, ...] = (*wire.DECODERS, *ros.DECODERS, *far.DECODERS, *files.DECODERS)
if find_spec("gdp_extensions") is not None:
    from tests.fuzzing import extensions

    DECODERS = (*DECODERS, *extensions.DECODERS)
