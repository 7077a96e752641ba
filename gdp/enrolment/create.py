"""Creation of a domain with its border: root, owner, switch, RIB, proxy, their files, and the registry; and its tokens.

I/O. Everything is written into a draft folder, which is renamed as the last step.
"""

from __future__ import annotations

import json
import secrets
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from gdp.control.endpoints import Endpoint
from gdp.crypto.certificates import Role
from gdp.crypto.identity import Identity
from gdp.enrolment.domain_files import DOMAIN_FILE, HANDOVER_SOCKET, MEMBER_DAYS, DomainFiles
from gdp.enrolment.draft import draft_of, publish_draft, reserve_space
from gdp.enrolment.member_setup import MachinePlan, write_configuration
from gdp.enrolment.registry import Plan, Registry
from gdp.errors import LocalError
from gdp.stores.files import public, read_public, write_all
from gdp.stores.issue import make_domain, make_node, make_owner
from gdp.stores.keyring import CARD, OWNER_PUBLIC, ROOT_CERTIFICATE, load_root
from gdp.trust.enrolment_wire import DELEGATIONS_MAX
from gdp.trust.join_token import JOIN_SECRET_BYTES, SERVERS_MAX, JoinRole, JoinToken, fingerprint_of, join_id, join_key

BORDER: Final = "border"  # role and default label of the domain's own machine
_STATE: Final = "enrolment"
_NODES: Final = (("switch", Role.SWITCH), ("rib", Role.RIB), ("proxy", Role.PROXY))


@dataclass(frozen=True, slots=True, kw_only=True)
class DomainPlan:
    """What a domain is created with.

    Args:
        name: label of the domain.
        directory: is made.
        public: UDP endpoints at which the border's tunnels can be reached from everywhere.
        servers: TCP addresses of the enrolment server, ``host:port``, that tokens name.
        listen: port of the tunnels (UDP) and of the enrolment server (TCP).
        relay_port: TCP port of the border's relay; 0: none.
    """

    name: str
    directory: Path
    public: Sequence[Endpoint]
    servers: Sequence[str]
    listen: int
    label: str = BORDER
    relay_port: int = 0


def create_domain(plan: DomainPlan, *, unix_s: float | None = None) -> DomainFiles:
    """Make the directory of a domain and its border.

    Raises:
        LocalError: the directory exists, a label is not valid, or the disk is full; nothing was left behind.
    """
    directory, now = plan.directory, time.time() if unix_s is None else unix_s
    if directory.exists():
        raise LocalError(f"{directory}: is there already; gdp domain token makes a token of an existing domain")
    with draft_of(directory) as draft:
        reserve_space(draft, "no domain was created").unlink()
        _fill(draft, plan, now)
        publish_draft(draft, directory)
    return DomainFiles.load(directory)


def make_token(
    files: DomainFiles,
    role: JoinRole,
    *,
    valid_s: float,
    label: str = "",
    unix_s: float | None = None,
    plan: Plan | None = None,
) -> JoinToken:
    """Make a token that lets one machine join once, and store its id and MAC key.

    Args:
        label: the machine must have this one; empty: any.
        plan: of a machine of a cluster.

    Raises:
        LocalError: the label is taken, the plan has too many names, or the registry cannot be written.
    """
    if plan is not None and len(plan.grants) > DELEGATIONS_MAX:
        raise LocalError(f"{label}: a machine serves at most {DELEGATIONS_MAX} names, not {len(plan.grants)}")
    now = time.time() if unix_s is None else unix_s
    secret = secrets.token_bytes(JOIN_SECRET_BYTES)
    root = load_root(files.config.domain / ROOT_CERTIFICATE)
    with Registry(files.config.state) as registry:
        if label and registry.machine_with(label) is not None:
            raise LocalError(f"the label {label!r} is taken by another machine of this domain")
        expires = int(now + valid_s)
        registry.add_token(
            join_id(secret),
            join_key(secret),
            role=role.value,
            label=label,
            unix_s=now,
            expires_unix_s=expires,
            plan=plan,
        )
    return JoinToken(
        root=fingerprint_of(root), secret=secret, role=role, expires_unix_s=expires, servers=files.config.servers
    )


def _fill(draft: Path, plan: DomainPlan, unix_s: float) -> None:
    make_domain(draft / "domain", plan.name, unix_s=unix_s)
    make_owner(draft / "owner", is_salted=True)
    identities = list[Identity]()
    for folder, role in _NODES:
        identities.append(
            make_node(draft / folder, role, plan.label, draft / "domain", days=MEMBER_DAYS, unix_s=unix_s)
        )
    public_texts = [each.to_text() for each in plan.public]
    loopback = f"127.0.0.1:{plan.listen}"
    machine = MachinePlan(
        label=plan.label,
        role=BORDER,
        servers=[loopback],
        listen=plan.listen,
        public=public_texts,
        relay_port=plan.relay_port,
        handover=f"{_STATE}/{HANDOVER_SOCKET}",
        has_rib=True,
    )
    write_configuration(draft, machine, ())
    lines = [
        "domain: domain",
        "owner: owner",
        "switch: switch",
        f"state: {_STATE}",
        "peers: peers",
        "revocations: revocations",
        f"listen: {plan.listen}",
        f"servers: {json.dumps(list(dict.fromkeys([*plan.servers, *_relays(plan)]))[:SERVERS_MAX])}",
        f"public: {json.dumps(public_texts)}",
        f"relays: {json.dumps(_relays(plan))}",
    ]
    owner = read_public(draft / "owner" / OWNER_PUBLIC)
    write_all(draft, {DOMAIN_FILE: public("\n".join([*lines, ""]).encode()), OWNER_PUBLIC: public(owner)})
    with Registry(draft / _STATE) as registry:
        registry.add_machine(plan.label, BORDER, [each.member for each in identities], unix_s)
        for folder, identity in zip((folder for folder, _ in _NODES), identities, strict=True):
            registry.set_card(identity.name, read_public(draft / folder / CARD))


def _relays(plan: DomainPlan) -> list[str]:
    """Return ``host:port`` of the relay, at the hosts of the enrolment server."""
    if not plan.relay_port:
        return []
    return list(dict.fromkeys(f"{each.rpartition(':')[0]}:{plan.relay_port}" for each in plan.servers))
