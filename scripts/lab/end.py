"""Member of the overlay on its plane, without the library: of the endpoint processes of benches and tests. I/O."""

from __future__ import annotations

import secrets
from pathlib import Path

from gdp.client.participant import Participant, Topic
from gdp.client.publisher import Publisher
from gdp.config.config import RibConfig
from gdp.config.schema import Domain
from gdp.control.hello import NodeSettings
from gdp.crypto.certificates import Role
from gdp.errors import LocalError
from gdp.names import Name
from gdp.nodes.membership import incarnation, load_member, wall_clock_ms
from gdp.ports.raw import RawPlane
from gdp.runtime.runtime import Runtime
from gdp.stores.keyring import DELEGATIONS, load_delegations


class End:
    """Member on its plane; ``folder``: of its keys. ``topics``: topics and services that its delegations name."""

    def __init__(self, folder: Path, domain: Domain, iface: str, spin_s: float = 0.0) -> None:
        identity, policy = load_member(folder, domain, Role.PROXY)
        node = NodeSettings(incarnation=incarnation(), first_sequence=wall_clock_ms(), random_bytes=secrets.token_bytes)
        self.member = Participant(identity, policy, node)
        self.plane = RawPlane([iface])
        self.runtime = Runtime(self.member, self.plane, spin_s=spin_s)
        self.topics: dict[str, Topic] = {}
        for each in load_delegations(folder / DELEGATIONS):
            if each.metadata is None:
                raise LocalError("a delegation without metadata")
            grants = {epoch: grant.secret for epoch, grant in each.open(identity).items()}
            self.topics[str(each.metadata["name"])] = Topic(each, grants)

    @classmethod
    def from_config(cls, path: Path, spin_s: float) -> End:
        """Return the member of a configuration file; identity, domain and iface are all that it needs."""
        settings = RibConfig.load(path)
        return cls(settings.identity, settings.domain, settings.iface, spin_s)

    def advertise(self, topic: str, *, reliable: bool) -> Publisher:
        """Publish a topic."""
        return self.member.advertise(self.topics[topic], b"bench", reliable=reliable)

    def subscribe(self, topic: str) -> Name:
        """Read a topic; return its name."""
        self.member.subscribe(self.topics[topic])
        return self.topics[topic].name

    def serve(self, name: str, *, is_session: bool = False) -> Name:
        """Serve a name; return its overlay name."""
        self.member.serve(self.topics[name], b"bench", is_session=is_session)
        return self.topics[name].name

    def call(self, name: str, *, is_session: bool = False) -> Publisher:
        """Call a name from now on; return the stream that all its servers receive."""
        return self.member.call(self.topics[name], b"bench", is_session=is_session)

    def name_of(self, name: str) -> Name:
        """Return the overlay name of a topic or service."""
        return self.topics[name].name

    def leave(self) -> None:
        """Withdraw and close."""
        self.member.leave()
        while self.runtime.send():
            continue
