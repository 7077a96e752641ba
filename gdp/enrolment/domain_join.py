"""Joining a domain with a token: keys are made here, the domain's root is pinned, and memberships are fetched.

I/O. Everything is written into a draft folder next to the target, which is renamed as the last step: a failure leaves
nothing behind. Private keys never leave this machine.
"""

from __future__ import annotations

import logging
import secrets
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from gdp.control.endpoints import EndpointRecord
from gdp.crypto.cbor import encode
from gdp.crypto.certificates import Role, Root
from gdp.crypto.identity import Identity, NodeKeys
from gdp.crypto.keys import PublicKey
from gdp.enrolment.channel import Channel, connect_any
from gdp.enrolment.draft import draft_of, publish_draft, reserve_space
from gdp.enrolment.member_setup import MachinePlan, record_file_name, write_configuration
from gdp.errors import LocalError, RemoteError
from gdp.host_port import split_host_port
from gdp.links.endpoint_files import own_record
from gdp.requests import Backoff
from gdp.stores.files import public, read_public, write_all
from gdp.stores.issue import install_delegation, install_membership, make_node_keys
from gdp.stores.keyring import CARD, OWNER_PUBLIC, REQUEST, load_node_keys
from gdp.trust.delegation import Delegation
from gdp.trust.domain import Policy
from gdp.trust.enrolment_wire import (
    DELEGATIONS,
    INSTANCE_BYTES,
    MEMBERS,
    DomainNews,
    EnrolmentError,
    InstallRequest,
    Message,
    UnreachableError,
    apply,
)
from gdp.trust.join_token import HOLDER_FOLDER, JoinToken, join_id, join_key, join_proof

log = logging.getLogger(__name__)

