"""Watch of the servers of services: a lightweight participant at the robot's switch that attaches as a client.

I/O; its own thread drives it. It sends no requests and receives no responses; it receives the feedback of actions like
any client. The robot's proxy sees the same servers, because both learn them from the same switch and RIB.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Final

from gdp.client.participant import Participant
from gdp.config.schema import Domain
from gdp.crypto.certificates import Role
from gdp.errors import GdpError
from gdp.intervals import LOOK_S, TICK_S
from gdp.names import Name
from gdp.nodes.credentials import Credentials
from gdp.nodes.delegation_store import DelegationStore
from gdp.nodes.membership import fresh_settings, load_member
from gdp.ports.raw import RawPlane
from gdp.runtime.runtime import Runtime
from gdp.stores.keyring import DELEGATIONS, ROOT_CERTIFICATE
from gdp.trust.right import Right

log = logging.getLogger(__name__)

_SETTLED_S: Final = 3.0  # after it is attached, until a missing server counts as unreachable


class Watch:
    """Watch on a device of the robot's switch, with the keys in a folder.

    Args:
        identity: directory of a proxy with delegations to call.
    """

    def __init__(self, identity: Path, iface: str) -> None:
        self._identity = identity
        self._iface = iface
        self._lock = threading.Lock()
        self._heard: Mapping[str, frozenset[str]] | None = None
        self._again = threading.Event()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._keep, name="watch", daemon=True)
        self._thread.start()

    def serving_proxies(self) -> Mapping[str, frozenset[str]] | None:
        """Return service (64 hex digits) -> proxies that serve it now; None: the overlay cannot be queried."""
        with self._lock:
            return self._heard

    def reload(self) -> None:
        """Reload the delegations."""
        self._again.set()

    def close(self) -> None:
        """Leave the overlay."""
        self._ended.set()
        self._thread.join()

    def _keep(self) -> None:
        """Run the participant, and restart it after errors: the robot's switch may start later, or restart."""
        reported = ""
        while not self._ended.is_set():
            try:
                self._watch()
            except (GdpError, OSError) as error:
                if str(error) != reported:
                    log.warning("the overlay cannot be asked reason=%s", error)
                    reported = str(error)
            finally:
                self._tell(None)  # earlier results are no longer valid
            self._ended.wait(TICK_S)

    def _watch(self) -> None:
        domain = Domain(root=self._identity / ROOT_CERTIFICATE, transit=None)
        identity, policy = load_member(self._identity, domain, Role.PROXY)
        member = Participant(identity, policy, fresh_settings())
        plane = RawPlane([self._iface])
        try:
            runtime = Runtime(member, plane)
            runtime.every(TICK_S, Credentials(self._identity, domain, identity, policy).reload_changed)
            called = self._call(member, DelegationStore(self._identity / DELEGATIONS, identity), [])
            attached_s: float | None = None
            while not self._ended.is_set() and any(port.up for port in plane.ports.values()):
                if self._again.is_set():
                    self._again.clear()
                    called = self._call(member, DelegationStore(self._identity / DELEGATIONS, identity), called)
                runtime.step(time.monotonic() + LOOK_S)
                member.poll_messages()
                if not member.attachment.is_attached:
                    attached_s = None
                elif attached_s is None:
                    attached_s = time.monotonic()
                peers = {name.to_text(): frozenset(map(Name.to_text, member.services.peers(name))) for name in called}
                is_reported = attached_s is not None and (
                    all(peers.values()) or time.monotonic() - attached_s >= _SETTLED_S
                )
                self._tell(peers if is_reported else None)
            member.leave()
            runtime.send()
        finally:
            plane.close()

    def _call(self, member: Participant, held: DelegationStore, before: Iterable[Name]) -> list[Name]:
        topics = {topic.name: topic for topic in held if Right.CALL in topic.delegation.rights}
        for name in before:
            if name not in topics:
                member.withdraw(name)
        for name, topic in topics.items():
            if name in before:
                member.renew(topic)
            else:
                member.call(topic, b"", is_global=False)
        return list(topics)

    def _tell(self, heard: Mapping[str, frozenset[str]] | None) -> None:
        with self._lock:
            self._heard = heard
