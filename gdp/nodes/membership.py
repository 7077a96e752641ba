"""Identity and policy of a node, loaded from the files of its configuration, and the randomness of its start.

I/O; reads files.
"""

from __future__ import annotations

import hashlib
import logging
import os
import struct
import time
from contextlib import suppress
from pathlib import Path
from typing import Final

from gdp.config.schema import Directory, Domain
from gdp.control.hello import NodeSettings
from gdp.crypto.certificates import Role
from gdp.crypto.identity import Identity
from gdp.errors import LocalError
from gdp.intervals import ADVERTISEMENT
from gdp.stores.keyring import load_identity, load_root, storage
from gdp.trust.domain import Policy

_CLOCKS: Final = struct.Struct("!qq")
_MACHINE_IDS: Final = (Path("/proc/sys/kernel/random/boot_id"), Path("/sys/class/dmi/id/product_uuid"))

log = logging.getLogger(__name__)


def load_member(directory: Directory, domain: Domain, role: Role) -> tuple[Identity, Policy]:
    """Return a node's identity and its domain's policy.

    Args:
        role: required role of the node; a leaf counts as a switch.

    Raises:
        LocalError: the files are not valid, or belong to another role or domain.
    """
    identity = load_identity(directory, time.time())
    policy = load_policy(domain)
    if identity.role is not role and not (role is Role.SWITCH and identity.role.is_switch):
        raise LocalError(f"{directory}: the identity of a {identity.role.value}, where a {role.value}'s was expected")
    if identity.member.domain != policy.own:
        raise LocalError(f"{directory}: the identity is of another domain than {domain.root}")
    guards = " ".join(f"{path.name}={found.value}" for path, found in storage(directory).items())
    log.info("keys opened name=%s %s", identity.name.short, guards)
    return identity, policy


def load_policy(domain: Domain) -> Policy:
    """Return the policy that states which domains the members of a domain trust.

    Raises:
        LocalError: a root certificate is not valid, or transit or diagnostics names a domain that is not trusted.
    """
    own = load_root(domain.root)
    trusted = [load_root(path) for path in domain.trusts]
    labels = {root.label: root.domain for root in [own, *trusted]}
    for key, named in (("transit", domain.transit or ()), ("diagnostics", domain.diagnostics)):
        unknown = sorted(set(named) - labels.keys())
        if unknown:
            raise LocalError(f"{key}: not a trusted domain: {', '.join(unknown)}")
    transit = None if domain.transit is None else [labels[label] for label in domain.transit]
    return Policy(own, trusted, transit, diagnostics=[labels[label] for label in domain.diagnostics])


def fresh_settings(lease_s: float = ADVERTISEMENT.lease_s) -> NodeSettings:
    """Return the settings of a node that starts now; ``lease_s``: of what it keeps at RIBs."""
    return NodeSettings(
        incarnation=incarnation(), first_sequence=wall_clock_ms(), random_bytes=fresh_bytes, lease_s=lease_s
    )


def fresh_bytes(size: int) -> bytes:
    """Return up to 64 bytes that differ between two machines resumed from one snapshot; about 2 us.

    The kernel's generator answers each call. Linux (5.18 and later) reseeds it when the hypervisor shows a new VM
    generation ID, before a process continues. Without such an ID, a process does not learn of the resume in time.
    Therefore two clocks go in, in nanoseconds: these alone make two copies likely, but not certain, to differ.
    """
    mixed = os.urandom(32) + _CLOCKS.pack(time.monotonic_ns(), time.time_ns())
    return hashlib.blake2b(mixed, digest_size=size).digest()


def incarnation() -> int:
    """Return 64 random bits that identify one run of a node.

    The machine's start, its identifiers and the process go in as well, for a machine whose generator is not seeded.
    """
    parts = [fresh_bytes(32), os.getpid().to_bytes(8, "big")]
    with suppress(OSError):
        parts.append(Path("/proc/self/stat").read_bytes())  # includes the clock tick at which this process began
    for path in _MACHINE_IDS:
        with suppress(OSError):  # missing or unreadable for this user: the other parts suffice
            parts.append(path.read_bytes())
    digest = hashlib.sha256(b"".join(len(part).to_bytes(4, "big") + part for part in parts)).digest()
    return int.from_bytes(digest[:8], "big")


def wall_clock_ms() -> int:
    """Return milliseconds since 1970: above every sequence number of an earlier incarnation."""
    return time.time_ns() // 1_000_000
