"""``FogCluster`` as an action of ROS 2's ``launch``: ``ros2 launch`` starts the cluster, and ends it.

Place: shell; imports ROS 2's ``launch``. The cluster itself is the ``fog`` command's business, in processes of its own.
Processes that come after the cluster in the description start when it serves: ``hold`` is put before them, through
the launch configuration ``launch-prefix``; a node with a ``prefix`` of its own is not held.
Source: launch 3.4 (jazzy): ``Action``, ``OnShutdown``, ``Shutdown``; ``descriptions/executable.py`` for the prefix.
"""

from __future__ import annotations

import asyncio
import logging
import shlex
import sys
from pathlib import Path
from typing import Final

from launch import Action, LaunchContext
from launch.event_handlers import OnShutdown
from launch.events import Shutdown

from fog.cluster import CloudNode, ClusterPlan
from fog.launch import entity
from fog.launch.hold import Gate
from fog.launch.probe import offered
from gdp.errors import GdpError
from gdp.testbed.runs import Run, Runs

__all__ = ["FogCluster"]

log = logging.getLogger(__name__)

FOG: Final = (sys.executable, "-m", "fog.cli.app")
_PREFIX: Final = "launch-prefix"


class FogCluster(entity.FogCluster, Action):  # type: ignore[misc]  # launch has no types
    """Nodes on machines; see ``fog.launch.entity``."""

    _starting: asyncio.Task[None] | None = None

    def execute(self, context: LaunchContext) -> None:
        """Start or join the cluster, without waiting for it.

        Raises:
            LocalError: a node cannot be what it says.
        """
        from fog.launch.real_node import cloud_node

        nodes = tuple(cloud_node(node, context) for node in self.cloud_nodes)
        name = self.wish.plan(nodes).name
        for note in self.wish.notes:
            log.warning("cluster %s: %s", name, note)
        run = Runs().start()
        gate = Gate.shut(run.directory / "gate")
        before = context.launch_configurations.get(_PREFIX, "")
        context.launch_configurations[_PREFIX] = f"{shlex.join(gate.prefix())} {before}".strip()
        self._starting = context.asyncio_loop.create_task(self._start(context, nodes, run.directory, gate))
        context.register_event_handler(OnShutdown(on_shutdown=lambda *_: _Ending(self, name, run, gate)))

    def get_asyncio_future(self) -> asyncio.Future[None] | None:
        """Return what is done when the cluster serves, or cannot."""
        return self._starting

    async def end(self, name: str, run: Run, gate: Gate) -> None:
        """Break off what is being started, let go of those who wait, and give the machines back unless kept."""
        if self._starting is not None:
            self._starting.cancel()
            await asyncio.wait([self._starting])
        gate.open(serving=False)
        if not self.wish.keep:
            # In a session of its own: a second Ctrl-C must not leave machines running.
            process = await asyncio.create_subprocess_exec(*FOG, "down", name, start_new_session=True)
            if await process.wait():
                log.error("cluster not ended name=%s; try: fog down %s", name, name)
        run.end()

    async def _start(self, context: LaunchContext, nodes: tuple[CloudNode, ...], folder: Path, gate: Gate) -> None:
        try:
            fault = await self._fault(context, nodes, folder / "plan.json")
        except asyncio.CancelledError:
            log.info("start of a cluster broken off")  # by ``end`` alone, so that it goes no further
            return
        if fault:
            await context.emit_event(Shutdown(reason=f"fog: {fault}"))
        else:
            gate.open(serving=True)

    async def _fault(self, context: LaunchContext, nodes: tuple[CloudNode, ...], file: Path) -> str:
        """Start or join the cluster; return why it does not serve, or nothing."""
        try:
            plan = await self._plan(context, nodes)
        except GdpError as error:
            return str(error)
        file.write_text(plan.to_json(), encoding="utf-8")
        ends = () if self.wish.keep else ("--ends-with", "this launch")
        process = await asyncio.create_subprocess_exec(*FOG, "launch", str(file), "--detach", *ends)
        try:
            code = await process.wait()
        except asyncio.CancelledError:
            process.terminate()
            await process.wait()
            raise
        return f"cluster {plan.name} did not start (exit {code})" if code else ""

    async def _plan(self, context: LaunchContext, nodes: tuple[CloudNode, ...]) -> ClusterPlan:
        if self.wish.carried is not None:
            return self.wish.plan(nodes)
        found = await context.asyncio_loop.run_in_executor(None, offered, nodes)
        return self.wish.plan(nodes, self.wish.carry(found))


class _Ending(Action):  # type: ignore[misc]  # launch has no types
    """The end of a cluster; the launch waits for it."""

    _ending: asyncio.Task[None] | None = None

    def __init__(self, cluster: FogCluster, name: str, run: Run, gate: Gate) -> None:
        super().__init__()
        self._cluster, self._name, self._run, self._gate = cluster, name, run, gate

    def execute(self, context: LaunchContext) -> None:
        ending = self._cluster.end(self._name, self._run, self._gate)
        self._ending = context.asyncio_loop.create_task(ending)

    def get_asyncio_future(self) -> asyncio.Future[None] | None:
        return self._ending
