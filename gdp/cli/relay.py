"""``gdp-relay`` command.

I/O. A command loads what a node needs when it runs one, so that its help comes at once.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from gdp.cli.node import Check, Config, Json, Logs, report, running
from gdp.cli.output import show
from gdp.cli.program import Program
from gdp.intervals import ANSWER_S

if TYPE_CHECKING:
    from gdp.config.relay_config import RelayConfig
    from gdp.crypto.identity import Identity
    from gdp.nodes.relay import Relay

app = Program("gdp-relay")
main = app.run


@app.command(
    epilog="Examples: gdp-relay --config relay.yaml; gdp-relay --config relay.yaml --check prints the device of each"
    " border, which is an optional port of the switch; gdp-relay --config relay.yaml --status",
)
def relay(
    config: Config,
    status: Annotated[bool, typer.Option("--status", help="Show the status of the running relay, and end.")] = False,
    check: Check = False,
    json: Json = False,
    *,
    logs: Logs,
) -> None:
    """Carry a switch's frames through TLS where the network blocks UDP, until Ctrl-C. It is slower than a tunnel.

    With the section server it is a border's end, with borders it is a member's end. Each connection has a TAP device,
    which has a carrier only while the connection is open.
    """
    from gdp.config.relay_config import RelayConfig
    from gdp.crypto.certificates import Role
    from gdp.management.control_client import ask_node
    from gdp.nodes.membership import load_member
    from gdp.nodes.relay import relay_control_path, run_relay
    from gdp.state.control_protocol import Command

    with running(logs):
        settings = RelayConfig.load(config)
        if check or status:
            identity, _ = load_member(settings.identity, settings.domain, Role.SWITCH)
            if check:
                _report_check(identity, settings, json=json)
            else:
                response = ask_node(relay_control_path(settings, identity.name), Command.STATUS, ANSWER_S)
                show(response.result, as_json=json)
            return
        run_relay(settings, lambda identity, relay: _report_ready(identity, relay, json=json))


def _report_check(identity: Identity, settings: RelayConfig, *, json: bool) -> None:
    from gdp.ports.tap import tap_name

    devices = {each.peer.to_text(): tap_name(identity.name, each.peer) for each in settings.borders}
    port = None if settings.server is None else settings.server.port
    text = f"configuration good: relay of {identity.role.value} {identity.name.short}, server port {port or 'none'}"
    leads = [f"{device} leads to {peer}" for peer, device in devices.items()]
    name = identity.name.to_text()
    report("checked", "\n".join([text, *leads]), json=json, name=name, port=port, devices=devices)


def _report_ready(identity: Identity, relay: Relay, *, json: bool) -> None:
    port = None if relay.server is None else relay.server.listening_port
    devices = [dialer.port.device.ifname for dialer in relay.dialers]
    text = f"relay of {identity.role.value} {identity.name.short} is up, via TLS (slower); Ctrl-C ends it"
    report("ready", text, json=json, name=identity.name.to_text(), port=port, devices=devices)


if __name__ == "__main__":
    main()
