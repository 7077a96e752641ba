"""What the journal knows of one machine, and how it learns from what is seen of it.

Sans-I/O; time comes in as ``now_s``, seconds since 1970: a journal outlives every monotonic clock.
"""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass, replace
from enum import Enum

from fog.cluster import MachineRequest
from fog.enrolment.credentials import IssuedCredentials
from fog.machine import Machine, MachineSpec, MachineState

__all__ = ["Outcome", "Record", "cost_usd", "learn"]


class Outcome(Enum):
    """How a machine ended."""

    RELEASED = "released"  # we gave it back
    TAKEN = "taken"  # the provider took it, or it died
    FAILED = "failed"  # it was not to be had, or never served


@dataclass(frozen=True, slots=True)
class Record:
    """A machine from the intention to ask for it until it is gone. Times are seconds since 1970.

    Args:
        wanted: what it was launched for.
        id: the provider's; empty until the provider has said it.
        up_unix_s: when its programs were up.
        served_unix_s: when its replica was heard for the first time.
        unheard_unix_s: since when it runs and its replica is not heard; None: it is, or nobody knows.
        noticed_unix_s: when the provider's notice was seen.
        drained_unix_s, released_unix_s: when it was told to finish, and given back.
        ending: how it ended, or will have ended once what was given back is gone.
        gateway: the label of the replica gateway that it is; empty: it is none.
        gateway_unix_s: when it last became the gateway, or ceased to be it.
    """

    spec: MachineSpec
    wanted: MachineRequest
    papers: IssuedCredentials
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
        """Return whether it is no more."""
        return self.gone_unix_s is not None

    @property
    def is_serving(self) -> bool:
        """Return whether its replica takes calls, as far as is known."""
        return not self.is_gone and self.served_unix_s is not None and self.unreachable_unix_s is None

    @property
    def is_outgoing(self) -> bool:
        """Return whether it is on its way out."""
        return self.noticed_unix_s is not None or self.drained_unix_s is not None or self.is_released

    @property
    def is_released(self) -> bool:
        """Return whether it was given back."""
        return self.released_unix_s is not None

    def ended(self, ending: Outcome, reason: str, now_s: float) -> Record:
        """Return it as gone."""
        return replace(
            self, state=MachineState.GONE, gone_unix_s=now_s, ending=ending, reason=reason, unreachable_unix_s=None
        )


def cost_usd(record: Record, now_s: float) -> float:
    """Return what a machine has cost until now: its price from asking for it to its end."""
    end_s = record.gone_unix_s if record.gone_unix_s is not None else now_s
    return max(end_s - record.asked_unix_s, 0.0) / 3_600 * record.spec.offer.usd_per_hour


def learn(record: Record, seen: Machine | None, serves: bool | None, now_s: float, *, grace_s: float) -> Record:
    """Return what is known of a machine after a look.

    Args:
        seen: what the provider said; None: it knows no such machine.
        serves: whether its replica is heard in the overlay; None: nobody can tell.
        grace_s: how long a new machine may be missing from what the provider says.
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
    return record.ended(Outcome.TAKEN, record.reason or said or "gone without a word", now_s)
