"""States of a path's congestion controller, and the table that alone changes them.

Sans-I/O. Sources: Copa (Arun and Balakrishnan, NSDI 2018) for the two modes and the signal that a queue never empties;
HyStart++ (RFC 9406) for the end of the start-up; Nimbus (Goyal and others, SIGCOMM 2022) for probing whether a
competitor has left.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from types import MappingProxyType
from typing import Final


class State(Enum):
    """What governs the window."""

    STARTUP = "startup"  # it doubles each round trip
    DELAY = "delay"  # it keeps a short queue
    COMPETITIVE = "competitive"  # another flow keeps the queue full: it follows CUBIC
    PROBE = "probe"  # it is halved, to see whether the queue empties

    __hash__ = object.__hash__  # of a single object; that of Enum is one of its name, in Python


class Signal(Enum):
    """What was measured."""

    PATH_FULL = "path full"  # the queue grows, or the delivery rate does not
    QUEUE_STANDS = "queue stands"  # not nearly empty for some round trips, or only because this flow gave way
    QUEUE_EMPTY = "queue empty"
    PROBE_DUE = "probe due"
    PROBE_OVER = "probe over"
    PATH_SHRANK = "path shrank"  # most of what leaves is lost, round after round
    PATH_CHANGED = "path changed"

    __hash__ = object.__hash__


_S, _I = State, Signal
TRANSITIONS: Final[Mapping[tuple[State, Signal], State]] = MappingProxyType(
    {
        (_S.STARTUP, _I.PATH_FULL): _S.DELAY,
        (_S.STARTUP, _I.QUEUE_STANDS): _S.STARTUP,
        (_S.STARTUP, _I.QUEUE_EMPTY): _S.STARTUP,
        (_S.STARTUP, _I.PROBE_DUE): _S.STARTUP,
        (_S.STARTUP, _I.PROBE_OVER): _S.STARTUP,
        (_S.STARTUP, _I.PATH_SHRANK): _S.STARTUP,
        (_S.STARTUP, _I.PATH_CHANGED): _S.STARTUP,
        (_S.DELAY, _I.PATH_FULL): _S.DELAY,
        (_S.DELAY, _I.QUEUE_STANDS): _S.COMPETITIVE,
        (_S.DELAY, _I.QUEUE_EMPTY): _S.DELAY,
        (_S.DELAY, _I.PROBE_DUE): _S.DELAY,
        (_S.DELAY, _I.PROBE_OVER): _S.DELAY,
        (_S.DELAY, _I.PATH_SHRANK): _S.DELAY,
        (_S.DELAY, _I.PATH_CHANGED): _S.STARTUP,
        (_S.COMPETITIVE, _I.PATH_FULL): _S.COMPETITIVE,
        (_S.COMPETITIVE, _I.QUEUE_STANDS): _S.COMPETITIVE,
        (_S.COMPETITIVE, _I.QUEUE_EMPTY): _S.DELAY,
        (_S.COMPETITIVE, _I.PROBE_DUE): _S.PROBE,
        (_S.COMPETITIVE, _I.PROBE_OVER): _S.COMPETITIVE,
        (_S.COMPETITIVE, _I.PATH_SHRANK): _S.DELAY,
        (_S.COMPETITIVE, _I.PATH_CHANGED): _S.STARTUP,
        (_S.PROBE, _I.PATH_FULL): _S.PROBE,
        (_S.PROBE, _I.QUEUE_STANDS): _S.PROBE,
        (_S.PROBE, _I.QUEUE_EMPTY): _S.DELAY,
        (_S.PROBE, _I.PROBE_DUE): _S.PROBE,
        (_S.PROBE, _I.PROBE_OVER): _S.COMPETITIVE,
        (_S.PROBE, _I.PATH_SHRANK): _S.DELAY,
        (_S.PROBE, _I.PATH_CHANGED): _S.STARTUP,
    }
)
