"""Path to a member, switch by switch, and the tree branches below: many diagnostic requests at once.

I/O; over a control socket. The first request is a ping of the member: it makes every switch on the way look up the
path, and its reply says how many switches there are. Then one request ends at each of them.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Final

from gdp.limits import HOPS_MAX
from gdp.management.control_client import NodeConnection
from gdp.names import Name

_REPLY_BYTES: Final = 2_000  # a dozen branches
_BLIND_HOPS: Final = 12  # switches that are asked while the member itself is silent
_BELOW_MAX: Final = 48  # switches below that are asked, apart from those on the path
_PING_SHARE: Final = 0.4  # of the time, for the first request
_ROUND_MIN_S: Final = 0.02
_SWITCHES: Final = ("switch", "leaf")


class PathProbe:
    """Requests about the path of one name; ``connection``: to the node that asks."""

    def __init__(self, connection: NodeConnection, name: Name) -> None:
        self._connection = connection
        self._name = name.to_text()
        status = connection.status()
        self._own = str(status["name"])
        self._is_switch = status["role"] in _SWITCHES

    def path_to(self, target: str, until_s: float) -> Mapping[str, object]:
        """Return the path to a member that advertises the name, as JSON fields.

        Args:
            target: 64 hex digits.
            until_s: monotonic second at which requests end.
        """
        begun_s = time.monotonic()
        ping_s = max(_PING_SHARE * (until_s - begun_s), _ROUND_MIN_S)
        (reply,) = self._ask([("ping", {"target": target, "name": self._name, "timeout_s": ping_s})])
        switches = _number(reply, "switches") if _is_answered(reply) else _BLIND_HOPS
        if _is_answered(reply) and reply.get("role") in _SWITCHES and target != self._own:
            switches += 1  # it belongs to the path itself
        replies = self._traces(target, switches, until_s)
        end = next((at for at, each in enumerate(replies) if each.get("node") == target), None)
        if end is not None:
            if not _is_answered(reply):
                reply = replies[end]  # only the ping or its reply was lost
            del replies[end + (replies[end].get("role") in _SWITCHES) :]
        answered = _is_answered(reply)
        while replies and not answered and replies[-1].get("state") == "silent":
            replies.pop()  # as far as known, no node is there
        hops = [_described(each, number) for number, each in enumerate(replies, start=1)]
        seen = {str(hop["node"]) for hop in hops}
        self._add_below(target, hops, seen, until_s)
        return {
            "node": target,
            "answered": answered,
            "label": reply.get("label"),
            "role": reply.get("role"),
            "domain_label": reply.get("domain_label"),
            "rtt_ms": reply.get("rtt_ms") if answered else None,
            "hops": hops,
        }

    def _traces(self, target: str, switches: int, until_s: float) -> list[Mapping[str, object]]:
        """Return the replies of the nodes on the path, our own switch first."""
        requests: list[tuple[str, Mapping[str, object]]] = []
        if self._is_switch or target == self._own:
            own = self._trace_of(None, target, until_s)  # our own switch
            requests.append(("trace", {**own, "body": {"p": target, "t": target}}))
        for count in range(1, switches + 1):
            requests.append(("trace", {**self._trace_of(target, target, until_s), "hops": min(count, HOPS_MAX - 1)}))
        return self._ask(requests)

    def _add_below(self, publisher: str, hops: list[dict[str, object]], seen: set[str], until_s: float) -> None:
        """Ask the switches below the branches, level by level."""
        level = hops
        asked = 0
        while level:
            wanted = [
                branch
                for hop in level
                for branch in _branches(hop)
                if branch.get("role") in _SWITCHES and str(branch["to"]) not in seen
            ]
            wanted = list({str(branch["to"]): branch for branch in wanted}.values())[: _BELOW_MAX - asked]
            asked += len(wanted)
            seen |= {str(branch["to"]) for branch in wanted}
            requests = [("trace", self._trace_of(str(branch["to"]), publisher, until_s)) for branch in wanted]
            level = []
            for branch, reply in zip(wanted, self._ask(requests), strict=True):
                below = _described(reply, 0)
                branch["below"] = below
                level.append(below)

    def _trace_of(self, target: str | None, publisher: str, until_s: float) -> Mapping[str, object]:
        return {
            "target": target,
            "name": self._name,
            "body": {"p": publisher},
            "reply_bytes": _REPLY_BYTES,
            "timeout_s": max(until_s - time.monotonic(), _ROUND_MIN_S),
        }

    def _ask(self, requests: list[tuple[str, Mapping[str, object]]]) -> list[Mapping[str, object]]:
        return self._connection.ask_all(requests) if requests else []


def _described(reply: Mapping[str, object], number: int) -> dict[str, object]:
    """Return the JSON fields of a switch; one that withholds its links shows its domain and delay only."""
    result = reply.get("result")
    facts = dict(result) if isinstance(result, Mapping) else {}
    is_open = _is_answered(reply) and not reply.get("withheld")
    return {
        "hop": number,
        "state": reply.get("state"),
        "node": reply.get("node") if is_open else None,
        "label": reply.get("label") if is_open else None,
        "role": reply.get("role"),
        "domain_label": reply.get("domain_label"),
        "rtt_ms": reply.get("rtt_ms") if _is_answered(reply) else None,
        "withheld": bool(reply.get("withheld")),
        "cut": bool(reply.get("cut")),
        "in": facts.get("in"),
        "out": facts.get("out"),
        "needs_right": facts.get("w"),
        "branches": facts.get("branches", []),
    }


def _is_answered(reply: Mapping[str, object]) -> bool:
    return reply.get("state") == "answered"


def _branches(hop: Mapping[str, object]) -> list[dict[str, object]]:
    branches = hop.get("branches")
    return [each for each in branches if isinstance(each, dict)] if isinstance(branches, list) else []


def _number(reply: Mapping[str, object], key: str) -> int:
    value = reply.get(key)
    return value if isinstance(value, int) else 0
