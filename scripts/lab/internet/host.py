"""Host of a laboratory: devices that are attached to sites, moved between them and unplugged.

I/O. A device stays while its host moves to another site: it loses its carrier, and gets another address.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from lab.internet.access import LAN
from lab.internet.site import Lease, Site
from lab.machine import LabMachine
from lab.namespaces import IpNamespace

if TYPE_CHECKING:
    from lab.internet.laboratory import Laboratory

ETHERNET: Final = "eth0"
_FIRST_METRIC: Final = 100


@dataclass(slots=True)
class _Attachment:
    site: Site
    number: int  # of the host at the site
    port: str  # device of the site's router
    metric: int
    lease: Lease = field(default_factory=Lease)


class Host(LabMachine):
    """A machine; ``Laboratory.add_host`` makes it."""

    def __init__(self, laboratory: Laboratory, label: str) -> None:
        self.label = label
        self.laboratory = laboratory
        self.space = IpNamespace(laboratory.run, label)
        super().__init__(laboratory.run.directory, self.space.command([]), run=laboratory.run)
        self._attachments: dict[str, _Attachment] = {}

    @property
    def devices(self) -> list[str]:
        """The devices, in the order in which they came."""
        return list(self._attachments)

    def attach(self, site: Site, device: str = ETHERNET) -> None:
        """Connect a device with a site, a new one if there is none of that name; away from its former site.

        The default route over the device that came first is the best.
        """
        router = site.routers[0]
        attachment = self._attachments.get(device)
        if attachment is None:
            port = self.laboratory.next_device()
            metric = _FIRST_METRIC * (1 + len(self._attachments))
            link = f"link add {device} index {self.laboratory.next_index()} type veth peer {port} netns {router.path}"
            self.space.configure([link, f"link set {device} up"])
            attachment = self._attachments[device] = _Attachment(site, site.next_host(), port, metric)
        else:
            attachment.site.routers[0].configure([f"link set {attachment.port} netns {router.path}"])
            attachment.site, attachment.number = site, site.next_host()
        router.configure([f"link set {attachment.port} master {LAN} up"])
        self._wait_for_carrier(device)
        self.renew_lease(device)

    def renew_lease(self, device: str = ETHERNET) -> None:
        """Give a device the addresses and routes that its site has for it now."""
        attachment = self._attachments[device]
        old, new = attachment.lease, attachment.site.lease(attachment.number)
        route = f"dev {device} metric {attachment.metric}"
        lines = [f"route del default via {gateway} {route}" for _, gateway in old.pairs()]
        lines += [f"addr del {address} dev {device}" for address, _ in old.pairs()]
        lines.append(f"neigh flush dev {device}")
        for address, gateway in new.pairs():
            lines.append(f"addr add {address} dev {device}" + (" nodad" if ":" in address else ""))
            lines.append(f"route add default via {gateway} {route}")
        self.space.configure(lines)
        attachment.lease = new

    def renumber(self, device: str = ETHERNET) -> None:
        """Give a device another address of its site, as a DHCP server does."""
        attachment = self._attachments[device]
        attachment.number = attachment.site.next_host()
        self.renew_lease(device)

    def unplug(self, device: str = ETHERNET) -> None:
        """Take the carrier away from a device; its addresses stay."""
        self._set_port(device, "down")

    def plug(self, device: str = ETHERNET) -> None:
        """Give an unplugged device its carrier back."""
        self._set_port(device, "up")
        self._wait_for_carrier(device)
        self.space.configure([f"neigh flush dev {device}"])  # a request from before is repeated after a second only

    def lease(self, device: str = ETHERNET) -> Lease:
        """Return the addresses of a device."""
        return self._attachments[device].lease

    def site(self, device: str = ETHERNET) -> Site:
        """Return the site that a device is attached to."""
        return self._attachments[device].site

    def devices_at(self, site: Site) -> list[str]:
        """Return the devices that are attached to a site."""
        return [device for device, each in self._attachments.items() if each.site is site]

    def command(self, argv: Sequence[str]) -> list[str]:
        """Return the command line that runs ``argv`` on the host, as ``Space.command``."""
        return self.space.command(argv)

    def _set_port(self, device: str, state: str) -> None:
        attachment = self._attachments[device]
        attachment.site.routers[0].configure([f"link set {attachment.port} {state}"])

    def _wait_for_carrier(self, device: str) -> None:
        """Return when no frame is lost in either direction: an address request that is lost costs a second."""
        attachment = self._attachments[device]
        attachment.site.routers[0].wait_for_carrier(attachment.port, LAN)
        self.space.wait_for_carrier(device)
