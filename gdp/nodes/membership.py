"""From a configuration's files to who a node is and whom it believes.

Place: shell; reads files.
"""

from __future__ import annotations

import logging
import secrets
import time

from gdp.crypto.certificates import Role
from gdp.crypto.identity import Identity
from gdp.errors import LocalError
from gdp.nodes.schema import Directory, Domain
from gdp.stores.keyring import load_identity, load_root, storage
from gdp.trust.domain import Policy

__all__ = ["incarnation", "load_member", "load_policy", "wall_clock_ms"]

log = logging.getLogger(__name__)


def load_member(directory: Directory, domain: Domain, role: Role) -> tuple[Identity, Policy]:
    """Return a node's identity and its domain's policy.

    Raises:
        LocalError: the files do not hold, or are of another role or domain.
    """
    identity = load_identity(directory, time.time())
    policy = load_policy(domain)
    if identity.role is not role:
        raise LocalError(f"{directory}: the identity of a {identity.role.value}, where a {role.value}'s was expected")
    if identity.member.domain != policy.own:
        raise LocalError(f"{directory}: the identity is of another domain than {domain.root}")
    guards = " ".join(f"{path.name}={found.value}" for path, found in storage(directory).items())
    log.info("keys opened name=%s %s", identity.name.short, guards)
    return identity, policy


def load_policy(domain: Domain) -> Policy:
    """Return whom the members of a domain believe.

    Raises:
        LocalError: a root certificate does not hold, or transit names a domain that is not trusted.
    """
    own = load_root(domain.root)
    trusted = [load_root(path) for path in domain.trusts]
    if domain.transit is None:
        return Policy(own, trusted)
    labels = {root.label: root.domain for root in [own, *trusted]}
    unknown = sorted(set(domain.transit) - labels.keys())
    if unknown:
        raise LocalError(f"transit: not a trusted domain: {', '.join(unknown)}")
    return Policy(own, trusted, [labels[label] for label in domain.transit])


def incarnation() -> int:
    """Return 64 random bits: a new life of a node."""
    return secrets.randbits(64)


def wall_clock_ms() -> int:
    """Return milliseconds since 1970: above every sequence number of an earlier life."""
    return time.time_ns() // 1_000_000
