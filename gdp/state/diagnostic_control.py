"""Diagnostic requests and tables for the control socket: from JSON fields to the core, and back."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from gdp.control.diagnostics import Reply
from gdp.errors import LocalError
from gdp.intervals import MINUTE_S, PROMPT_S
from gdp.limits import DIAGNOSTIC_REPLY_MAX_BYTES, HOPS_MAX
from gdp.message.clock_offset import ClockEstimate
from gdp.names import ZERO, Name
from gdp.sansio import Timestamps
from gdp.state.control_protocol import Respond, Response
from gdp.state.node_state import NodeState

Row = Mapping[str, object]
TableSource = Callable[[Timestamps], Sequence[Row]]

_PAGE_ROWS: Final = 200  # each below 500 bytes: the socket's buffer holds a page, which is sent in one piece


@dataclass(frozen=True, slots=True, kw_only=True)
class DiagnosticCommands:
    """Handlers of ``ask`` and ``show`` for one node."""

    state: NodeState
    now: Callable[[], Timestamps]
    tables: Mapping[str, TableSource]

    def ask(self, arguments: Mapping[str, object], respond: Respond) -> None:
        """Send a diagnostic request, and respond when its reply has come, or its time is over.

        Raises:
            LocalError: an argument is wrong, or the node has no switch.
        """
        ask = _text(arguments, "ask")
        target = _name(arguments, "target") or self.state.own_switch
        if target is None:
            raise LocalError("this node is attached to no switch now")
        body = arguments.get("body", {})
        if not isinstance(body, dict):
            raise LocalError("body: expected an object")
        request_id = arguments.get("id")

        def answer(reply: Reply | None, rtt_s: float) -> None:
            fields: dict[str, object] = {"id": request_id, "rtt_ms": round(1e3 * rtt_s, 3)}
            respond(Response(fields | (self._described(reply) if reply is not None else {"state": "silent"})))

        self.state.core.diagnostics.ask(
            target,
            ask,
            now=self.now(),
            on_reply=answer,
            name=_name(arguments, "name") or ZERO,
            body={key: _from_json(value) for key, value in body.items()},
            timeout_s=_number(arguments, "timeout_s", PROMPT_S, 0.001, MINUTE_S),
            reply_bytes=int(_number(arguments, "reply_bytes", 0, 0, DIAGNOSTIC_REPLY_MAX_BYTES)),
            hops=int(_number(arguments, "hops", HOPS_MAX, 1, HOPS_MAX)),
        )

    def show(self, arguments: Mapping[str, object]) -> Mapping[str, object]:
        """Return one page of a table. Raises ``LocalError``: this kind of node has no such table."""
        what = _text(arguments, "what")
        source = self.tables.get(what)
        if source is None:
            raise LocalError(
                f"a {self.state.role} keeps no table {what[:40]!r}; it keeps {', '.join(sorted(self.tables))}"
            )
        first = int(_number(arguments, "from", 0, 0, math.inf))
        rows = source(self.now())
        page = [{key: as_json(value) for key, value in row.items()} for row in rows[first : first + _PAGE_ROWS]]
        end = first + len(page)
        return {"rows": page, "next": end if end < len(rows) else None}

    def _described(self, reply: Reply) -> dict[str, object]:
        member = reply.member
        root = self.state.policy.roots.get(member.domain)
        return {
            "state": "answered",
            "node": member.name.to_text(),
            "label": member.label,
            "role": member.role.value,
            "domain": member.domain.to_text(),
            "domain_label": "" if root is None else root.label,
            "result": {key: as_json(value) for key, value in reply.result.items()},
            "switches": reply.switches,
            **clock_fields(reply.clock),
            "error": reply.error,
            "withheld": reply.is_withheld,
            "cut": reply.is_cut,
        }


def clock_fields(clock: ClockEstimate | None) -> dict[str, float | None]:
    """Return by how much another wall clock is ahead of ours, and the bound of the error, as JSON fields."""
    offset_ms, bound_ms = (None, None) if clock is None else (round(1e3 * each, 3) for each in clock)
    return {"clock_offset_ms": offset_ms, "clock_bound_ms": bound_ms}


def as_json(value: object) -> object:
    """Return a value for JSON: bytes as hex digits."""
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, Mapping):
        return {str(key): as_json(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [as_json(each) for each in value]
    return value


def _from_json(value: object) -> object:
    """Return a value of a request's body: 64 hex digits are a name."""
    if isinstance(value, str) and len(value) == 2 * len(ZERO):
        try:
            return bytes.fromhex(value)
        except ValueError:
            return value
    return value


def _text(arguments: Mapping[str, object], key: str) -> str:
    value = arguments.get(key)
    if not isinstance(value, str):
        raise LocalError(f"{key}: expected text")
    return value


def _name(arguments: Mapping[str, object], key: str) -> Name | None:
    value = arguments.get(key)
    if value is None:
        return None
    if not isinstance(value, str):
        raise LocalError(f"{key}: expected 64 hex digits")
    return Name.from_text(value)


def _number(arguments: Mapping[str, object], key: str, default: float, minimum: float, maximum: float) -> float:
    value = arguments.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not minimum <= value <= maximum:
        raise LocalError(f"{key}: expected a number from {minimum:g} to {maximum:g}")
    return value
