"""Child process of ``test_skypilot``: SkyPilot's real package, without its API server.

The API server runs the functions that are called here; it starts dozens of processes, too many for a test.
Prints one line of JSON with the result of each step.
"""

from __future__ import annotations

import contextlib
import io
import json
import sys
from collections.abc import Callable
from dataclasses import asdict, replace

import sky
from sky import check, core, execution
from sky.utils import rich_utils

from fog.bootstrap.bundles import machine_boot
from fog.cluster import CloudNode, ClusterPlan, ExportedInterface, MachineRequest
from fog.hardware import Hardware, Offer
from fog.machine import MachineSpec
from fog.providers.cloud_config import SkyPilotConfig
from gdp.errors import GdpError
from gdp.trust.join_token import JoinRole, JoinToken
from gdp_extensions.skypilot.provider import SkyPilotProvider

ECHO = ExportedInterface("service", "/echo", "std_srvs/srv/SetBool")
PLAN = ClusterPlan("a-demo", (CloudNode("p", "e"),), (MachineRequest(Hardware(cpus=1)),), (ECHO,))
TOKEN = JoinToken(
    root=bytes(32), secret=bytes(16), role=JoinRole.MACHINE, expires_unix_s=2_000_000_000, servers=("192.0.2.1:51820",)
)


class Unserved:
    """``sky`` in which each request is done at once; ``tasks``: as YAML, as they came."""

    def __init__(self) -> None:
        self.tasks: list[dict[str, object]] = []

    def __getattr__(self, name: str) -> object:
        return getattr(sky, name)

    def launch(self, task: sky.Task, cluster_name: str, dryrun: bool = False) -> object:
        self.tasks.append(task.to_yaml_config())
        return execution.launch(task, cluster_name=cluster_name, dryrun=dryrun)

    def status(self, refresh: object) -> object:
        return core.status(refresh=refresh)

    def api_status(self) -> list[object]:
        return []

    def down(self, name: str) -> object:
        return lambda: core.down(name)

    def get(self, request: object) -> object:
        return request() if callable(request) else request


def outcome(step: Callable[[], object]) -> str:
    try:
        return repr(step())
    except GdpError as error:
        return f"{type(error).__name__}: {error}"


def printed_progress() -> str:
    """Return what SkyPilot prints about a step that takes a while."""
    with contextlib.redirect_stdout(io.StringIO()) as printed, rich_utils.safe_status("looking up prices"):
        pass
    return printed.getvalue()


def main() -> None:
    enabled = check.check_capability(sky.clouds.CloudCapability.COMPUTE, quiet=True, clouds=["aws"])
    unserved = Unserved()
    provider = SkyPilotProvider(SkyPilotConfig(), unserved)  # type: ignore[arg-type]
    offers = provider.offers(Hardware.from_text("cpu:16"), spot=True)
    spec = MachineSpec("a-demo", "m1", offers[0])
    boot = machine_boot(PLAN, "m1", lambda node: ("run", node.package), TOKEN)

    def dry_run(offer: Offer) -> str:
        return outcome(lambda: provider.dry_run(replace(spec, offer=offer), boot))

    reported: dict[str, object] = {
        "enabled": list(enabled.values()),
        "offers": [asdict(each) for each in offers],
        "gpu": [each.type_name for each in provider.offers(Hardware.from_text("T4"), spot=False)],
        "none": [each.type_name for each in provider.offers(Hardware.from_text("cpu:64"), spot=False)],
        "dry run": dry_run(spec.offer),
        "no such type": dry_run(replace(spec.offer, type_name="nope.large")),
        "no such region": dry_run(replace(spec.offer, region="aws/nowhere")),
        "machines": outcome(lambda: provider.describe("a-demo")),
        "terminate": outcome(lambda: provider.terminate(["fog-a-demo-m1"])),
    }
    read = sky.Task.from_yaml_config(unserved.tasks[0])  # SkyPilot's own parser, with its schema
    types = [each.instance_type for each in read.resources]
    reported["task"] = {"setup": read.setup, "run": read.run, "types": types}
    reported["printed by a server"] = printed_progress()
    SkyPilotProvider()
    reported["printed by a client"] = printed_progress()
    sys.__stdout__.write(f"\n{json.dumps(reported)}\n")  # type: ignore[union-attr]


if __name__ == "__main__":
    with contextlib.redirect_stdout(sys.stderr):
        main()
