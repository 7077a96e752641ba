"""Named intervals, and the formulas by which other times derive from them.

Sans-I/O; imports nothing of this project. A time of one mechanism alone is in its module; one idea has one value here.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final, NamedTuple

NEVER_S: Final = float("inf")
MINUTE_S: Final = 60
HOUR_S: Final = 3_600
DAY_S: Final = 86_400


@dataclass(frozen=True, slots=True)
class SoftState:
    """State that its owner sends again before those who keep it forget it.

    Source: RFC 7761, section 4.11 (a join is held for 3.5 periods); RFC 2205, section 3.7.

    Attributes:
        refresh_s: between two sends.
        periods: for which it is kept; a whole one less may be lost in a row.
        lease_s: how long it is kept after it was last sent.
    """

    refresh_s: float
    periods: float = 3.5
    lease_s: float = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "lease_s", self.periods * self.refresh_s)


class Rate(NamedTuple):
    """What one peer may cause (RFC 2697): so often a second, and so many at once."""

    per_s: float
    burst: float


def renew_after_s(lease_s: float) -> float:
    """Return when a lease is renewed after it began: two renewals may be lost (RFC 8415, section 21.4, has a half)."""
    return lease_s / 3


# Soft state
NEIGHBOUR: Final = SoftState(0.25, periods=3.6)  # a hello, until keepalives come; without keepalives it is lost then
LINK_STATE: Final = SoftState(30.0, periods=10 / 3)
JOIN: Final = SoftState(2.0)  # a branch of a tree
JOIN_PROOF: Final = SoftState(60.0, periods=3)  # a whole join; in between only its number is sent
ADVERTISEMENT: Final = SoftState(8.0, periods=3)  # unless a node's configuration sets another lease
ENDPOINT: Final = SoftState(20.0, periods=3)  # an endpoint record at a RIB
READER: Final = SoftState(1.0, periods=6)  # a report; a reader that sends none for so long blocks its publisher no more
SERVER: Final = SoftState(0.5, periods=4)  # a report to clients; a server that sends none for so long is no peer

HELLO_IDLE: Final = 16  # hello intervals between two hellos, once keepalives of the neighbours arrive
KEEPALIVE_MS: Final = 70  # between keepalives to a neighbour that is up
SCAPY_KEEPALIVE_MS: Final = 500  # ... with the data plane that builds each frame by Scapy: some hundred frames a second
DETECT_MULTIPLIER: Final = 3  # missed keepalives after which it is lost
OWING: Final = SoftState(KEEPALIVE_MS / 1e3, periods=DETECT_MULTIPLIER)  # reports of a server that owes a response
LEASE_MIN_S: Final = 1.0
LEASE_MAX_S: Final = 3_600.0
NEGATIVE_LEASE_S: Final = 0.5  # short: a query may just miss the advertisement that answers it

# Looks at what has no event
PACE_S: Final = 0.1  # between turns of work in the background of a data plane
LOOK_S: Final = 0.05  # by who waits for it: a process that ends, a socket that appears
WATCH_S: Final = 0.25  # by who shows it to an operator
TICK_S: Final = 0.5  # by a node: its files, its clients, its rules
UPKEEP_S: Final = 1.0  # at what changes rarely: devices, memberships, journals
POLL_S: Final = 2.0  # at what another program answers: counters, machines of a provider

# Requests to a program, until it counts as silent
PROMPT_S: Final = 0.5  # silence is an answer, too, and others wait meanwhile
ANSWER_S: Final = 2.0  # on this machine, from its state
RELOAD_S: Final = 10.0  # ... from its files, which it reads again
CONNECT_S: Final = 5.0  # handshake with another machine
TRY_S: Final = 2.0  # ... at one of several addresses
SERVER_S: Final = 30.0  # work of a server, or of a program of the system
RETRY_S: Final = 5.0  # after a failure that time alone may end
REFUSED_S: Final = 10.0  # for which a refusal, or silence, of one server is remembered
IDLE_S: Final = 10.0  # a connection without a request may be closed for another one
CACHE_S: Final = 30.0  # for which an answer of another service is used again

# Life of programs
TURN_S: Final = 0.0002  # longest wait of a thread for the interpreter; Python's default is 5 ms
SCHEDULED_S: Final = 0.02  # within which a process runs that has work; later, the machine is busy
ATTACH_S: Final = 10.0  # until a device is there, or a switch has accepted a node
STOP_S: Final = 5.0  # from SIGTERM to SIGKILL
STEADY_S: Final = 30.0  # a program that ran this long is started again at once
LINGER_S: Final = 1.0  # for which a node that leaves waits for confirmations of its last messages
GOODBYE_S: Final = 0.2  # ... and for its goodbye to be sent
DRAIN_S: Final = 60.0  # until a server that leaves has answered all calls
FORGET_S: Final = 60.0  # for which the state of what is gone, or silent, is kept

# Reports
REPORT_S: Final = 5.0  # of what is young or makes no progress, until the reason is reported
