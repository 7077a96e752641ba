"""Removal of a machine from a domain: its memberships are revoked, and its tunnels closed.

I/O. The border's switch closes the tunnel when the record leaves its folder of peers, and floods the revocations. In a
domain without a border the caller makes the switch reload that floods them.
"""

from __future__ import annotations

import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from gdp.crypto.certificates import Role
from gdp.crypto.statements import parse
from gdp.enrolment.agent import reload_node
from gdp.enrolment.create import BORDER
from gdp.enrolment.domain_files import DomainFiles
from gdp.enrolment.member_setup import record_file_name
from gdp.enrolment.registry import MachineRow, Registry
from gdp.errors import LocalError, StatementError
from gdp.limits import CLOCK_SKEW_S
from gdp.stores.audit_log import note_once
from gdp.stores.files import public, read_public, write_all
from gdp.stores.keyring import load_domain
from gdp.trust.audit import Action
from gdp.trust.revocation import Revocation

_SUFFIX = ".revoke"
_TITLE_CHARS = 32  # of the fingerprint


@dataclass(frozen=True, slots=True)
class Removed:
    """A removed machine, and how many memberships of it were revoked now."""

    machine: MachineRow
    revoked: int


def remove_machine(files: DomainFiles, label: str, *, unix_s: float | None = None) -> Removed:
    """Remove a machine; a repeat completes an interrupted removal.

    Raises:
        LocalError: no machine has this label, it is the border, or a file cannot be written.
    """
    now, config = time.time() if unix_s is None else unix_s, files.config
    authority = load_domain(config.domain)
    with Registry(config.state) as registry:
        machine = _find(registry, label)
        if machine.role == BORDER:
            raise LocalError(f"{label!r} is the domain's own machine, which cannot be removed")
        valid = registry.remove_machine(machine.id, now)
    folder, revocations = config.revocations, {}
    for fingerprint, until in valid:
        name = fingerprint.hex()[:_TITLE_CHARS] + _SUFFIX
        if not (folder / name).exists():
            revocations[name] = public(Revocation.make(authority.key, authority.root.signer, fingerprint, until))
    for node in machine.nodes:
        if Role(node.role).is_switch:
            (config.peers / record_file_name(node.name)).unlink(missing_ok=True)
    write_all(folder, revocations, force=True)
    _delete_expired(folder, now)
    for node in machine.nodes if revocations or machine.removed_unix_s is None else ():
        note_once(config.domain, Action.REVOKED, "membership", who=node.name.to_text(), unix_s=now)
    if config.switch is not None:
        reload_node(config.switch)
    return Removed(machine, len(revocations))


def _delete_expired(folder: Path, unix_s: float) -> None:
    for path in folder.glob(f"[!.]*{_SUFFIX}"):
        with suppress(StatementError):  # not written by this module: left unchanged
            old = Revocation.from_statement(parse(read_public(path)))
            if old.until_unix_s + 2 * CLOCK_SKEW_S < unix_s:
                path.unlink(missing_ok=True)


def _find(registry: Registry, label: str) -> MachineRow:
    found = registry.machine_with(label, with_removed=True)
    if found is None:
        known = ", ".join(each.label for each in registry.machines())
        raise LocalError(f"no machine {label!r} is in the domain; there are {known}")
    return found
