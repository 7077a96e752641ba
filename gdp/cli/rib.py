"""``gdp-rib`` command.

I/O. A command loads what a node needs when it runs one, so that its help comes at once.
"""

from __future__ import annotations

from gdp.cli.node import AwaitIface, Check, Config, Json, Logs, MemberPlane, emit_wait, report, running, with_plane
from gdp.cli.program import Program
from gdp.intervals import ATTACH_S
from gdp.names import Name

app = Program("gdp-rib")
main = app.run


@app.command(epilog="Example: gdp-rib --config rib.yaml")
def rib(
    config: Config,
    await_iface: AwaitIface = ATTACH_S,
    data_plane: MemberPlane = None,
    check: Check = False,
    json: Json = False,
    *,
    logs: Logs,
) -> None:
    """Answer queries for the nodes that advertise a name in one trust domain, until Ctrl-C."""
    from gdp.config.config import RibConfig
    from gdp.links.uplink import wait_for_device
    from gdp.nodes.rib import run_rib

    with running(logs):
        settings = with_plane(RibConfig.load(config), data_plane)
        if check:
            from gdp.crypto.certificates import Role
            from gdp.nodes.membership import load_member

            name = load_member(settings.identity, settings.domain, Role.RIB)[0].name
            report("checked", f"configuration good: RIB {name.short}", json=json, name=name.to_text())
            return

        def report_ready(name: Name) -> None:
            report("ready", f"RIB {name.short} is up; Ctrl-C ends it", json=json, name=name.to_text())

        wait_for_device(settings.iface, await_iface)
        run_rib(settings, report_ready, emit_wait if json else None)


if __name__ == "__main__":
    main()
