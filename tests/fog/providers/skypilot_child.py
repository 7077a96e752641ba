"""Child process of ``test_skypilot``: SkyPilot's real package, without its API server.

The API server runs the functions that are called here; it starts dozens of processes, too many for a test.
Prints one line of JSON with the result of each step.
"""

from __future__ import annotations

import contextlib
import json
import sys
from collections.abc import Callable
from dataclasses import asdict, replace

import sky
from sky import check, core, execution

from fog.hardware import Hardware
from fog.machine import MachineBundle, MachineSpec, Program
from fog.offer import Offer
from fog.providers.skypilot.config import SkyPilotConfig
from fog.providers.skypilot.provider import SkyPilotProvider
from gdp.errors import GdpError


class Unserved:
    """``sky`` in which each request is done at once."""

    def __getattr__(self, name: str) -> object:
        return getattr(sky, name)

    def launch(self, task: object, cluster_name: str, dryrun: bool = False) -> object:
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


def main() -> None:
    enabled = check.check_capability(sky.clouds.CloudCapability.COMPUTE, quiet=True, clouds=["aws"])
    provider = SkyPilotProvider(SkyPilotConfig(), Unserved())  # type: ignore[arg-type]
    offers = provider.offers(Hardware.from_text("cpu:16"), spot=True)
    spec = MachineSpec("a-demo", "m1", offers[0])
    boot = MachineBundle({"own.key": b"\x00"}, (Program("switch", ("gdp-switch",)),))

    def dry_run(offer: Offer) -> str:
        return outcome(lambda: provider.dry_run(replace(spec, offer=offer), boot))

    reported = {
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
    sys.__stdout__.write(f"\n{json.dumps(reported)}\n")  # type: ignore[union-attr]


if __name__ == "__main__":
    with contextlib.redirect_stdout(sys.stderr):
        main()