_UNUSED: Final = "the token was not used"
_RETRY_S: Final = 30.0  # after a connection
_REPEATS: Final = Backoff(0.2, 5.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class JoinRequest:
    """What a machine wants to be.

    Args:
        directory: is made, with its parents; an empty one may exist.
        uplinks: devices that each get a tunnel; none: routing decides.
        listen: UDP port of the tunnels; 0: any.
        keys: folder that keeps the keys until the caller removes it, so that a machine that is stopped meanwhile
            sends the same ones again; None: they are made for one call.
        patience_s: how long a server that cannot be reached at all is tried again.
    """

    token: JoinToken
    label: str
    directory: Path
    uplinks: Sequence[str] = ()
    listen: int = 0
    keys: Path | None = None
    patience_s: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Joined:
    """What a machine has become."""

    root: Root
    label: str
    role: str
    directory: Path
    identities: tuple[Identity, ...]  # the switch first
    borders: tuple[EndpointRecord, ...]
    server: str


def prefer_server(token: JoinToken, server: str) -> JoinToken:
    """Return a token that names a server first which answered: a firewall may block the others."""
    return replace(token, servers=(server, *(each for each in token.servers if each != server)))


def join_domain(request: JoinRequest, *, wait: Callable[[float], None] = time.sleep) -> Joined:
    """Join the token's domain and write the machine's directory; repeats a request whose response was lost.

    Raises:
        EnrolmentError: the server refused, is another domain's, or the clocks differ; nothing was left behind.
        UnreachableError: no server answered in time.
        LocalError: the directory exists already, the label is not valid, or the disk is full.
    """
    if request.directory.exists() and (not request.directory.is_dir() or any(request.directory.iterdir())):
        raise LocalError(
            f"{request.directory}: is there already: this machine has joined; name another --directory, or remove it"
        )
    with draft_of(request.directory) as draft:
        reserve_space(draft, _UNUSED).unlink()
        members = [(folder, _node_keys(request, draft, folder, role)) for folder, role in request.token.role.nodes]
        reserved = reserve_space(draft, _UNUSED)  # while the request is under way: what comes back then fits the disk
        fields, root, server = _ask(request, [keys for _, keys in members], wait)
        reserved.unlink()
        request = replace(request, token=prefer_server(request.token, server))
        identities, borders = _install(draft, request, members, fields, root, time.time())
        record = own_record(identities[0], max(len(request.uplinks), 1), ())
        cards = tuple(read_public(draft / folder / CARD) for folder, _ in members)
        _announce(request, identities[-1], InstallRequest(cards, record.wire), wait)
        publish_draft(draft, request.directory)
    return Joined(
        root=root,
        label=request.label,
        role=request.token.role.value,
        directory=request.directory,
        identities=identities,
        borders=borders,
        server=server,
    )


def _ask(request: JoinRequest, nodes: Sequence[NodeKeys], wait: Callable[[float], None]) -> tuple[Message, Root, str]:
    """Return the response of the domain, its root, and the server that answered."""
    token, identifier = request.token, join_id(request.token.secret)
    applications = [apply(identifier, each.key, each.request(), each.kem.public).to_fields() for each in nodes]
    untagged = {"op": "join", "id": identifier, "nodes": applications}

    def send(channel: Channel) -> Message:
        proof = join_proof(join_key(token.secret), channel.binding, channel.nonce, encode(untagged))
        return channel.request({**untagged, "mac": proof})

    return _repeated(request, send, wait)


def _node_keys(request: JoinRequest, draft: Path, folder: str, role: Role) -> NodeKeys:
    """Return a node's keys, which are in the draft then: new ones, or those of an earlier start."""
    if request.keys is None:
        return make_node_keys(draft / folder, role, request.label)
    kept = request.keys / folder
    if not (kept / REQUEST).exists():  # this file is written last
        make_node_keys(kept, role, request.label, force=True)
    try:
        shutil.copytree(kept, draft / folder)
    except OSError as error:
        raise LocalError(f"{draft / folder}: {error.strerror or error}") from error
    return load_node_keys(draft / folder)


def _announce(request: JoinRequest, identity: Identity, asked: InstallRequest, wait: Callable[[float], None]) -> None:
    def send(channel: Channel) -> Message:
        channel.identify(identity, secrets.token_bytes(INSTANCE_BYTES))
        return channel.request({"op": "install", **asked.to_fields()})

    _repeated(request, send, wait)


def _repeated(
    request: JoinRequest, send: Callable[[Channel], Message], wait: Callable[[float], None]
) -> tuple[Message, Root, str]:
    """Send a request until a response comes."""
    token, patience_s = request.token, request.patience_s
    begun_s, tries = time.monotonic(), 0
    while True:
        try:
            with connect_any(token.servers, token.root) as channel:
                patience_s = max(patience_s, _RETRY_S)
                return send(channel), channel.root, channel.server
        except UnreachableError as error:
            if time.monotonic() >= begun_s + patience_s:
                raise
            log.info("enrolment repeated reason=%s", error)
            tries += 1
            wait(_REPEATS.pause_s(tries))


def _install(
    draft: Path,
    request: JoinRequest,
    nodes: Sequence[tuple[str, NodeKeys]],
    fields: Message,
    root: Root,
    unix_s: float,
) -> tuple[tuple[Identity, ...], tuple[EndpointRecord, ...]]:
    """Write everything that the response holds, verified, into the draft."""
    try:
        certificates, news = MEMBERS.read(fields), DomainNews.from_fields(fields)
        owner = PublicKey.from_pem(news.owner)
        trusts = [Root.from_wire(each) for each in news.trusts]
        policy = Policy(root, [])
        for each in news.relays:
            split_host_port(each)
        borders = tuple(EndpointRecord.verified(each, policy, unix_s)[0] for each in news.borders)
        granted = DELEGATIONS.read(fields) if request.token.role.is_of_cluster else ()
        if len(certificates) != len(nodes):
            raise LocalError("another number of memberships")
        identities = tuple(
            install_membership(draft / folder, certificate, root, unix_s=unix_s)
            for (folder, _), certificate in zip(nodes, certificates, strict=True)
        )
        for wire in granted:
            install_delegation(draft / Role.PROXY.value, Delegation.from_wire(wire), unix_s=unix_s)
    except RemoteError as error:
        raise EnrolmentError(None, f"the server's response is not valid: {error}") from error
    files = {f"trusts-{number}.crt": public(each.to_pem()) for number, each in enumerate(trusts, 1)}
    write_all(draft, {OWNER_PUBLIC: public(owner.to_pem()), **files})
    if not borders:
        return identities, borders  # the machine has links of its own, and a configuration for them
    plan = MachinePlan(
        label=request.label,
        role=request.token.role.value,
        servers=request.token.servers,
        listen=request.listen,
        uplinks=request.uplinks,
        relays={each.name: news.relays for each in borders},
        has_proxy=any(folder == Role.PROXY.value for folder, _ in nodes),
        has_store=any(folder == HOLDER_FOLDER for folder, _ in nodes),
    )
    write_configuration(draft, plan, sorted(files))
    write_all(draft / "peers", {record_file_name(each.name): public(each.wire) for each in borders})
    return identities, borders
