"""Every decoder of the project."""

from __future__ import annotations

from typing import Final

from tests.fuzzing import far, files, ros, wire
from tests.fuzzing.decoder import Decoder

__all__ = ["DECODERS"]

DECODERS: Final[tuple[Decoder, ...]] = (*wire.DECODERS, *ros.DECODERS, *far.DECODERS, *files.DECODERS)
