"""Settings of a publisher, and its send options: how fresh, how much and how often its messages leave."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal, TypeAlias, get_args

from gdp.client.reader_proxies import TOPICS, ReaderTimeouts
from gdp.errors import LocalError
from gdp.intervals import HOUR_S
from gdp.limits import WINDOW_BYTES

Priority: TypeAlias = Literal["urgent", "interactive", "high", "normal", "low", "bulk", "background"]
PRIORITIES: Final[tuple[Priority, ...]] = get_args(Priority)  # first what leaves first

# The first two have the flag URGENT on the wire and go before all others, in order. The others share what is left, and
# the last one takes what these leave.
_STRICT: Final = 2
_WEIGHTS: Final[dict[Priority, int]] = {"high": 16, "normal": 8, "low": 4, "bulk": 2}

WEIGHT_MAX: Final = 100
HISTORY_MESSAGES_MAX: Final = 100_000
HISTORY_BYTES_MAX: Final = WINDOW_BYTES
RATE_MIN_BITS_S: Final = 1_000.0  # less would carry a frame of 1,500 bytes in more than 12 s
RATE_MAX_BITS_S: Final = 1e12


@dataclass(frozen=True, slots=True, kw_only=True)
class SendOptions:
    """How messages of a topic share the path.

    Attributes:
        deadline_s: a best-effort message that cannot leave whole within this time is dropped (ROS 2: lifespan). None: a
            message that waits is dropped when a newer one waits, too.
        weight: share of the path, next to other topics of the same priority.
        priority: what goes first; ``high`` to ``bulk`` share the path 16 : 8 : 4 : 2, times ``weight``;
            ``background`` takes what these leave, for as long as a publisher exists.
        max_bits_s: most bits of frames per second; None: what the path carries.
        fec: messages are sent redundantly against loss that is measured; not so at the priority ``background``.
        history_bytes: most bytes that a latched topic keeps for late joiners; None: its depth alone counts.
        history_age_s: longest time that a latched message waits for late joiners; None: its depth alone counts.
        repairs: lost parts of a best-effort message are sent again while that can be in time.
        own_pace: each reader of a best-effort topic gets what its path carries; else the slowest one governs.
    """

    deadline_s: float | None = None
    weight: int = 1
    max_bits_s: float | None = None
    repairs: bool = True
    own_pace: bool = False
    fec: bool = True
    priority: Priority = "normal"
    history_bytes: int | None = None
    history_age_s: float | None = None

    @property
    def rank(self) -> int:
        """Return the place of the priority; 0 leaves first."""
        return PRIORITIES.index(self.priority)

    @property
    def is_background(self) -> bool:
        """Return whether messages leave only when no others do, as LEDBAT (RFC 6817) does."""
        return self.priority == "background"

    @property
    def is_redundant(self) -> bool:
        """Return whether messages are sent redundantly; those that may wait are repaired instead."""
        return self.fec and not self.is_background

    @property
    def share(self) -> int:
        """Return the share of the path next to all topics that are not urgent; an urgent one shares with none."""
        return self.weight * _WEIGHTS.get(self.priority, 1)


def is_urgent(priority: Priority) -> bool:
    """Return whether frames of this priority go before others wherever frames queue.

    Raises:
        LocalError: there is no such priority.
    """
    if priority not in PRIORITIES:
        raise LocalError(f"priority is one of {', '.join(PRIORITIES)}, not {priority!r}")
    return PRIORITIES.index(priority) < _STRICT


DEFAULT_OPTIONS: Final = SendOptions()


@dataclass(frozen=True, slots=True, kw_only=True)
class PublisherSettings:
    """Settings of a topic, or of all streams of a service.

    Attributes:
        reliable: readers acknowledge what they get, and lose nothing.
        depth: how many messages late joiners get (0: none).
        urgent: its frames go before those of other topics, wherever they queue.
        paths: 2: a second copy of each frame is sent, marked for the second path, while there is one. ``SPREAD``: large
            messages are striped over both.
        patience: timeouts of its readers.
        options: how fresh, how much and how often its messages leave.
    """

    reliable: bool = True
    depth: int = 0
    urgent: bool = False
    paths: int = 1
    patience: ReaderTimeouts = TOPICS
    options: SendOptions = DEFAULT_OPTIONS


RELIABLE: Final = PublisherSettings()


def checked(options: SendOptions) -> SendOptions:
    """Return the options. Raises ``LocalError``: one of them is out of bounds."""
    deadline_s, weight, max_bits_s = options.deadline_s, options.weight, options.max_bits_s
    if deadline_s is not None and not 0 < deadline_s <= HOUR_S:
        raise LocalError(f"deadline_s is above 0 and at most {HOUR_S:g} s, not {deadline_s!r}")
    if not isinstance(weight, int) or not 1 <= weight <= WEIGHT_MAX:
        raise LocalError(f"weight is a whole number from 1 to {WEIGHT_MAX}, not {weight!r}")
    if max_bits_s is not None and not RATE_MIN_BITS_S <= max_bits_s <= RATE_MAX_BITS_S:
        raise LocalError(
            f"max_bits_s is at least {RATE_MIN_BITS_S:g} and at most {RATE_MAX_BITS_S:g}, not {max_bits_s!r}"
        )
    return options
