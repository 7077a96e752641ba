"""Bounds that several packages share; a bound of one mechanism is in its module.

Sans-I/O. Units end the names.
"""

from __future__ import annotations

from typing import Final

from gdp.intervals import LINK_STATE, Rate

# Frames
HOPS_MAX: Final = 64  # hops left at the source
PATHS_MAX: Final = 2  # disjoint paths of one flow
SPREAD: Final = 3  # of an advertisement's ``paths``: large messages are striped over two paths
STRIPES_FROM_PARTS: Final = 4  # a shorter message takes both paths
FRAME_MAX_BYTES: Final = 65_535  # largest Ethernet frame any port may carry, header included
MTU_MIN_BYTES: Final = 576  # a link below this is refused: a signed hello would need too many fragments
MTU_NARROWINGS: Final = 4  # times that a publisher's path may become narrower, each of which has the cache sealed again
MTU_HOLD_S: Final = 10.0  # ... and once more after this time

# Messages
MESSAGE_MAX_BYTES: Final = 24 << 20  # serialised message, before sealing; its fragments must fit into JOIN_SOURCE_BYTES
MARK_MAX_CHARS: Final = 256  # of the name of an event
SEQUENCE_BYTES: Final = 8  # before each message, under its seal: its sequence number
NUMBER_MAX: Final = (1 << 64) - 2  # message numbers have 64 bits, and each must have a successor
PARTS_MAX: Final = 1 << 17  # 64 MiB over the smallest link
PACE_MAX: Final = 255  # of a branch that gets every message
JOIN_SOURCE_BYTES: Final = 48 << 20  # reassembly memory of one source, as long as no other one needs its fair share
JOIN_TOTAL_BYTES: Final = 96 << 20  # reassembly memory of a node; a third of it holds the largest message
RECOVERY_BYTES: Final = 8 << 20  # ... of it frames of one stream that are kept to restore lost ones from parity
JOIN_MESSAGES_MAX: Final = 1_024  # unfinished messages of one source
JOIN_PATIENCE_S: Final = 5.0  # an unfinished best-effort message is dropped after this time without a new fragment
REPLAY_WINDOW_MESSAGES: Final = 16_384

# Retransmission
WINDOW_BYTES: Final = 32 << 20  # what a reliable publisher caches for repairs
PRIVATE_WAIT_BYTES: Final = 256 << 10  # of a unicast stream, while its reader does not know the public one
FLIGHT_MAX_BYTES: Final = 4 << 20  # of one publisher; what a reader must be able to hold
REPAIRS_MAX_BYTES: Final = 512 << 10  # of one publisher in a round trip, whatever its readers ask for
FLIGHT_MESSAGES_MAX: Final = 8_192  # below REPLAY_WINDOW_MESSAGES
REPORT_EVERY_BYTES: Final = 80 << 10  # a reader reports after this many new bytes
# ... or, while nothing is missing, after a quarter of the bytes since the last loss, up to this
REPORT_EVERY_MAX_BYTES: Final = 384 << 10
REPORT_DELAY_S: Final = 0.02  # ... or this long after the first fragment it has not reported
REPORT_PAUSE_S: Final = 0.004  # ... within a message: its publisher may be waiting for a report
REPORT_GAP_S: Final = 0.002  # ... or this long after it detected a gap: frames may overtake each other
REPAIRS_ABOVE_PARTS: Final = 2  # a best-effort message of more fragments is repaired while that can be in time
REPAIR_S: Final = 0.5  # ... which is this time, unless its publisher states a deadline
SENDS_MAX: Final = 3  # times that an urgent frame is sent against loss: 0.05 ** 3 is below 0.1 %
CALL_GRACE_S: Final = 0.5  # the client ends a call; the server only drops it this much later
CALLER_AWAY_S: Final = 30.0  # a client that is silent for this time has ended its wait
PATH_LAG_MAX_S: Final = 0.5  # a path that is further behind the other one is not awaited
EPOCH_GRACE_S: Final = 10.0  # after a new epoch began, reports of readers under the previous one are still accepted
NACKS_PER_REPORT: Final = 23  # ranges: a report, sealed and alone in its frame, fits the smallest supported link

# Control plane
CONTROL_MAX_BYTES: Final = 16 << 10  # one statement with its evidence
ADVERTISEMENT_MAX_BYTES: Final = (
    6_500  # with its evidence, so that a relay or response around one, or a join around two, fits a statement
)
WITHDRAWAL_MAX_BYTES: Final = 1 << 10
RECORD_OVERHEAD_BYTES: Final = 33  # what a channel adds to a statement: head and tag
CONTROL_PARTS_MAX: Final = 64
CONTROL_JOIN_BYTES: Final = 1 << 20  # reassembly of control messages, per node
CONTROL_JOIN_SOURCE_BYTES: Final = 64 << 10
CONTROL_PATIENCE_S: Final = 2.0
CBOR_DEPTH_MAX: Final = 16
CHAIN_MAX: Final = 4  # delegations between an owner's key and a node
# of a membership or delegation; a revocation may count for this time
CERTIFICATE_LIFE_MAX_S: Final = 20 * 366 * 86_400.0
CLOCK_SKEW_S: Final = 3_600.0  # a certificate is accepted this long before it begins, and after it has ended

