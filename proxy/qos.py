"""Which QoS to ask of local publishers, and which to offer to local readers, so that all match.

Place: pure.
Source: DDS 1.4, section 2.2.3: a reader and a writer match if what is offered is no less than what is requested.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final

from proxy.serial.channel import Qos

__all__ = ["DEPTH_MAX", "NEVER", "default", "depth_of", "kept", "offer", "request", "unmatched"]

NEVER: Final = (9_223_372_036, 854_775_807)  # how ROS 2 writes an infinite duration
DEPTH_MAX: Final = 64  # messages kept for late joiners of one topic
_DEPTH: Final = 10  # where none is known; ROS 2's own default
_READER_DEPTH: Final = 1_000  # of our own subscriptions: a burst waits here, not at its publisher


def default(*, reliable: bool = True, latched: bool = False, depth: int = _DEPTH) -> Qos:
    """Return a profile that promises nothing about time."""
    reliability = "reliable" if reliable else "best_effort"
    durability = "transient_local" if latched else "volatile"
    return Qos("keep_last", depth, reliability, durability, NEVER, NEVER, "automatic", NEVER, plain_names=False)


def depth_of(profile: Qos) -> int:
    """Return how many messages a profile keeps, as far as it says so."""
    if profile.history == "keep_all":
        return DEPTH_MAX
    return profile.depth or (1 if profile.durability == "transient_local" else _DEPTH)


def request(offers: Sequence[Qos]) -> Qos:
    """Return what to request so that every one of these publishers matches."""
    return default(
        reliable=all(each.reliability != "best_effort" for each in offers),
        latched=bool(offers) and all(each.durability == "transient_local" for each in offers),
        depth=_READER_DEPTH,
    )


def kept(offers: Sequence[Qos]) -> int:
    """Return how many messages late joiners of these publishers' topic want; 0: none.

    With several publishers, whose messages come without their sender, as many as may be are kept: one that publishes
    often must not push out what another one latched.
    """
    latched = [each for each in offers if each.durability == "transient_local"]
    if not latched or len(latched) < len(offers):
        return 0
    return DEPTH_MAX if len(latched) > 1 else min(depth_of(latched[0]), DEPTH_MAX)


def offer(source: Qos | None, wants: Iterable[Qos], *, is_latched: bool = False) -> Qos:
    """Return what to offer: what the far publisher does, and more where a local reader insists."""
    reliable = source is None or source.reliability != "best_effort"
    latched = is_latched or (source is not None and source.durability == "transient_local")
    depth = _DEPTH if source is None else depth_of(source)
    for want in wants:
        reliable = reliable or want.reliability == "reliable"
        latched = latched or want.durability == "transient_local"
    return default(reliable=reliable, latched=latched, depth=max(depth, 1))


def unmatched(want: Qos) -> str:
    """Return which policy of a local reader nobody beyond a network can promise, empty where there is none."""
    if want.deadline not in (NEVER, (0, 0)):
        return "it requests a deadline"
    if want.liveliness not in ("automatic", "system_default", "unknown", "best_available"):
        return f"it requests liveliness {want.liveliness}"
    if want.lease not in (NEVER, (0, 0)):
        return "it requests a liveliness lease"
    return ""
