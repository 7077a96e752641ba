"""Simulated EC2 whose instances are booted machines: moto's API before a data centre.

I/O; moto's server runs in this process, and its backend's ``run_instances`` and ``terminate_instances`` are wrapped.
An instance boots with its user data, admits what its security groups admit, and powers off when it is terminated. A
machine that powers itself off is terminated, as ``InstanceInitiatedShutdownBehavior`` of the requests says.
"""

from __future__ import annotations

import base64
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import datetime, timedelta, timezone
from ipaddress import IPv4Address
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import pytest

from gdp.host.run_registry import Run
from lab.datacenter import Admitted, InstanceDocument, MetadataService, Router
from lab.debian import BootedMachine
from lab.process import until

if TYPE_CHECKING:
    from moto.ec2.models import EC2Backend
    from moto.ec2.models.instances import Instance, Reservation

UBUNTU: Final = "099720109477"  # owner of images of moto's account, which has none of Debian's


class DataCenter:
    """Machines of all regions."""

    def __init__(self, run: Run, image: Path) -> None:
        self.router = Router(run)
        self.machines: dict[str, BootedMachine] = {}  # also those that have ended
        self._documents: dict[IPv4Address, InstanceDocument] = {}
        self._metadata = MetadataService(self.router.namespace, self._documents.get)
        self._run = run
        self._image = image
        self._backends: dict[str, EC2Backend] = {}
        self._is_closed = False
        self._lock = threading.Lock()  # requests come from threads of the server, and change one record

    def boot(self, backend: EC2Backend, instance: Instance) -> None:
        """Boot the machine of a new instance."""
        with self._lock:
            lease = self.router.add(instance.id, _admitted(instance))
            self._documents[lease.private] = InstanceDocument(
                instance.id,
                backend.region_name,
                lease.private,
                base64.b64decode(str(instance.user_data or "")),
                lambda: {tag["key"]: tag["value"] for tag in instance.get_tags()},
            )
            self._backends[instance.id] = backend

            def ended() -> None:
                if not self._is_closed and instance.state != "terminated":
                    backend.terminate_instances([instance.id])

            self.machines[instance.id] = BootedMachine(self._run, instance.id, self._image, lease, ended)

    def end(self, instance: str) -> None:
        """Power off the machine of a terminated instance."""
        machine = self.machines.get(instance)
        if machine is not None and machine.is_up:
            machine.power_off()

    def document(self, instance: str) -> InstanceDocument:
        """Return the metadata of an instance."""
        return next(each for each in self._documents.values() if each.instance == instance)

    def interrupt(self, instance: str, after_s: float) -> None:
        """Give notice to a spot machine, and preempt it after this time; real EC2 waits two minutes."""
        at = datetime.now(timezone.utc) + timedelta(seconds=after_s)
        self.document(instance).interrupted_at = at.strftime("%Y-%m-%dT%H:%M:%SZ")
        timer = threading.Timer(after_s, lambda: self._backends[instance].terminate_instances([instance]))
        timer.daemon = True
        timer.start()

    def close(self) -> None:
        """Power off all machines; ``Run.end`` removes what they had."""
        self._is_closed = True
        for machine in self.machines.values():
            if machine.is_up:
                machine.power_off()
        self._metadata.close()

    def until(self, is_met: Callable[[], object], what: str, patience_s: float) -> None:
        """Poll until a condition holds that causes no event; the error has the consoles of all machines."""
        consoles = (f"--- {name}\n{each.console[-6000:]}" for name, each in self.machines.items())
        until(is_met, lambda: "\n".join([what, *consoles]), patience_s)


@contextmanager
def serving_ec2(center: DataCenter, absent: Path) -> Iterator[str]:
    """Serve EC2's API on a loopback port, and yield its URL; the environment of this process leads boto3 there.

    ``absent``: a path without a file, for the configuration of the user that runs the tests.
    """
    from moto.core.models import DEFAULT_ACCOUNT_ID
    from moto.ec2.models import ec2_backends
    from moto.ec2.models.instances import InstanceBackend
    from moto.server import ThreadedMotoServer

    made, ended = InstanceBackend.run_instances, InstanceBackend.terminate_instances

    def run_instances(backend: EC2Backend, *args: Any, **kwargs: Any) -> Reservation:
        reservation = made(backend, *args, **kwargs)
        for instance in reservation.instances:
            center.boot(backend, instance)
        return reservation

    def terminate_instances(backend: EC2Backend, instances: list[str]) -> object:
        changed = ended(backend, instances)
        for instance in instances:
            center.end(instance)
        return changed

    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    url = f"http://{host}:{port}"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(InstanceBackend, "run_instances", run_instances)
        patch.setattr(InstanceBackend, "terminate_instances", terminate_instances)
        patch.setenv("AWS_ENDPOINT_URL", url)
        patch.setenv("AWS_ACCESS_KEY_ID", "testing")
        patch.setenv("AWS_SECRET_ACCESS_KEY", "testing")
        patch.setenv("AWS_CONFIG_FILE", str(absent))
        patch.setenv("AWS_SHARED_CREDENTIALS_FILE", str(absent))
        patch.setenv("AWS_EC2_METADATA_DISABLED", "true")
        patch.delenv("AWS_PROFILE", raising=False)
        try:
            yield url
        finally:
            server.stop()
            for backend in ec2_backends[DEFAULT_ACCOUNT_ID].values():
                backend.reset()


def _admitted(instance: Instance) -> Iterator[Admitted]:
    for group in instance.security_groups:
        for rule in group.ingress_rules:
            network, _, bits = ((rule.ip_range or {}).get("CidrIp") or "").partition("/")
            if bits == "32" and rule.ip_protocol and rule.from_port is not None:
                yield Admitted(rule.ip_protocol, int(rule.from_port), IPv4Address(network))
