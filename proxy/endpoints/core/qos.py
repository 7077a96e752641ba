"""QoS to request from local publishers, and to offer to local readers, so that all match.

Sans-I/O.
Source: DDS 1.4, section 2.2.3: a reader and a writer match if what is offered is no less than what is requested.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final

from gdp.config.offered_qos import OFFERED_DEPTH_MAX
from gdp.intervals import NEVER_S
from proxy.serial.channel import NEVER, Channel, Qos

DEPTH_MAX: Final = 64  # messages kept for late joiners of one publisher
INFINITE_FROM_S: Final = 2_147_483_647  # DDS's own infinite value
_DEPTH: Final = 10  # where none is known; ROS 2's own default
_TIMES: Final = {"deadline": "a deadline", "lease": "a lease of liveliness"}
_READER_DEPTH: Final = 1_000  # of the proxy's own subscriptions: a burst waits here, not at its publisher


def default(*, reliable: bool = True, latched: bool = False, depth: int = _DEPTH) -> Qos:
    """Return a profile that promises nothing about time."""
    reliability = "reliable" if reliable else "best_effort"
    durability = "transient_local" if latched else "volatile"
    return Qos(depth=depth, reliability=reliability, durability=durability)


def depth_of(profile: Qos) -> int:
    """Return the number of messages that a profile keeps; the discovery of DDS does not state it."""
    if profile.history == "keep_all":
        return DEPTH_MAX
    return profile.depth or (DEPTH_MAX if profile.durability == "transient_local" else _DEPTH)


def is_depth_unknown(offers: Sequence[Qos]) -> bool:
    """Return whether these are one latched publisher's, which does not state how much it keeps."""
    return len(offers) == 1 and offers[0].durability == "transient_local" and not offers[0].depth


def deadline_s(offers: Sequence[Qos]) -> float | None:
    """Return for how many seconds the messages of these publishers are of use; None: for any time.

    A lifespan says so. Without it, a best-effort reader has no use for a message that is older than one deadline
    period. Messages come without their sender, so the longest time counts.
    """
    times = [_seconds(each.lifespan) or _seconds(each.deadline) for each in offers]
    known = [time for time in times if time is not None]
    return max(known) if known and len(known) == len(times) else None


def request(offers: Sequence[Qos]) -> Qos:
    """Return the profile to request so that every one of these publishers matches."""
    return default(
        reliable=all(each.reliability != "best_effort" for each in offers),
        latched=bool(offers) and all(each.durability == "transient_local" for each in offers),
        depth=_READER_DEPTH,
    )


def joint(channel: Channel) -> Qos:
    """Return one profile that all publishers which a channel describes fulfil."""
    latched = [each for each in channel.qos if channel.latched and each.durability == "transient_local"]
    if not channel.qos:
        return default(latched=channel.latched)
    profile = replace(request(channel.qos), **_longest(channel.qos))
    return replace(profile, durability="transient_local", depth=max(map(depth_of, latched))) if latched else profile


def kept(offers: Sequence[Qos], found: int | None = None) -> int:
    """Return the number of messages for late joiners of these publishers' topic; 0: none.

    With several publishers, whose messages come without their sender, the number is large: one that publishes often
    must not evict what another one latched.

    Args:
        found: what a single publisher keeps that does not state it; None: unknown.
    """
    latched = [each for each in offers if each.durability == "transient_local"]
    if not latched or len(latched) < len(offers):
        return 0
    if found is not None and is_depth_unknown(latched):
        return found
    return shared_depth(len(latched)) if len(latched) > 1 else min(depth_of(latched[0]), DEPTH_MAX)


def shared_depth(messages: int) -> int:
    """Return how many messages are kept of several latched publishers that together keep at least so many."""
    return min(max(messages, DEPTH_MAX), OFFERED_DEPTH_MAX)


def offer(
    sources: Sequence[Qos],
    wants: Sequence[Qos],
    *,
    is_latched: bool | None,
    is_reliable: bool | None = None,
    is_known: bool = True,
) -> Qos:
    """Return the profile to offer: that of the known remote publishers, and more where a local reader requires it.

    A reader that requests a deadline, or a lease of liveliness, is offered it, unless one of them has a longer one, or
    none. The middleware here then tells it that no message came, or that no publisher is left.

    Args:
        sources: of the remote publishers, or as the rule states them.
        is_latched: the rule's value; None: unset.
        is_reliable: likewise; it holds until a remote publisher is known.
        is_known: whether the sources are publishers.
    """
    latched = [each for each in sources if each.durability == "transient_local"]
    insisting = [each for each in wants if each.durability == "transient_local"]
    is_latched = bool(latched) if is_latched is None else is_latched
    depth = max(map(depth_of, sources or insisting), default=_DEPTH)
    if len(latched) > 1:
        depth = shared_depth(sum(map(depth_of, latched)))
    is_reliable = any(each.reliability != "best_effort" for each in sources) if sources else is_reliable is not False
    profile = default(
        reliable=is_reliable or any(each.reliability == "reliable" for each in wants),
        latched=is_latched or bool(insisting),
        depth=min(max(depth, 1), OFFERED_DEPTH_MAX),
    )
    asked = {name: [time for time in _times(wants, name) if time != NEVER] for name in _TIMES}
    longest = _longest(sources if is_known else ())
    return replace(profile, **{name: max(min(times), longest[name]) for name, times in asked.items() if times})


def _longest(offers: Sequence[Qos]) -> dict[str, Any]:
    """Return the longest deadline and lease; ``NEVER``: a publisher states none; zero: there are no publishers."""
    return {name: max(_times(offers, name), default=(0, 0)) for name in _TIMES}


def _times(profiles: Sequence[Qos], name: str) -> list[tuple[int, int]]:
    return [time if _seconds(time := getattr(each, name)) else NEVER for each in profiles]


def _seconds(duration: tuple[int, int]) -> float | None:
    """Return a duration in seconds; None: infinite, or not stated."""
    if duration == (0, 0) or duration[0] >= INFINITE_FROM_S:
        return None
    return duration[0] + duration[1] / 1e9


def unmatched(want: Qos, offered: Qos | None = None) -> str:
    """Return the policy of a local reader that is not met, empty where there is none.

    Args:
        offered: what the known remote publishers fulfil; None: none is known, and times may yet be met.
    """
    for name, what in _TIMES.items() if offered is not None else ():
        if (_seconds(getattr(want, name)) or NEVER_S) < (_seconds(getattr(offered, name)) or NEVER_S):
            return f"it requests {what}, and the far publishers offer none, or a longer one"
    if want.liveliness not in ("automatic", "system_default", "unknown", "best_available"):
        return f"it requests liveliness {want.liveliness}, which does not cross: publishers assert it by themselves"
    return ""
