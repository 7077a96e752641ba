"""Rules about nodes and the network between them.

Sans-I/O. Each rule yields sentence and command where its cause holds; the first counts.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from gdp.diagnosis.answer import Cause
from gdp.diagnosis.facts import SwitchFacts
from gdp.diagnosis.view import Found, Node, Rule, View, short
from gdp.limits import CLOCK_SKEW_S

_START: Final = "gdp up FOLDER"  # on the machine of the node
_STRANGER: Final = "neighbour-refused"
_SILENT: Final = ("no-neighbour", "not-heard")


def no_proxy_here(view: View) -> Iterator[Found]:
    """No proxy of the asker answers."""
    if view.near is not None:
        return
    down = next((each for each in view.facts.unreachable if each.role == "proxy"), None)
    where = "this machine" if down is None else down.where
    yield f"No proxy runs on {where}, so nothing crosses.", _START


def clock(view: View) -> Iterator[Found]:
    """A clock differs by more than certificates allow."""
    near = view.near
    if near is None:
        return
    for node in view.nodes:
        apart_s = node.unix_s - near.unix_s
        if node.unix_s and near.unix_s and abs(apart_s) > CLOCK_SKEW_S:
            which = f"The clock of {view.place_of(node)} differs from this machine's by {_span(apart_s)}"
            yield f"{which}, so one of them refuses the certificates of the other.", "timedatectl set-ntp true"
    for each in view.members:
        if each.unix_s and each.unix_s < each.valid_from_unix_s - CLOCK_SKEW_S:
            early = _span(each.valid_from_unix_s - each.unix_s)
            text = f"The clock of {view.place_of(each)} is {early} before its own certificate begins."
            yield text, "timedatectl set-ntp true"


def identity_in_use(view: View) -> Iterator[Found]:
    """Another node has the same keys."""
    for node, _ in view.waits("identity-in-use"):
        text = f"Another node with the keys of {view.place_of(node)} is attached, and the older one stays."
        yield text, "gdp keygen node keys/new --role proxy --label LABEL"


def membership_revoked(view: View) -> Iterator[Found]:
    """A membership is revoked: a proxy knows it of its own, or refuses a neighbour for it."""
    for proxy in view.facts.proxies:
        if proxy.is_revoked:
            text = f"The membership of {view.place_of(proxy)} is revoked, so its neighbours refuse it."
            yield text, "gdp cert issue --domain DOMAIN --request node.csr --role proxy --label LABEL"
    for node, wait in view.waits(_STRANGER):
        if wait.refused == "revoked":
            text = f"{_of(view, node)} refuses its neighbour on {wait.device}: that membership is revoked."
            yield text, "gdp cert issue --domain DOMAIN --request node.csr --role proxy --label LABEL"


def membership_expired(view: View) -> Iterator[Found]:
    """A membership has ended."""
    for each in view.members:
        if each.valid_until_unix_s and each.unix_s > each.valid_until_unix_s:
            late = _span(each.unix_s - each.valid_until_unix_s)
            if view.is_torn:
                yield f"The membership of {view.place_of(each)} expired {late} ago.", "gdp cert renew --help"
    for node, wait in view.waits(_STRANGER):
        if wait.refused == "expired":
            text = f"{_of(view, node)} refuses its neighbour on {wait.device}: that membership has expired"
            yield f"{text}, or a clock is wrong.", "gdp cert renew --help"


def untrusted_domain(view: View) -> Iterator[Found]:
    """A neighbour, or the domain of an advertiser, is not trusted."""
    for node, wait in view.waits(_STRANGER):
        if wait.refused in ("wrong-domain", "bad-certificate"):
            domain = wait.domain or "another domain"
            text = f"{_of(view, node)} does not trust {domain}, the domain of its neighbour on {wait.device}."
            yield text, "gdp domain --help"
    for switch in view.facts.switches:
        for place in switch.locations:
            if not place.is_trusted:
                text = f"{_of(view, switch)} does not trust domain {short(place.domain)}, where the name is."
                yield text, "gdp domain --help"


def interface_down(view: View) -> Iterator[Found]:
    """A link is down, and the network is not whole."""
    for node, wait in view.waits("link-down") if view.is_torn else ():
        text = f"Device {wait.device} of {view.place_of(node)} is down or absent."
        yield text, f"ip link set {wait.device or 'DEVICE'} up"


def switch_down(view: View) -> Iterator[Found]:
    """A switch that the asker named does not run."""
    for each in view.facts.unreachable:
        if each.role == "switch" and each.is_down:
            yield f"The switch {each.where} does not run.", _START


def ethertype_filtered(view: View) -> Iterator[Found]:
    """Two switches run, were neighbours on a link that is up, and neither hears the other."""
    waits = view.waits(*_SILENT) if view.is_torn else ()
    silent = [(node, wait) for node, wait in waits if isinstance(node, SwitchFacts)]
    missed = {(wait.neighbour, node.name) for node, wait in silent}
    for node, wait in silent:
        if (node.name, wait.neighbour) not in missed:
            continue
        text = f"The link at {wait.device} of {view.place_of(node)} is up and both ends run, but no hello passes"
        yield (
            f"{text}: something in between filters EtherType 0x88B5.",
            (f"tcpdump -eni {wait.device or 'DEVICE'} ether proto 0x88b5"),
        )


def link_silent(view: View) -> Iterator[Found]:
    """No node answers on a link that the name needs."""
    for node, wait in view.waits(*_SILENT, "no-switch") if view.is_torn else ():
        if wait.reason == "not-heard":
            text = f"The neighbour of {view.place_of(node)} on {wait.device} does not hear it, or does not trust it."
            yield text, "gdp status NODE_DIR"
        text = f"No switch answers on {wait.device} of {view.place_of(node)}"
        yield f"{text}: it does not run, or something filters EtherType 0x88B5.", _START


def nat_closed(view: View) -> Iterator[Found]:
    """A tunnel never had a handshake, and the name is behind it."""
    if not _is_cut_off(view):
        return
    for switch in view.facts.switches:
        for tunnel in switch.tunnels:
            if not tunnel.is_up and tunnel.handshake_age_s is None and tunnel.endpoint:
                text = f"No handshake ever came back from {tunnel.endpoint}, the far end of tunnel {tunnel.device}"
                yield f"{text}: its NAT or firewall is closed for UDP.", "gdp status SWITCH_DIR"


def tunnel_down(view: View) -> Iterator[Found]:
    """A tunnel is down, and the name is behind it."""
    if not _is_cut_off(view):
        return
    for switch in view.facts.switches:
        for tunnel in switch.tunnels:
            if not tunnel.is_up:
                age = tunnel.handshake_age_s
                since = "it has no endpoint yet" if age is None else f"its last handshake was {_span(age)} ago"
                text = f"Tunnel {tunnel.device} of {view.place_of(switch)} to {tunnel.peer} is down; {since}."
                yield text, "gdp status SWITCH_DIR"


def rib_down(view: View) -> Iterator[Found]:
    """No RIB answers."""
    for each in view.facts.unreachable:
        if each.role == "rib" and each.is_down:
            yield f"The RIB {each.where} does not run, so no switch learns where names are.", _START
    cut = {node.name for node, _ in view.waits(*_SILENT, "link-down")}
    if any(each.rib for each in view.facts.switches):
        return
    for switch in view.facts.switches:
        if switch.name not in cut:
            yield f"{_of(view, switch)} reaches no RIB, so names are not found.", _START
    for node, _ in view.waits("no-rib") if not view.facts.switches else ():
        yield f"No RIB answers {view.place_of(node)}, so names are not found.", _START


def rib_silent(view: View) -> Iterator[Found]:
    """The RIB in use does not answer."""
    for switch in view.facts.switches:
        if switch.is_rib_silent and not view.advertisers:
            text = f"{_of(view, switch)} gets no answer from RIB {short(switch.rib)}, so the name is not found."
            yield text, _START


def far_proxy_down(view: View) -> Iterator[Found]:
    """The other end's proxy is away: the asker knows that it does not run, or its lease ended."""
    for each in view.facts.unreachable:
        if each.role == "proxy" and each.is_down and view.near is not None:
            yield f"The proxy {each.where} does not run.", _START
    lapsed = [each for each in view.lapsed if view.reaches(each.switch, each.domain)]
    if lapsed:
        text = f"Proxy {short(lapsed[-1].advertiser)} advertised the name until its lease ended"
        yield f"{text}: it stopped without a goodbye, or its machine is cut off.", _START
    is_known = view.exporters or view.facts.ribs
    if not is_known and not view.advertisers and any(each.flow.absent for each in view.importers):
        yield "The proxy that published the name is gone.", _START


