"""Bodies of diagnostic requests and replies (``diagnostics.py``).

Sans-I/O. A request is padded to the longest reply that it accepts, so that no reply is longer than its request.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Final

from gdp.crypto.cbor import encode
from gdp.crypto.keys import SigningKey
from gdp.crypto.schema import CERT, FLAG, MAP, NAME, NAME_OR_ZERO, OCTETS, Body, FieldSet, Keyed, text, uint
from gdp.crypto.statements import StatementType, assemble
from gdp.crypto.subject import SUBJECT, Subject
from gdp.errors import DropReason, LocalError, StatementError
from gdp.frame.codec import HOPS_MASK
from gdp.limits import DIAGNOSTIC_REPLY_MAX_BYTES
from gdp.names import ZERO, Name
from gdp.trust.adcert import CHAIN
from gdp.trust.right import RIGHT, Right

ASK_MAX_CHARS: Final = 16
_ERROR_MAX_CHARS: Final = 32
_SHORT_REPLY_BYTES: Final = 360  # an empty result, and a few counters
_CERTIFICATE_BYTES: Final = 680  # of the member that replies, if we lack it: label and domain of some 60 letters
_PAD_HEAD_BYTES: Final = 2  # of the head of the padding, above that of an empty one
_NO_SIGNATURE: Final = bytes(64)


@dataclass(frozen=True, slots=True, kw_only=True)
class DiagnosticRequest(Body):
    """Request of one member to another.

    Args:
        name: asked about; ``ZERO``: none.
        body: more about the question; its keys depend on ``ask``.
        knows_target: the asker has the certificate of the target, so the reply may omit it.
        membership: DER; empty: the target has it.
    """

    TYPE = StatementType.DIAGNOSTIC_REQUEST
    ask: Annotated[str, Keyed("a", text(ASK_MAX_CHARS))]
    name: Annotated[Name, Keyed("n", NAME_OR_ZERO)]
    target: Annotated[Name, Keyed("to", NAME)]
    sequence: Annotated[int, Keyed("s", uint())]
    body: Annotated[Mapping[str, object], Keyed("b", MAP)] = field(default_factory=dict)
    knows_target: Annotated[bool, Keyed("k", FLAG)] = False
    membership: Annotated[bytes, Keyed("c", CERT, absent=b"", is_omitted=True)] = b""
    padding: Annotated[bytes, Keyed("z", OCTETS, absent=b"")] = field(default=b"", compare=False, repr=False)

    def check(self) -> None:
        """Return if what is asked is a word. Raises ``StatementError``: MALFORMED."""
        if not self.ask.isprintable() or not self.ask:
            raise StatementError(DropReason.MALFORMED, "what is asked is not printable")

    def padded(self, signer: Name, key: SigningKey, reply_bytes: int = 0) -> bytes:
        """Return the signed statement, as long as the longest reply that it accepts.

        Raises:
            LocalError: ``reply_bytes`` is above the limit, or the body is too large.
        """
        if not 0 < len(self.ask) <= ASK_MAX_CHARS or reply_bytes > DIAGNOSTIC_REPLY_MAX_BYTES:
            raise LocalError(
                f"an ask has 1 to {ASK_MAX_CHARS} letters, its reply at most {DIAGNOSTIC_REPLY_MAX_BYTES} bytes"
            )
        least = _SHORT_REPLY_BYTES + (0 if self.knows_target else _CERTIFICATE_BYTES)
        size = len(assemble(self.TYPE, self.to_fields(), signer, _NO_SIGNATURE))
        padding = bytes(max(max(reply_bytes, least) - size - _PAD_HEAD_BYTES, 0))
        return replace(self, padding=padding).to_wire(signer, key)


@dataclass(frozen=True, slots=True)
class RightEvidence(FieldSet):
    """What shows the asker's right on the name of a request: keys of its body.

    Args:
        chain: AdCerts from the owner to the asker.
    """

    subject: Annotated[Subject, SUBJECT]
    right: Annotated[Right, Keyed("right", RIGHT)]
    chain: Annotated[tuple[bytes, ...], Keyed("chain", CHAIN)]


@dataclass(frozen=True, slots=True, kw_only=True)
class DiagnosticReply(Body):
    """Reply to one request.

    Args:
        asker: whose request had this sequence number.
        error: why there is no result; empty: there is.
        is_withheld: the asker's domain gets less than ours.
        is_cut: lists in the result lack their last items.
        hops_left: that the request had when it came.
        membership: DER; empty: the asker has it.
        clock: ``ClockStamps`` of the replying member; empty: of an earlier version.
    """

    TYPE = StatementType.DIAGNOSTIC_REPLY
    ask: Annotated[str, Keyed("a", text(ASK_MAX_CHARS))]
    sequence: Annotated[int, Keyed("s", uint())]
    asker: Annotated[Name, Keyed("r", NAME)]
    result: Annotated[Mapping[str, object], Keyed("b", MAP)] = field(default_factory=dict)
    error: Annotated[str, Keyed("e", text(_ERROR_MAX_CHARS))] = ""
    is_withheld: Annotated[bool, Keyed("w", FLAG)] = False
    is_cut: Annotated[bool, Keyed("m", FLAG)] = False
    hops_left: Annotated[int, Keyed("h", uint(HOPS_MASK))] = 0
    membership: Annotated[bytes, Keyed("c", CERT, absent=b"", is_omitted=True)] = b""
    clock: Annotated[bytes, Keyed("ts", OCTETS, absent=b"", is_omitted=True)] = b""


def cut_to_fit(reply: DiagnosticReply, max_bytes: int) -> DiagnosticReply | None:
    """Return the reply with as many list items as fit, or without its result; None: not even that fits.

    Args:
        max_bytes: of the signed statement.
    """
    while _size(reply) > max_bytes:
        lists = {key: value for key, value in reply.result.items() if isinstance(value, list | tuple) and value}
        if lists:
            key = max(lists, key=lambda each: len(encode(lists[each])))
            excess, each_bytes = _size(reply) - max_bytes, len(encode(lists[key])) / len(lists[key])
            kept = len(lists[key]) - max(int(excess / each_bytes), 1)
            result = {**reply.result, key: lists[key][: max(kept, 0)]}
        elif reply.result:
            result = {}
        else:
            return None
        reply = replace(reply, result=result, is_cut=True)
    return reply


def _size(reply: DiagnosticReply) -> int:
    return len(assemble(StatementType.DIAGNOSTIC_REPLY, reply.to_fields(), ZERO, _NO_SIGNATURE))
