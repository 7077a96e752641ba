"""A domain with a running enrolment server on loopback, in a thread."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from gdp.control.endpoints import Endpoint
from gdp.enrolment.create import DomainPlan, create_domain, make_token
from gdp.enrolment.domain_files import DOMAIN_FILE, DomainFiles
from gdp.enrolment.domain_join import Joined, JoinRequest, join_domain
from gdp.enrolment.registry import Registry
from gdp.enrolment.server import bind_server, serve_domain_in_thread
from gdp.trust.join_token import JoinRole, JoinToken


@dataclass(frozen=True)
class Lab:
    """A domain and its server."""

    files: DomainFiles
    folder: Path
    port: int

    def token(self, role: JoinRole = JoinRole.ROBOT, *, valid_s: float = 3_600.0, label: str = "") -> JoinToken:
        """Return a new token."""
        return make_token(self.files, role, valid_s=valid_s, label=label)

    def join(self, label: str, token: JoinToken | None = None) -> Joined:
        """Return a machine that joined."""
        request = JoinRequest(token=token or self.token(), label=label, directory=self.folder / label)
        return join_domain(request)

    def join_again(self, label: str) -> Joined:
        """Return a machine that joins under a label into another directory."""
        return join_domain(JoinRequest(token=self.token(), label=label, directory=self.folder / f"{label}-again"))

    def registry(self) -> Registry:
        """Return the registry, to be closed."""
        return Registry(self.files.config.state)


@contextmanager
def running_lab(
    folder: Path, name: str = "lab", *, relay_port: int = 0, member_days: float | None = None
) -> Iterator[Lab]:
    """Create a domain and serve it while within.

    Args:
        member_days: how long memberships are valid; None: as the domain has it.
    """
    listening = bind_server(0, "127.0.0.1")
    port = listening.getsockname()[1]
    plan = DomainPlan(
        name=name,
        directory=folder / name,
        public=[Endpoint("192.0.2.1", 51_820)],
        servers=[f"127.0.0.1:{port}"],
        listen=port,
        relay_port=relay_port,
    )
    files = create_domain(plan)
    if member_days is not None:
        with (files.directory / DOMAIN_FILE).open("a", encoding="utf-8") as config:
            config.write(f"member_days: {member_days}\n")
        files = DomainFiles.load(files.directory)
    with serve_domain_in_thread(files, listening):
        yield Lab(files, folder, port)