# Neighbours and link state
COST_DEFAULT: Final = 10  # of a link
COST_AUTO: Final = 0  # of a port: the cost of its links is measured
COST_UNREACHABLE: Final = (1 << 32) - 1  # of a path that does not exist; LSInfinity of RFC 2328
LINK_STATE_AGE_MAX_S: Final = 2 * CLOCK_SKEW_S + LINK_STATE.lease_s  # by two clocks
JOINS_AGAIN_MAX: Final = 16  # whole joins that one reply about unknown ones causes
# Refreshes are sent more often over a link that loses frames: they find the joins that were lost.
JOINS_LOST_FROM: Final = 0.01  # share of frames

# Tables
TABLE_MAX: Final = 1 << 20
PENDING_FRAMES_MAX: Final = 2_048
PENDING_BYTES_MAX: Final = 4 << 20
PENDING_S: Final = 1.5
ATTACHED_MAX: Final = 16_384  # advertisements of the nodes attached to a switch, some 3 KiB each
READERS_MAX: Final = 16_384  # advertisements of the readers attached to a switch
TREES_MAX: Final = 65_536  # branches of a switch's trees, some 4 KiB each
JOINS_RATE: Final = Rate(2_000.0, burst=16_384.0)  # of one neighbouring switch; each is verified
# advertisements and withdrawals of one neighbour; each is verified and relayed
ADVERTISEMENTS_RATE: Final = Rate(2_048.0, burst=2.0 * ATTACHED_MAX)
ADVERTISEMENTS_WINDOW: Final = 1_024  # how far advertisements of one node may overtake each other
QUESTIONS_RATE: Final = Rate(16.0, burst=256.0)  # new names that an attached node may cause queries to a RIB for
SWITCH_QUESTIONS_RATE: Final = Rate(256.0, burst=2_048.0)  # ... or a neighbouring switch
RIB_NAMES_PER_SENDER: Final = 200_000
RIB_WATCHES_MAX: Final = 500_000
# of responses that one sender's queries may cause at a RIB; some 2,000 responses
# ... and at once: all that a switch queries at a RIB that is new
ANSWER_BYTES_RATE: Final = Rate(4.0 * (1 << 20), burst=64.0 * (1 << 20))
ENDPOINT_RECORDS_MAX: Final = 8_192  # at one RIB, one of each switch
ENDPOINT_RECORDS_OF_OTHERS_MAX: Final = 2_048  # ... of other domains
ENDPOINT_RECORDS_RATE: Final = Rate(4.0, burst=16.0)  # of one switch that a RIB verifies
ENDPOINT_QUERIES_RATE: Final = Rate(8.0, burst=64.0)  # of one switch or RIB
RELAY_RATE_MIN: Final = 10_000  # bytes per second into one tunnel: below it hellos would be late
RELAY_RATE_MAX: Final = (1 << 32) - 1
DIRECT_TUNNELS_MAX: Final = 32  # of one switch to others that are behind a NAT, too
LINK_STATES_RATE: Final = Rate(10.0, burst=100.0)  # of one origin that are accepted, and flooded
# new connections that a relay or an enrolment server accepts: a handshake costs about a millisecond
CONNECTIONS_RATE: Final = Rate(50.0, burst=50.0)
ADDRESS_CONNECTIONS_RATE: Final = Rate(25.0, burst=100.0)  # of one address: a site behind a NAT starts together

# Diagnostics
DIAGNOSTICS_RATE: Final = Rate(32.0, burst=64.0)  # requests of one member that a node answers
# frames of one neighbour that are read for it, before a signature is verified
DIAGNOSTIC_FRAMES_RATE: Final = Rate(1_024.0, burst=2_048.0)
DIAGNOSTIC_REPLY_MAX_BYTES: Final = 8_000  # longest reply that one request may ask for, and pays with its own length
DIAGNOSTIC_WAIT_S: Final = 1.0  # a node that must query a RIB first answers within this time

# Revocations
REVOCATIONS_PER_ROOT: Final = 262_144  # of one trusted domain
REVOCATIONS_OF_OWNERS: Final = 65_536  # of all owners and nodes whose certificates are held here
REVOCATIONS_PER_ISSUER: Final = 1_024  # of one of these
REVOCATIONS_PER_ORIGIN: Final = 8_192  # that came over one neighbour, or from one relay
