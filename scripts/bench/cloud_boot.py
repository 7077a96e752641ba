"""Cloud boot bench: time from a join token to a serving replica, on a machine that boots with cloud-init.

EC2 is simulated; each RunInstances boots a minimal Debian in namespaces, behind a NAT, with systemd, the real
cloud-init and the user data of the provider. Packages of apt and wheels are on this host: nothing comes from a network.
The border runs all the time; on the robot's side no command runs. Stages follow one another, and their sum is the
whole.

    sudo .venv/bin/python scripts/bench/cloud_boot.py               # writes docs/benchmarks/cloud_boot.json
    sudo .venv/bin/python scripts/bench/cloud_boot.py --rounds 1 --no-save
"""

from __future__ import annotations

import json
import logging
import os
import tempfile
import time
from collections.abc import Mapping
from contextlib import ExitStack
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Final

from report import Rounds, progress
from skeleton import Options, Outcome, command_line, run_bench

from fog.supervisor.core.record import Record
from gdp.enrolment.registry import Registry
from lab.cloud_site import CloudSite, launch_file, start_echo, wheelhouse
from lab.debian import BootedMachine, debian_root, why_not
from lab.namespaces import Space
from lab.process import FailedError, new_run

if TYPE_CHECKING:
    from lab.ec2 import DataCenter

REGION: Final = "us-west-1"
CLUSTER: Final = "echo"
TARGET_S: Final = 40.0
WAIT_S: Final = 400.0
BASELINE: Final = "tokens and tunnels"
COLUMN: Final = "s"
WHOLE: Final = "whole: token to serving replica"
DOWN: Final = "fog down, until nothing is left"
STAGES: Final = (
    "request, systemd, until cloud-init begins",
    "cloud-init until software is fetched: network, apt, files",
    "wheels fetched",
    "wheels installed by pip",
    "joined: keys and memberships",
    "serving: tunnel, proxy, delegations, ROS node",
)


def measure(options: Options) -> Outcome:
    """Launch and end a cluster of one machine in each round, in one data centre."""
    if reason := why_not():
        raise FailedError(reason)
    over, image = Rounds(), debian_root()
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="gdp-cloud-boot-")))
        software = wheelhouse(folder / "wheels")
        run = stack.enter_context(new_run())
        stack.enter_context(Space()).ip("link", "set", "lo", "up")
        from lab.ec2 import DataCenter, serving_ec2  # moto, an extra

        logging.getLogger("werkzeug").setLevel(logging.WARNING)  # the simulation logs each request
        site = CloudSite(run, software, {REGION: f"udp://127.0.0.1:{start_echo(0.0)}"})
        center = DataCenter(run, image)
        stack.callback(site.close)
        stack.callback(center.close)
        stack.enter_context(serving_ec2(center, folder / "absent"))
        site.environment |= {name: value for name, value in os.environ.items() if name.startswith("AWS_")}
        site.start_border()
        stack.callback(site.run, "down", "--all")
        launch = launch_file(folder)
        for number in range(1, options.rounds + 1):
            site.run("launch", str(launch), "--detach", "--wait", str(WAIT_S))
            (record,) = site.serving(CLUSTER)
            stages = _stages(site, center, record)
            for stage, took_s in stages.items():
                over.add(BASELINE, stage, COLUMN, took_s)
            over.add(BASELINE, WHOLE, COLUMN, sum(stages.values()))
            progress(f"round {number}/{options.rounds}: {sum(stages.values()):.1f} s, {stages}")
            begun_s = time.monotonic()
            site.run("down", CLUSTER)
            over.add(BASELINE, DOWN, COLUMN, time.monotonic() - begun_s)
        targets = [over.target("token to serving replica, s", BASELINE, WHOLE, COLUMN, TARGET_S, at_most=True)]
    settings = {"commands on the robot's side": 0}
    return Outcome("cloud_boot", "From a token to a serving replica", over, targets, settings)


def _stages(site: CloudSite, center: DataCenter, record: Record) -> Mapping[str, float]:
    """Return the seconds of each stage; machine and border share the host's clock."""
    machine = center.machines[record.id.partition("/")[2]]
    with Registry(site.border / "enrolment") as registry:
        row = registry.machine_with(f"{CLUSTER}-{record.name}")
    if row is None or record.served_unix_s is None:
        raise FailedError(f"{record.name} has not joined")
    marks = [
        record.asked_unix_s,
        _cloud_init_unix_s(machine),
        _made_unix_s(machine, "opt/fog-software/manifest.json"),
        _made_unix_s(machine, "opt/fog-software/requirements.txt"),
        _made_unix_s(machine, "opt/fog/complete"),
        row.joined_unix_s,
        record.served_unix_s,
    ]
    return {stage: end - begin for stage, (begin, end) in zip(STAGES, pairwise(marks), strict=True)}


def _cloud_init_unix_s(machine: BootedMachine) -> float:
    """Return when the first stage of cloud-init began."""
    status = json.loads(machine.run("cat", "/run/cloud-init/status.json"))
    return float(status["v1"]["init-local"]["start"])


def _made_unix_s(machine: BootedMachine, path: str) -> float:
    return (machine.root / path).stat().st_mtime


if __name__ == "__main__":
    parser = command_line(__doc__, rounds=5, quick={"rounds": 1}, has_record=True)
    run_bench(parser, measure)
