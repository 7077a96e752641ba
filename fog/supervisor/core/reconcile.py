"""Reconciliation decisions: the next actions from desired and observed state.

Sans-I/O. The result follows from the records alone, so it can be computed at any time and after any crash.
A serving machine is released only when as many others as are wanted serve, or when its time ends in any case.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import TypeAlias

from fog.cluster import MachineRequest
from fog.supervisor.core.record import Outcome, Record


@dataclass(frozen=True, slots=True, kw_only=True)
class Timeouts:
    """Time limits in seconds.

    Args:
        boot_s: from the request of a machine until its replica serves.
        unreachable_timeout_s: limit for an unreachable replica while another replica is reachable.
        partition_timeout_s: the same where the network is probably the cause: no replica is reachable, or the gateway
            changed.
        drain_s: from the drain request to a machine until its release.
        release_s: until the release of a machine that still exists is repeated.
        credential_renewal_s: another machine replaces it this long before its credentials expire.
        gateway_s: after a gateway change, until unreachable machines behind the gateway count.
        spot_retry_s: after it began to serve, until a spot machine is tried in place of one on demand.
    """

    boot_s: float = 90.0
    unreachable_timeout_s: float = 1.0
    partition_timeout_s: float = 10.0
    drain_s: float = 12.0
    release_s: float = 5.0
    credential_renewal_s: float = 1_800.0
    gateway_s: float = 3.0
    spot_retry_s: float = 600.0


@dataclass(frozen=True, slots=True)
class Launch:
    """Action: request a machine; ``is_spot_only``: one on demand serves in its place already."""

    wanted: MachineRequest
    is_spot_only: bool = False


@dataclass(frozen=True, slots=True)
class Drain:
    """Action: let a machine finish its calls and accept no new ones."""

    name: str
    reason: str


@dataclass(frozen=True, slots=True)
class Release:
    """Action: release a machine."""

    name: str
    reason: str
    ending: Outcome = Outcome.RELEASED


Action: TypeAlias = "Launch | Drain | Release"


def decide(
    wanted: Sequence[MachineRequest],
    records: Sequence[Record],
    now_s: float,
    patience: Timeouts,
    *,
    liveness_known: bool = True,
    excused: Collection[str] = (),
    pushed_unix_s: float | None = None,
) -> list[Action]:
    """Return the actions that bring a cluster closer to its desired state.

    Args:
        wanted: one request per machine; empty: all machines are released at once.
        records: of the cluster; machines that are gone are ignored.
        liveness_known: the overlay reports which machines serve; otherwise a machine that is up counts as serving.
        pushed_unix_s: machines that were requested before are replaced, and serve until then; None: none is.
        excused: names of machines that are unreachable for an external reason, and are kept.
    """
    there = [record for record in records if not record.is_gone]
    if not wanted:
        return [
            Release(each.name, "the cluster is down")
            for each in there
            if not each.is_released or now_s - (each.released_unix_s or now_s) >= patience.release_s
        ]
    is_any_serving = any(_serves(each, liveness_known=liveness_known) for each in there)
    view = _View(now_s, patience, liveness_known, is_any_serving, excused, pushed_unix_s)
    actions: list[Action] = []
    fit: list[Record] = []  # kept if wanted
    leaving: list[Record] = []  # serve until others do, or until their time ends
    for each in there:
        if (ended := view.ended(each)) is not None:
            actions.append(ended)
        elif each.is_released or each.drained_unix_s is not None:
            continue
        elif each.noticed_unix_s is not None or view.is_old(each) or view.is_stopgap(each):
            leaving.append(each)
        else:
            fit.append(each)
    fit.sort(key=lambda each: (not view.serves(each), each.up_unix_s is None, each.asked_unix_s))
    kept, missing = _match(wanted, fit)
    stopgaps = [each for each in leaving if each.noticed_unix_s is None and view.is_stopgap(each)]
    for request in missing:
        place = next((each for each in stopgaps if each.wanted == request), None)
        if place is not None:
            stopgaps.remove(place)
        actions.append(Launch(request, is_spot_only=place is not None))
    spare = [each for each in fit if each not in kept]
    owed = len(wanted) - sum(view.serves(each) for each in kept)  # number of machines that should serve in addition
    for each in [*spare, *sorted(leaving, key=lambda each: -(each.leaves_at_unix_s or now_s))]:
        why = each.reason if each.noticed_unix_s is not None else "another took its place"
        if not view.serves(each):
            actions.append(Release(each.name, why if each in leaving else "not needed"))
        elif owed > 0 and not view.is_due(each):
            owed -= 1
        else:
            actions.append(Drain(each.name, why if each in leaving else "not needed"))
    return actions


def _serves(record: Record, *, liveness_known: bool) -> bool:
    return record.is_serving if liveness_known else record.is_serving or record.up_unix_s is not None


@dataclass(frozen=True, slots=True)
class _View:
    """Predicates on the machines of a cluster at one time."""

    now_s: float
    patience: Timeouts
    liveness_known: bool
    is_any_serving: bool
    excused: Collection[str]
    pushed_unix_s: float | None

    def serves(self, record: Record) -> bool:
        return _serves(record, liveness_known=self.liveness_known)

    def is_old(self, record: Record) -> bool:
        if self.pushed_unix_s is not None and record.asked_unix_s < self.pushed_unix_s:
            return True
        return record.issued_credentials.until_unix_s - self.patience.credential_renewal_s <= self.now_s

    def is_stopgap(self, record: Record) -> bool:
        """Return whether a machine on demand has served long enough in place of a spot machine."""
        if record.spec.offer.is_spot == record.wanted.is_spot or record.served_unix_s is None:
            return False
        return self.now_s - record.served_unix_s >= self.patience.spot_retry_s

    def is_due(self, record: Record) -> bool:
        """Return whether half of the notice period is over; calls in progress need the rest."""
        if record.noticed_unix_s is None or record.leaves_at_unix_s is None:
            return record.issued_credentials.until_unix_s <= self.now_s
        return self.now_s >= (record.noticed_unix_s + record.leaves_at_unix_s) / 2

    def ended(self, record: Record) -> Release | None:
        """Return the release of a machine that must no longer serve; None: it is kept."""
        limit, now_s = self.patience, self.now_s
        if record.released_unix_s is not None:
            is_late = now_s - record.released_unix_s >= limit.release_s
            return Release(record.name, record.reason, record.ending or Outcome.RELEASED) if is_late else None
        if record.drained_unix_s is not None:
            is_done = now_s - record.drained_unix_s >= limit.drain_s
            return Release(record.name, record.reason) if is_done else None
        if not self.liveness_known:
            return None
        if record.served_unix_s is None:
            is_late = now_s - record.asked_unix_s >= limit.boot_s
            return Release(record.name, "did not serve in time", Outcome.FAILED) if is_late else None
        since_s = record.unreachable_unix_s
        patience_s = limit.unreachable_timeout_s if self.is_any_serving else limit.partition_timeout_s
        if since_s is not None and now_s - since_s >= patience_s and record.name not in self.excused:
            return Release(record.name, "its replica is not heard any more", Outcome.PREEMPTED)
        return None


def _match(wanted: Sequence[MachineRequest], fit: Sequence[Record]) -> tuple[list[Record], list[MachineRequest]]:
    """Return the machines that satisfy the requests, best first, and the unsatisfied requests.

    Regions are ignored, because the successor of a preempted machine is in another region.
    """
    open_, kept = list(wanted), list[Record]()
    for is_same in (True, False):
        for record in fit:
            if record in kept:
                continue
            for each in open_:
                if record.wanted == each if is_same else _does(record, each):
                    open_.remove(each)
                    kept.append(record)
                    break
    return kept, open_


def _does(record: Record, wanted: MachineRequest) -> bool:
    offer = record.spec.offer
    is_kind = offer.is_spot == wanted.is_spot or wanted.may_be_on_demand
    return wanted.hardware.fits(offer.hardware) and is_kind
