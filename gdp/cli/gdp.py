"""``gdp`` command: names, keys, trust domains, memberships and delegations.

I/O; each sub-command has a file of its own. Exit 0 when done, 2 when the input is wrong.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Final

from gdp.cli.extension import ANY_ARGUMENTS, ExtendedGroup
from gdp.cli.lazy_commands import LazyCommand, LazyCommands
from gdp.cli.program import Program
from gdp.cli.version import Version

__all__ = ["app", "main"]

_DEMO: Final = {"ignore_unknown_options": True, "allow_extra_args": True}


def _elsewhere(text: str) -> LazyCommand:
    """Return the placeholder of a command of another package or of an extension."""
    return LazyCommand("gdp.cli.extension:placeholder", no_args_is_help=False, settings=ANY_ARGUMENTS, help=text)


_KNOWN: Final = {
    "name": LazyCommand("gdp.cli.name:name"),
    "lab": LazyCommand("gdp.cli.lab:lab"),
    "endpoints": LazyCommand("gdp.cli.endpoints:endpoints"),
    "join": LazyCommand("gdp.cli.join:join", no_args_is_help=False),
    "up": LazyCommand("gdp.cli.join:up"),
    "agent": LazyCommand("gdp.cli.join:agent"),
    "expose": LazyCommand("gdp.cli.share:expose"),
    "import": LazyCommand("gdp.cli.share:import_names"),
    "share": LazyCommand("gdp.cli.share:share"),
    "reload": LazyCommand("gdp.cli.control:reload"),
    "status": LazyCommand("gdp.cli.control:status"),
    "drain": LazyCommand("gdp.cli.control:drain"),
    "explain": LazyCommand("gdp.cli.explain:explain"),
    "foxglove": _elsewhere("Let Foxglove see what a node's delegations allow."),
    "rosbridge": _elsewhere("Let rosbridge clients use what a node's delegations allow."),
    "recording": _elsewhere("Complete a recording whose writer was killed."),
    "rule": _elsewhere("Add, remove and list rules of a proxy while it runs."),
    "service": _elsewhere("Call a service through the overlay, as a member."),
    "watch": _elsewhere("Print events when publishers, readers and servers of a name appear or go."),
    "ping": LazyCommand("gdp.cli.ping:ping"),
    "trace": LazyCommand("gdp.cli.trace:trace"),
    "show": LazyCommand("gdp.cli.show_tables:show_table"),
    "dashboard": _elsewhere("Show domains, links, names, replicas, drops and events live, on one page."),
    "wireshark": _elsewhere("Print or install a Wireshark dissector for our frames."),
    "demo": LazyCommand("gdp.cli.demo:demo", no_args_is_help=False, settings=_DEMO),
    "decrypt-pcap": _elsewhere("Write a capture with the messages that the given keys open."),
    "top": LazyCommand("gdp.cli.top:top", no_args_is_help=False),
    "completion": LazyCommand("gdp.cli.completion:completion"),
    "keygen": LazyCommand("gdp.cli.keygen:app"),
    "key": LazyCommand("gdp.cli.key:app"),
    "domain": LazyCommand("gdp.cli.domain:app"),
    "cert": LazyCommand("gdp.cli.cert:app"),
    "delegate": LazyCommand("gdp.cli.delegate:app"),
    "audit": LazyCommand("gdp.cli.audit:app"),
    "incident": LazyCommand("gdp.cli.incident:app"),
    "topic": LazyCommand("gdp.cli.topic:app"),
    "unit": LazyCommand("gdp.cli.unit:app"),
    "rib": LazyCommand("gdp.cli.rib_lookup:app"),
}


class _Commands(ExtendedGroup):
    extensions: ClassVar[Mapping[str, str]] = {name: name for name, each in _KNOWN.items() if each.help}

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        self.commands = LazyCommands(_KNOWN)


app = Program("gdp", cls=_Commands, help="Names, keys and proofs of the Global Data Plane.", no_args_is_help=True)
main = app.run


@app.callback()
def _gdp(version: Version = False) -> None:
    del version  # the option's callback ends the command


if __name__ == "__main__":
    main()
