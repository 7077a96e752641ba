"""Identities of a writer, of a reader and of another publisher in one incarnation of their process, with their keys."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import count

from gdp.client.control_keys import ControlKeys
from gdp.client.redundancy import CopyBudget, parity_budget
from gdp.crypto.envelope import Signer
from gdp.message.reassembly import VerifiesDigest
from gdp.message.reassembly_quota import ReassemblyQuota
from gdp.names import Name


@dataclass(frozen=True, slots=True)
class WriterIdentity:
    """Identity of one incarnation of a writer.

    Args:
        signer: None: streams of this identity are under session secrets, and not signed.
        random_bytes: the system's randomness, called for each message that is sealed.
        control_keys: keys for the control datagrams of readers.
        copies: budget of the copies that all its publishers send against loss.
        parity: budget of the parity frames that they send.
    """

    name: Name
    incarnation: int
    signer: Signer | None
    random_bytes: Callable[[int], bytes]
    control_keys: ControlKeys
    copies: CopyBudget = field(default_factory=CopyBudget, compare=False)
    parity: CopyBudget = field(default_factory=parity_budget, compare=False)


@dataclass(frozen=True, slots=True)
class ReaderIdentity:
    """Identity of one incarnation of a reader; its writer proxies share it, since they share its datagram numbers.

    Args:
        introduction: returns the wire form of the statement that proves the owner of the keys.
        note_numbers: numbers of the next control datagrams.
        budget: memory of all its writer proxies.
    """

    name: Name
    incarnation: int
    control_keys: ControlKeys = field(compare=False)
    introduction: Callable[[], bytes] = field(compare=False)
    note_numbers: Iterator[int] = field(default_factory=lambda: count(1), compare=False)
    budget: ReassemblyQuota = field(default_factory=ReassemblyQuota, compare=False)


@dataclass(frozen=True, slots=True)
class PublisherIdentity:
    """Identity of one incarnation of another publisher, as its advertisement names it.

    Args:
        key: that must have signed; None: a session secret authenticates its messages, which have no signature.
        exchange: its X25519 key.
    """

    name: Name
    incarnation: int
    key: VerifiesDigest | None
    exchange: bytes
