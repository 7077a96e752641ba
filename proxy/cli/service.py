"""Command ``gdp service call``: one request to a service, through the overlay.

I/O; ``gdp`` loads it, since the package ``gdp`` does not know ``proxy``.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Annotated

import typer

from gdp.cli.options import known_name
from gdp.cli.program import Program
from gdp.intervals import TICK_S
from gdp.names import Name
from proxy.cli.tool_options import Node, ToolOptions, complete_callable, print_json, print_text, running_tool

if TYPE_CHECKING:
    from proxy.bridge.bridge import Bridge
    from proxy.endpoints.probe import Probe

app = Program("gdp service", no_args_is_help=True)


ServiceName = Annotated[str, known_name("/plan", complete_callable)]
ServiceType = Annotated[str, typer.Argument(metavar="TYPE", help="Its type, such as std_srvs/srv/SetBool.")]
Values = Annotated[
    str, typer.Argument(metavar="REQUEST", help="The request in YAML; fields that it leaves out are zero or empty.")
]


@app.callback()
def _service() -> None:
    """Call a service through the overlay, as a member."""  # a group: typer would run a single command without its name


@app.command(
    no_args_is_help=True,
    epilog="Examples: gdp service call /reset std_srvs/srv/Trigger --node keys/viewer;"
    " gdp service call /arm std_srvs/srv/SetBool '{data: true}' --node keys/viewer --json",
)
def call(
    name: ServiceName,
    type_name: ServiceType,
    node: Node,
    request: Values = "{}",
    timeout: Annotated[
        float, typer.Option("--timeout", min=0.1, max=86_400.0, metavar="SECONDS", help="For server and response.")
    ] = 10.0,
    *,
    options: ToolOptions,
) -> None:
    """Call a service once through the overlay and print the response, as 'ros2 service call' does.

    It states which replica answered first. The node NODE needs the right to call the service. Exit code 1: no server
    is reachable, or none answers in time.
    """
    with running_tool(options):
        from gdp.trust.right import Right
        from proxy.endpoints.probe import Probe
        from proxy.node.tool_member import NoAnswerError, Wanted, run_probe
        from proxy.tools.message_text import MessageText, request_tree

        tree = request_tree(request)
        access = options.find_access(node, Wanted(name, type_name, Right.CALL))
        probe = Probe()
        asked = _Call(probe, access.rule.name, access.name, tree, timeout)
        run_probe(access, probe, asked.tick, timeout_s=timeout)
        if asked.response is None:
            raise NoAnswerError(f"{access.rule.name}: {asked.reason or 'interrupted before a response came'}")
        text = MessageText(asked.response_channel, None)
        server = None if asked.server is None else asked.server.to_text()
        if options.json:
            body = text.to_json(asked.response)
            fields = {"service": access.rule.name, "type": access.rule.type_name, "server": server}
            print_json({**fields, "elapsed_ms": round(asked.elapsed_s * 1e3, 3), "response": body})
            return
        print_text(f"requester: making request: {type_name} {request}\n")
        print_text(f"response from {server or 'a server'} after {asked.elapsed_s * 1e3:.1f} ms:")
        print_text(text.to_yaml(asked.response).rstrip("\n"))


class _Call:
    """One request: it waits for a server, sends, and waits for the response.

    Attributes:
        response: None until it came.
        reason: why none came.
        server: the replica whose response came first.
    """

    def __init__(self, probe: Probe, label: str, name: Name, tree: object, timeout_s: float) -> None:
        self._probe = probe
        self._label = label
        self._name = name
        self._tree = tree
        self._timeout_s = timeout_s
        self._begun_s: float | None = None
        self._sent_s: float | None = None
        self.response: bytes | None = None
        self.reason = ""
        self.server: Name | None = None
        self.elapsed_s = 0.0

    def tick(self, bridge: Bridge, now_s: float) -> float | None:
        """Take the next step; return the moment of the next one, None at the end."""
        from proxy.tools.message_text import request_of

        self._begun_s = now_s if self._begun_s is None else self._begun_s
        served = self._probe.served
        if self._sent_s is None and served is not None:
            raw = request_of(served.request, self._tree)
            self.response_channel = served.response
            self._sent_s = time.monotonic()
            self._probe.begin_call(raw)
        if self._probe.response is not None and self._sent_s is not None:
            self.response, self.elapsed_s = self._probe.response, now_s - self._sent_s
            self.server = bridge.answered_by(self._name)
            return None
        if self._probe.refusal:
            self.reason = self._probe.refusal
            return None
        end_s = self._begun_s + self._timeout_s
        if now_s >= end_s:
            seen = "no server is reachable" if self._sent_s is None else "no answer"
            self.reason = f"{seen} within {self._timeout_s:g} s"
            return None
        return min(now_s + TICK_S, end_s)
