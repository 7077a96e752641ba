"""Parameter requests of one client: the service calls that each one needs, and their common answer.

Sans-I/O. Source: see ``parameters.py``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Final, TypeAlias

import orjson

from gdp.errors import GdpError
from gdp_extensions.doors.core.hub import DoorSession, Hub
from gdp_extensions.doors.core.parameters import GET, LIST, SET, from_value, node_and_name, to_value
from proxy.serial.channel import Service
from proxy.serial.rosbridge_json import RosbridgeCodec

Done: TypeAlias = "Callable[[Mapping[str, object]], None]"
_LIST_MAX: Final = 4_096
_CALLS_MAX: Final = 1_024
_CALLS_MAX_BYTES: Final = 8 << 20  # of the requests under way, whose names are kept


@dataclass(frozen=True, slots=True)
class ParameterCall:
    """Context of a service call under way."""

    service: Service
    size_bytes: int  # of the request
    done: Done
    failed: Callable[[str], None]


@dataclass(slots=True)
class _Gathering:
    """Answers of several nodes to one request of the client."""

    open: int
    found: list[dict[str, object]] = field(default_factory=list)


class ParameterCalls:
    """Requests of a session.

    Args:
        tell_values: sends parameters, with the number of the client's request.
        tell_wrong: reports an error to the client.
    """

    def __init__(
        self,
        hub: Hub,
        session: DoorSession,
        tell_values: Callable[[Sequence[dict[str, object]], str | None], None],
        tell_wrong: Callable[[str], None],
    ) -> None:
        self._hub = hub
        self._session = session
        self._tell_values = tell_values
        self._tell_wrong = tell_wrong
        self._open = 0  # calls under way
        self._open_bytes = 0

    def get(self, parameters: Sequence[str], number: str | None) -> None:
        """Read parameters; without names, all of every node. Raises ``RemoteError``: a name has another form."""
        if parameters:
            self._read(_by_node(parameters), number)
            return
        nodes = [
            each.name.removesuffix(f"/{GET[0]}") for each in self._hub.services.values() if each.type_name == GET[1]
        ]
        names: dict[str, list[str]] = {}
        gathering = _Gathering(len(nodes))

        def listed(node: str, result: Mapping[str, object]) -> None:
            inner = result.get("result")
            if isinstance(inner, dict) and isinstance(inner["names"], list) and inner["names"]:
                names[node] = inner["names"][:_LIST_MAX]
            ended()

        def ended() -> None:
            gathering.open -= 1
            if gathering.open <= 0:
                self._read(names, number)

        if not nodes:
            self._tell_values([], number)
        for node in nodes:
            self._ask(node, LIST, {}, partial(listed, node), partial(self._failed, ended))

    def set(self, parameters: Sequence[Mapping[str, object]], number: str | None) -> None:
        """Set parameters; the answer has their values afterwards. Raises ``RemoteError``: one has no such form."""
        wanted: dict[str, list[dict[str, object]]] = {}
        for each in parameters:
            node, name = node_and_name(str(each.get("name")))
            wanted.setdefault(node, []).append({"name": name, "value": to_value(each)})
        names = {node: [str(each["name"]) for each in listed] for node, listed in wanted.items()}
        gathering = _Gathering(len(wanted))

        def ended() -> None:
            gathering.open -= 1
            if gathering.open <= 0 and number is not None:
                self._read(names, number)

        def changed(node: str, result: Mapping[str, object]) -> None:
            outcomes = result.get("results")
            for name, outcome in zip(names[node], outcomes if isinstance(outcomes, list) else [], strict=False):
                if not outcome["successful"]:
                    self._tell_wrong(f"{node}.{name} was not set: {outcome['reason']}")
            ended()

        for node, listed in wanted.items():
            self._ask(
                node,
                SET,
                {"parameters": listed},
                partial(changed, node),
                partial(self._failed, ended),
            )

    def pass_refusal(self, call: ParameterCall, reason: str) -> None:
        """Process the reason of a failed call."""
        self._end(call)
        call.failed(reason)

    def pass_answer(self, call: ParameterCall, raw: bytes) -> None:
        """Process a response."""
        self._end(call)
        try:
            result = orjson.loads(RosbridgeCodec(call.service.response).to_json(raw))
        except GdpError as error:
            call.failed(str(error))
            return
        call.done(result)

    def _failed(self, ended: Callable[[], None], why: str) -> None:
        self._tell_wrong(why)
        ended()

    def _read(self, names: Mapping[str, Sequence[str]], number: str | None) -> None:
        gathering = _Gathering(len(names))

        def ended() -> None:
            gathering.open -= 1
            if gathering.open <= 0:
                self._tell_values(gathering.found, number)

        def got(node: str, result: Mapping[str, object]) -> None:
            values = result.get("values")
            for name, value in zip(names[node], values if isinstance(values, list) else [], strict=False):
                if (shown := from_value(f"{node}.{name}", value)) is not None:
                    gathering.found.append(shown)
            ended()

        if not names:
            ended()
        for node, listed in names.items():
            self._ask(
                node,
                GET,
                {"names": list(listed)},
                partial(got, node),
                partial(self._failed, ended),
            )

    def _ask(
        self, node: str, what: tuple[str, str], args: dict[str, object], done: Done, failed: Callable[[str], None]
    ) -> None:
        name = f"{node}/{what[0]}"
        handle = next(
            (at for at, each in self._hub.services.items() if (each.name, each.type_name) == (name, what[1])), 0
        )
        if not handle:
            failed(f"{name}: {self._hub.rights().may_call(name) or 'no server is reachable'}")
            return
        if self._open >= _CALLS_MAX:
            failed(f"{name}: more than {_CALLS_MAX} calls are under way")
            return
        service = self._hub.services[handle]
        try:
            raw = RosbridgeCodec(service.request).to_raw(args)
        except GdpError as error:
            failed(str(error))
            return
        if self._open_bytes + len(raw) > _CALLS_MAX_BYTES:
            failed(f"{name}: the calls under way have more than {_CALLS_MAX_BYTES} bytes")
            return
        self._open += 1
        self._open_bytes += len(raw)
        self._hub.request(self._session, handle, ParameterCall(service, len(raw), done, failed), raw)

    def _end(self, call: ParameterCall) -> None:
        self._open -= 1
        self._open_bytes -= call.size_bytes


def _by_node(parameters: Sequence[str]) -> dict[str, list[str]]:
    found: dict[str, list[str]] = {}
    for each in parameters:
        node, name = node_and_name(each)
        found.setdefault(node, []).append(name)
    return found
