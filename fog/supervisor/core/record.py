"""Journal record of one machine, and its update from observations.

Sans-I/O; time is the argument ``now_s``, seconds since 1970, because a journal outlives every monotonic clock.
"""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass, replace
from enum import Enum

from fog.cluster import MachineRequest
from fog.machine import Machine, MachineSpec, MachineState


class Outcome(Enum):
    """Outcome of a machine."""

    RELEASED = "released"  # the supervisor released it
    PREEMPTED = "preempted"  # the provider preempted it, or it failed
    FAILED = "failed"  # no capacity, or it never served


@dataclass(frozen=True, slots=True)
class IssuedCredentials:
    """Credentials issued to a machine; before enrolment only the end of their validity is known.

    Args:
        proxy: overlay name of the machine's proxy, 64 hex digits; empty: not enrolled yet.
        until_unix_s: end of validity of its certificates and delegations.
    """

    proxy: str
    until_unix_s: float


@dataclass(frozen=True, slots=True)
class Record:
    """Machine from the intention to request it until it is gone. Times are seconds since 1970.

    Args:
        id: the provider's id; empty until it is known.
        up_unix_s: when its programs were up.
        served_unix_s: when its replica was observed for the first time.
        unreachable_unix_s: since when it runs and its replica is unreachable; None: reachable or unknown.
        noticed_unix_s: when the provider's notice was observed.
        drained_unix_s, released_unix_s: when it was drained and released.
        ending: its outcome; of a released machine, the outcome when it is gone.
        gateway: label of the replica gateway that it is; empty: none.
        gateway_unix_s: when it last became the gateway, or stopped being the gateway.
    """

    spec: MachineSpec
    wanted: MachineRequest
    issued_credentials: IssuedCredentials
    asked_unix_s: float
    _: KW_ONLY
    id: str = ""
    state: MachineState = MachineState.BOOTING
    address: str = ""
    up_unix_s: float | None = None
    served_unix_s: float | None = None
    unreachable_unix_s: float | None = None
    noticed_unix_s: float | None = None
    leaves_at_unix_s: float | None = None
    drained_unix_s: float | None = None
    released_unix_s: float | None = None
    gone_unix_s: float | None = None
    ending: Outcome | None = None
    reason: str = ""
    gateway: str = ""
    gateway_unix_s: float | None = None

    @property
    def name(self) -> str:
        """Return its name within the cluster."""
        return self.spec.name

    @property
    def is_gone(self) -> bool:
        """Return whether it is gone."""
        return self.gone_unix_s is not None

    @property
    def is_serving(self) -> bool:
        """Return whether its replica accepts calls, as far as known."""
        return not self.is_gone and self.served_unix_s is not None and self.unreachable_unix_s is None

    @property
    def is_outgoing(self) -> bool:
        """Return whether it has a notice, or was drained or released."""
        return self.noticed_unix_s is not None or self.drained_unix_s is not None or self.is_released

    @property
    def is_released(self) -> bool:
        """Return whether it was released."""
        return self.released_unix_s is not None

    def ended(self, ending: Outcome, reason: str, now_s: float) -> Record:
        """Return the record as gone."""
        return replace(
            self, state=MachineState.GONE, gone_unix_s=now_s, ending=ending, reason=reason, unreachable_unix_s=None
        )


def stage(record: Record, *, is_watched: bool = True) -> str:
    """Return the state of a machine as one word.

    Args:
        is_watched: whether a watch reports which machines serve; otherwise the best state is *running*.
    """
    if record.is_gone:
        return "gone" if record.ending is None else record.ending.value
    if record.is_released:
        return "leaving"
    if record.drained_unix_s is not None:
        return "draining"
    if record.noticed_unix_s is not None:
        return "notice"
    if record.is_serving:
        return "serving" if is_watched else "running"
    if record.served_unix_s is not None:
        return "unreachable"
    return "requested" if not record.id else "booting" if record.up_unix_s is None else "up"


def cost_usd(record: Record, now_s: float) -> float:
    """Return the cost of a machine until now, from its request to its end, in US dollars."""
    end_s = record.gone_unix_s if record.gone_unix_s is not None else now_s
    return max(end_s - record.asked_unix_s, 0.0) / 3_600 * record.spec.offer.usd_per_hour


def update_record(record: Record, seen: Machine | None, serves: bool | None, now_s: float, *, grace_s: float) -> Record:
    """Return a machine's record after an observation.

    Args:
        seen: the provider's description; None: the provider does not list the machine.
        serves: whether the overlay reports its replica; None: unknown.
        grace_s: how long the provider may omit a new machine.
    """
    if record.is_gone:
        return record
    if seen is None or seen.state is MachineState.GONE:
        return _missed(record, seen, now_s, grace_s)
    known = replace(record, id=seen.id, state=seen.state, address=seen.address)
    if seen.state is MachineState.LEAVING and seen.leaves_at_unix_s is not None and not record.is_released:
        known = replace(
            known,
            noticed_unix_s=now_s if record.noticed_unix_s is None else record.noticed_unix_s,
            leaves_at_unix_s=seen.leaves_at_unix_s,
            reason=seen.reason or "notice of its provider",
        )
    if seen.state is not MachineState.BOOTING and known.up_unix_s is None:
        known = replace(known, up_unix_s=now_s)
    return known if serves is None else _heard(known, serves=serves, now_s=now_s)


def _heard(record: Record, *, serves: bool, now_s: float) -> Record:
    if serves:
        first_s = now_s if record.served_unix_s is None else record.served_unix_s
        return replace(record, served_unix_s=first_s, unreachable_unix_s=None)
    if record.up_unix_s is None or record.unreachable_unix_s is not None:
        return record
    return replace(record, unreachable_unix_s=now_s)


def _missed(record: Record, seen: Machine | None, now_s: float, grace_s: float) -> Record:
    if seen is None and record.up_unix_s is None and now_s - record.asked_unix_s < grace_s:
        return record
    if record.is_released or record.drained_unix_s is not None:
        return record.ended(record.ending or Outcome.RELEASED, record.reason, now_s)
    said = seen.reason if seen is not None else ""
    if record.up_unix_s is None:
        return record.ended(Outcome.FAILED, said or "never came up", now_s)
    return record.ended(Outcome.PREEMPTED, record.reason or said or "gone without a word", now_s)
