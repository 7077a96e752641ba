"""Node of a session: a participant of the overlay on one device, with its credentials and its log."""

from __future__ import annotations

import logging
import secrets
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import TYPE_CHECKING, Final

from gdp.client.participant import Participant, Topic
from gdp.client.publisher import Publisher
from gdp.crypto.certificates import Role
from gdp.errors import GdpError, LocalError
from gdp.intervals import UPKEEP_S
from gdp.links.uplink import load_plane, open_uplink
from gdp.names import Name
from gdp.nodes.delegation_store import DelegationStore, EpochTimer
from gdp.nodes.membership import fresh_settings, load_member
from gdp.nodes.node import Node
from gdp.runtime.runtime import Runtime, now
from gdp.session.protocol.core import SessionCore
from gdp.session.protocol.errors import SessionError
from gdp.session.settings import SessionConfig
from gdp.state.node_state import MemberState

if TYPE_CHECKING:
    from gdp.session.kept_topics import KeptTopics

log = logging.getLogger(__name__)

_open_names: Final = set[Name]()  # identities in use by this process: record locks do not see its own
_open_lock: Final = threading.Lock()


class SessionNode(Node):
    """The node that a driver runs; ``close`` releases all its resources.

    Raises:
        LocalError: keys, delegations or the device differ from the settings, or this node already runs.
    """

    def __init__(self, config: SessionConfig) -> None:
        identity, policy = member = load_member(config.identity, config.domain, Role.PROXY)
        self._directory, self._state = config.delegation_directory, config.state
        self._kept: KeptTopics | None = None
        self.member = Participant(identity, policy, fresh_settings(config.lease_s))
        topics = DelegationStore(self._directory, identity)
        self.core = SessionCore(self.member, topics, lambda: secrets.randbits(64), str(self._directory))
        with ExitStack() as stack:
            stack.callback(_own(identity.name))
            super().__init__("node", member, config, stack, is_service=False, state_folder=config.state)
            self.plane = stack.enter_context(open_uplink(config.iface, load_plane("raw", stack)))
            self.runtime = Runtime(self.member, self.plane, spin_s=config.busy_poll_us / 1e6)
            labels = {topic.name: self.core.label(topic) for topic in topics}
            state = MemberState(identity, policy, self.plane, self.member, now().mono_s)
            state.local_name = lambda name: labels.get(name, name.short)
            self.drive(state, self.runtime)
            self.begin(self.runtime)
            self.runtime.every(UPKEEP_S, EpochTimer(self.reload_for_epoch).handle_timer)
            self._opened = stack.pop_all()

    def waiting_for(self) -> str:
        """Return what prevents the node from being attached, as a sentence."""
        texts = self.node_log.waiting_for(time.monotonic())
        return "; ".join(texts) or "the switch has not answered yet"

    def refused(self, name: Name) -> str:
        """Return why the overlay rejected an advertisement of this node; empty if it did not."""
        advertisements = (each for each in self.member.attachment.advertisements if each.subject.name == name)
        return next((each.refused.label for each in advertisements if each.refused is not None), "")

    def reload(self) -> None:
        """Read the certificates and the delegations again.

        Raises:
            LocalError: a file is malformed, or readable for others.
        """
        super().reload()
        self.core.renew(DelegationStore(self._directory, self.identity))

    def keep(self, topic: Topic, publisher: Publisher, holders: Sequence[Topic], most_bytes: int) -> KeptTopics:
        """Keep what a publisher publishes from now on.

        Raises:
            LocalError: the session has no ``state``, or as for ``KeptTopics.keep``.
        """
        from gdp.session.kept_topics import CAPSULES, KeptTopics

        if self._state is None:
            raise LocalError("a publisher with keep needs a folder on the disk: state of the session is missing")
        if self._kept is None:
            self._kept = KeptTopics(self.core, self.identity, self._state / CAPSULES)
        self._kept.keep(topic, publisher, holders, most_bytes)
        return self._kept

    def reload_for_epoch(self) -> None:
        """Read the delegations again, because an epoch begins; an error is logged."""
        try:
            self.reload()
        except GdpError as error:
            log.error("delegations not reloaded, the old ones stay in use reason=%s", error)

    def close(self) -> None:
        """Close the device and release the identity."""
        if self._kept is not None:
            self._kept.close()
        self._opened.close()


def _own(name: Name) -> Callable[[], None]:
    """Record that this process uses an identity; return the function that undoes that.

    Raises:
        SessionError: another session of this process uses it.
    """
    with _open_lock:
        if name in _open_names:
            raise SessionError(f"node {name.short} has a session in this process already; close it, or use that one")
        _open_names.add(name)

    def give_free() -> None:
        """Release the identity."""
        with _open_lock:
            _open_names.discard(name)

    return give_free
