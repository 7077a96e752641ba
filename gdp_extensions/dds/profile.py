"""Profiles: QoS of the proxy's own readers and writers, in Cyclone DDS's form.

Imports the binding; no other I/O.
"""

from __future__ import annotations

from typing import Final

from cyclonedds.core import Policy
from cyclonedds.core import Qos as DdsQos

from proxy.serial.channel import NEVER, Qos

_SECOND: Final = 1_000_000_000
_FOREVER: Final = (1 << 63) - 1
# a writer whose readers do not keep up gives up after this time, so that it blocks only briefly
_PATIENCE: Final = _SECOND // 10
_LIVELINESS: Final = {
    "automatic": Policy.Liveliness.Automatic,
    "manual_by_participant": Policy.Liveliness.ManualByParticipant,
    "manual_by_topic": Policy.Liveliness.ManualByTopic,
}


def requested(qos: Qos, user_data: bytes) -> DdsQos:
    """Return the QoS that a local reader requests."""
    return DdsQos(*_common(qos, user_data))


def offered(qos: Qos, user_data: bytes) -> DdsQos:
    """Return the QoS that a local writer offers."""
    kept = Policy.History.KeepLast(max(qos.depth, 1))
    return DdsQos(
        *_common(qos, user_data),
        Policy.Lifespan(_nanoseconds(qos.lifespan)),
        Policy.WriterDataLifecycle(autodispose=False),
        Policy.DurabilityService(0, kept, -1, -1, -1),
    )


def _common(qos: Qos, user_data: bytes) -> list[object]:
    liveliness = _LIVELINESS.get(qos.liveliness, Policy.Liveliness.Automatic)
    is_kept = qos.durability == "transient_local"
    is_reliable = qos.reliability != "best_effort"
    return [
        Policy.Reliability.Reliable(_PATIENCE) if is_reliable else Policy.Reliability.BestEffort,
        Policy.Durability.TransientLocal if is_kept else Policy.Durability.Volatile,
        # Never KeepAll: a stalled reader would block the writer, and with it the whole process.
        Policy.History.KeepLast(max(qos.depth, 1)),
        Policy.Deadline(_nanoseconds(qos.deadline)),
        liveliness(_nanoseconds(qos.lease)),
        Policy.DataRepresentation(use_cdrv0_representation=True),
        Policy.IgnoreLocal.Participant,
        Policy.Userdata(user_data),
    ]


def _nanoseconds(duration: tuple[int, int]) -> int:
    return _FOREVER if duration in (NEVER, (0, 0)) else duration[0] * _SECOND + duration[1]
