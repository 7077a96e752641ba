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

_DEMO: Final = {"ignore_unknown_options": True, "allow_extra_args": True}


def _own(target: str, summary: str, **settings: Any) -> LazyCommand:
    return LazyCommand(f"gdp.cli.{target}", summary, **settings)


def _elsewhere(text: str) -> LazyCommand:
    """Return the placeholder of a command of another package or of an extension."""
    return LazyCommand(
        "gdp.cli.extension:placeholder", text, no_args_is_help=False, settings=ANY_ARGUMENTS, is_placeholder=True
    )


_KNOWN: Final = {
    "name": _own("name:name", "Print the 256-bit name of metadata and an owner's key."),
    "lab": _own("lab:lab", "Make a small lab: a domain, an owner, and for each machine a switch and a proxy."),
    "endpoints": _own(
        "endpoints:endpoints", "Write the endpoint record of a switch: its WireGuard keys and addresses."
    ),
    "join": _own(
        "join:join", "Join the domain of a token: make keys, fetch memberships, start the nodes.", no_args_is_help=False
    ),
    "up": _own("join:up", "Start the programs of a machine: switch, RIB where it has one, and proxy."),
    "agent": _own("join:agent", "Run the agent of a machine until Ctrl-C; its units do that."),
    "expose": _own("share:expose", "Let nodes read a topic, or call a service, of this machine."),
    "import": _own("share:import_names", "Take what other nodes offer to this machine, now and later."),
    "share": _own("share:share", "Let nodes act on names of this owner, or take the right back."),
    "reload": _own("control:reload", "Make a running node read its configuration and certificates again."),
    "status": _own("control:status", "Show the identity, the uptime and the counters of a running node."),
    "drain": _own("control:drain", "Make a running node finish its work and end."),
    "explain": _own("explain:explain", "Say why a topic or service does not arrive, and what to type next."),
    "foxglove": _elsewhere("Let Foxglove see what a node's delegations allow."),
    "rosbridge": _elsewhere("Let rosbridge clients use what a node's delegations allow."),
    "recording": _elsewhere("Complete a recording whose writer was killed."),
    "rule": _elsewhere("Add, remove and list rules of a proxy while it runs."),
    "service": _elsewhere("Call a service through the overlay, as a member."),
    "watch": _elsewhere("Print events when publishers, readers and servers of a name appear or go."),
    "control": _own("topic_control:app", "Show, take or give the control of a topic that one publisher may steer."),
    "ping": _own("ping:ping", "Measure the round-trip time to the members that publish or serve a name."),
    "trace": _own("trace:trace", "Show each switch between here and those members, and the trees below."),
    "show": _own("show_tables:show_table", "Show a table of every node that runs on this machine, or of one."),
    "dashboard": _elsewhere("Show domains, links, names, replicas, drops and events live, on one page."),
    "wireshark": _elsewhere("Print or install a Wireshark dissector for our frames."),
    "demo": _own(
        "demo:demo",
        "Send a robot's drive around a ring of five switches on this machine.",
        no_args_is_help=False,
        settings=_DEMO,
    ),
    "decrypt-pcap": _elsewhere("Write a capture with the messages that the given keys open."),
    "top": _own("top:top", "Show the live rates of the names that this machine's nodes carry.", no_args_is_help=False),
    "completion": _own("completion:completion", "Print a script that completes the words of all our commands."),
    "keygen": _own("keygen:app", "Make keys for an owner of names, or for a node."),
    "key": _own("key:app", "Private keys: under a passphrase, plain, or in a token."),
    "domain": _own("domain:app", "Create a trust domain, let machines join it, or look at one."),
    "cert": _own("cert:app", "Memberships: issue, renew, install, show, revoke; rollover of roots."),
    "delegate": _own("delegate:app", "Let nodes act on names, or a switch attract a node's traffic."),
    "audit": _own("audit:app", "Audit logs of switches, RIBs, domains and owners."),
    "incident": _own("incident:app", "What happened at a node: save its journal, show it, and run it again."),
    "topic": _own("topic:app", "List, measure and read topics."),
    "store": _own("store:app", "Hold capsules, the history of topics, and read them back."),
    "unit": _own("unit:app", "systemd units of this machine's nodes."),
    "rib": _own("rib_lookup:app", "Ask RIBs what they know."),
}


class _Commands(ExtendedGroup):
    extensions: ClassVar[Mapping[str, str]] = {name: name for name, each in _KNOWN.items() if each.is_placeholder}

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        self.commands = self._known = LazyCommands(_KNOWN)

    def format_commands(self, _context: Any, formatter: Any) -> None:
        """Write the section of the help that lists the commands."""
        with formatter.section("Commands"):
            formatter.write_dl(self._known.summaries())


app = Program("gdp", cls=_Commands, help="Names, keys and proofs of the Global Data Plane.", no_args_is_help=True)
main = app.run


@app.callback()
def _gdp(version: Version = False) -> None:
    del version  # the option's callback ends the command


if __name__ == "__main__":
    main()
