"""Veth pairs for nodes attached on the same host: the switch's command makes them and removes them when it ends.

I/O. Each pair carries its switch's name as an alias. The alias identifies the pairs of a killed run of the same switch,
which are replaced. A device of that name without the alias belongs to another program and is refused. The switch's ends
are locked while the pairs exist (``single_instance.py``), so the pair of a running switch is never touched.
"""

from __future__ import annotations

import contextlib
import errno
import logging
from collections.abc import Iterator, Sequence

from gdp.errors import LocalError
from gdp.host.single_instance import own_devices
from gdp.names import Name
from gdp.ports.netlink import RefusedError
from gdp.ports.tunnel.devices import (
    add_pair,
    bring_up,
    find_device,
    refusal_text,
    remove_device,
    remove_own_device,
)

log = logging.getLogger(__name__)


def switch_end(name: str) -> str:
    """Return the device at the switch's end of a pair."""
    return f"{name}-s"


@contextlib.contextmanager
def attach_pairs(names: Sequence[str], switch: Name, mtu: int) -> Iterator[None]:
    """Make the pairs ``NAME``/``NAME-s`` until the context ends, and hold the locks of the switch's ends.

    Args:
        mtu: bytes after the Ethernet header.

    Raises:
        LocalError: a device of that name belongs to another program or to a running switch, or the system refuses to
            make devices.
    """
    if not names:
        yield
        return
    alias = f"gdp-switch {switch.to_text()}"
    made: list[str] = []
    with own_devices(map(switch_end, names)):
        try:
            try:
                for name in names:
                    _make(name, alias, mtu)
                    made.append(name)
            except RefusedError as error:
                raise LocalError(f"attach {name}: the veth pair cannot be made: {_reason(error, mtu)}") from error
            yield
        finally:
            for name in made:
                device = find_device(switch_end(name))
                if device is not None:
                    remove_device(device.ifindex)


def _make(name: str, alias: str, mtu: int) -> None:
    end = switch_end(name)
    if remove_own_device(end, alias):
        log.warning("a dead run left a device ifname=%s", end)
    add_pair(name, end, mtu)
    for ifname in (name, end):
        bring_up(ifname, alias)


def _reason(error: RefusedError, mtu: int) -> str:
    """Return what the kernel refused and how to proceed."""
    if error.number == errno.EINVAL:
        return f"invalid argument (MTU {mtu}, which it takes from the widest port)"
    return refusal_text(error)