def no_route(view: View) -> Iterator[Found]:
    """The advertiser's switch is known, and no path leads there."""
    for switch in view.facts.switches:
        for place in switch.locations:
            if not place.is_reachable:
                text = f"{_of(view, switch)} knows that the name is at switch {short(place.switch)}"
                yield f"{text}, but no path that the policies allow leads there.", "gdp show routes"
    for node, _ in view.waits("through-leaf"):
        yield (
            f"Only leaves, which carry no transit, connect {view.place_of(node)} to other switches.",
            ("gdp show links"),
        )


def _is_cut_off(view: View) -> bool:
    return view.is_torn or (not view.advertisers and any(each.tunnels for each in view.facts.switches))


def _of(view: View, node: Node) -> str:
    text = view.place_of(node)
    return text[0].upper() + text[1:]


def _span(seconds: float) -> str:
    seconds = abs(seconds)
    for size, unit in ((86_400, "days"), (3_600, "h"), (60, "min")):
        if seconds >= 2 * size:
            return f"{seconds / size:.0f} {unit}"
    return f"{seconds:.3g} s"


RULES: Final[dict[Cause, Rule]] = {
    Cause.NO_PROXY_HERE: no_proxy_here,
    Cause.CLOCK: clock,
    Cause.IDENTITY_IN_USE: identity_in_use,
    Cause.MEMBERSHIP_REVOKED: membership_revoked,
    Cause.MEMBERSHIP_EXPIRED: membership_expired,
    Cause.INTERFACE_DOWN: interface_down,
    Cause.SWITCH_DOWN: switch_down,
    Cause.UNTRUSTED_DOMAIN: untrusted_domain,
    Cause.NAT_CLOSED: nat_closed,
    Cause.TUNNEL_DOWN: tunnel_down,
    Cause.ETHERTYPE_FILTERED: ethertype_filtered,
    Cause.RIB_DOWN: rib_down,
    Cause.LINK_SILENT: link_silent,
    Cause.NO_ROUTE: no_route,
    Cause.FAR_PROXY_DOWN: far_proxy_down,
    Cause.RIB_SILENT: rib_silent,
}
