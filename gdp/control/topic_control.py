"""Control of a topic that one publisher at a time may steer: what its readers are asked, and how to act on it.

Sans-I/O. ``gdp control``, the services of a proxy and the answers of a reader have the same words from here.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from gdp.crypto.schema import FLAG, Keyed, text, uint

ASK: Final = "control"
TAKE, GIVE, SHOW = "take", "give", "show"
REPLY_BYTES: Final = 1_024
NO_READER: Final = (
    "no reader that answers has it under exclusive control; does a node read it there, and has the rule"
    " 'control: exclusive'?"
)
NO_ANSWER: Final = "no answer: it may have been done"

ACT: Final = Keyed("do", text(8), absent=SHOW)
AT: Final = Keyed("at", uint(), absent=0)  # the asker's wall clock, Unix nanoseconds
FORCE: Final = Keyed("force", FLAG, absent=False)
SEEN: Final = Keyed("seen", uint(), absent=0)  # generation
TO: Final = Keyed("to", text(256), absent="")  # label of a publisher; empty: none gets it


def has_control(result: Mapping[str, object]) -> bool:
    """Return whether the result of a reader says that it has the topic under exclusive control."""
    return "state" in result


def request(act: str, result: Mapping[str, object], **arguments: object) -> dict[str, object]:
    """Return the body that asks a reader to act, with the generation that its last result states."""
    return {ACT.key: act, SEEN.key: result.get("generation"), **arguments}
