"""Files of a member machine: what ``gdp join`` and ``gdp domain create`` write, and who runs from them.

I/O. The directory of one machine::

    member.yaml         who this machine is, and where the enrolment server is
    switch/  proxy/     keys and memberships of its nodes; a border has rib/, too; a holder has store/, no proxy/
    switch.yaml  proxy.yaml  rib.yaml  store.yaml
    owner.pub           key of the domain's owner of names
    trusts/*.crt        roots of other domains
    peers/*.endpoints   endpoint records: the switch opens a tunnel to each
    revocations/        for the switch
    inbox/              mail that arrived
    agent.json          what the agent did last
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final

from pydantic import AfterValidator, Field

from gdp.config.schema import Directory, Domain, Section, Unique, load
from gdp.stores.keyring import load_root
from gdp.trust.enrolment_wire import EnrolmentError
from gdp.trust.join_token import SERVERS_MAX, checked_server, fingerprint_of

MEMBER_FILE: Final = "member.yaml"


class MemberConfig(Section):
    """``member.yaml``: identities of one machine, and the enrolment servers of its domain."""

    label: str = Field(description="Label of the machine in its domain.")
    role: str = Field(description="Role of its switch.")
    domain: Domain = Field(description="The trust domain, and the others whose members are believed.")
    switch: Directory = Field(description="Directory of its switch.")
    proxy: Directory | None = Field(default=None, description="Directory of its proxy. `null`: none.")
    store: Directory | None = Field(default=None, description="Directory of its holder of capsules. `null`: none.")
    rib: Directory | None = Field(default=None, description="Directory of its RIB. `null`: none.")
    peers: Directory = Field(description="Directory of endpoint records.")
    servers: Annotated[tuple[Annotated[str, AfterValidator(checked_server)], ...], Unique] = Field(
        min_length=1,
        max_length=SERVERS_MAX,
        description="`HOST:PORT` or `unix:PATH` of the domain's enrolment servers.",
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class MemberFiles:
    """The loaded ``member.yaml`` of a directory; ``fingerprint``: of the domain's founding root."""

    directory: Path
    config: MemberConfig
    fingerprint: bytes

    @classmethod
    def load(cls, directory: Path) -> MemberFiles:
        """Read the files of a machine. Raises ``LocalError`` or ``ConfigError``: the directory is no member's."""
        path = directory / MEMBER_FILE
        if not path.exists():
            raise EnrolmentError(None, f"{directory}: no {MEMBER_FILE} is here; run gdp join or gdp domain create")
        config = load(MemberConfig, path)
        return cls(directory=directory, config=config, fingerprint=fingerprint_of(load_root(config.domain.root)))

    @property
    def servers(self) -> tuple[str, ...]:
        """Return the enrolment servers, ``host:port``."""
        return self.config.servers

    @property
    def domain(self) -> Domain:
        """Return the trust domain, and the others whose members are believed."""
        return self.config.domain

    @property
    def is_border(self) -> bool:
        """Return whether this is the domain's own machine, whose folder of peers the enrolment server fills."""
        return (self.directory / "domain.yaml").exists()

    @property
    def mail_identity(self) -> Path:
        """Return the directory of the node that mail is for: the proxy or the holder, or the switch without them."""
        return self.config.proxy or self.config.store or self.config.switch

    @property
    def nodes(self) -> tuple[Path, ...]:
        """Return the directories of this machine's nodes, the switch first."""
        config = self.config
        return tuple(each for each in (config.switch, config.proxy, config.store, config.rib) if each is not None)

    @property
    def inbox(self) -> Path:
        """Return the directory of mail that arrived."""
        return self.directory / "inbox"

    @property
    def status_file(self) -> Path:
        """Return the file in which the agent writes when it last succeeded."""
        return self.directory / "agent.json"
