"""``FogCluster`` as an action of ROS 2's ``launch``: ``ros2 launch`` starts and ends the cluster.

I/O; imports ROS 2's ``launch``. Separate processes of the ``fog`` command operate the cluster.
Processes that follow the cluster in the description start when it serves: the launch configuration ``launch-prefix``
puts ``start_gate`` before their command line. A node with its own ``prefix`` does not wait.
A cluster that cannot start ends the launch like any failed action, with its reason and exit code 1. An exception in an
event handler has this effect; ``Shutdown(reason=...)`` has neither.
Actions of ``launch_ros`` describe a node only after substitutions are performed in a context. The adapter performs them
for a cloud node and never executes the node here.
Source: launch 3.4.3 and launch_ros 0.26 (jazzy): ``Action``, ``OnShutdown``, ``LaunchService.run_async``;
``descriptions/executable.py`` for the prefix, ``actions/group_action.py`` for scopes.
"""

from __future__ import annotations

import asyncio
import logging
import shlex
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

from launch import Action, Event, LaunchContext
from launch.actions import PopLaunchConfigurations, PushLaunchConfigurations
from launch.event_handler import BaseEventHandler
from launch.event_handlers import OnShutdown
from launch.utilities import normalize_to_list_of_substitutions, perform_substitutions
from launch_ros.actions import Node

from fog.cluster import CloudNode, ClusterPlan
from fog.launch import entity
from fog.launch.cloud_node import parameter_rule, parameters_in
from fog.launch.interface_discovery import offered
from fog.launch.start_gate import StartGate
from fog.launch.unreturned import watch_ros_launch
from gdp.errors import GdpError, LocalError
from gdp.host.run_registry import Run, RunRegistry

log = logging.getLogger(__name__)

_MADE: Final = "launch_params_"  # prefix of files that launch_ros creates for maps of parameters and does not delete
FOG: Final = (sys.executable, "-m", "fog.cli.app")
_PREFIX: Final = "launch-prefix"
_ERROR: Final = "error: "


class FogCluster(entity.FogCluster, Action):  # type: ignore[misc]  # launch has no types
    """Nodes on machines; see ``fog.launch.entity``."""

    _starting: asyncio.Task[None] | None = None
    _is_begun = False  # set when a cluster may exist that must be ended

    def __post_init__(self) -> None:
        """Make it an action; check and record the cluster."""
        Action.__init__(self)
        super().__post_init__()

    def execute(self, context: LaunchContext) -> None:
        """Start or join the cluster without waiting until it serves."""
        if self._starting is not None:
            return  # the description contains it twice
        nodes = tuple(cloud_node(node, context) for node in self.cloud_nodes)
        name = self.cluster_spec.plan(nodes).name
        for note in self.cluster_spec.notes:
            log.warning("cluster %s: %s", name, note)
        run = RunRegistry().start()
        gate = StartGate.closed(run.directory / "gate")
        _hold(context, shlex.join(gate.prefix()))
        context.register_event_handler(_Fails(lambda event: isinstance(event, _Failed) and event.cluster is self))
        self._starting = context.asyncio_loop.create_task(self._start(context, nodes, run.directory, gate))
        context.register_event_handler(OnShutdown(on_shutdown=lambda *_: _Ending(self, name, run, gate)))

    def get_asyncio_future(self) -> asyncio.Future[None] | None:
        """Return a future that is done when the cluster serves or has failed."""
        return self._starting

    async def end(self, name: str, run: Run, gate: StartGate) -> None:
        """Cancel the start, release waiting processes, and release the machines unless the cluster is kept."""
        if self._starting is not None:
            self._starting.cancel()
            await asyncio.wait([self._starting])
        gate.open(serving=False)
        if self._is_begun and not self.cluster_spec.keep:
            # In its own session: a second Ctrl-C must not leave machines running.
            process = await asyncio.create_subprocess_exec(*FOG, "down", name, "--if-up", start_new_session=True)
            if await process.wait():
                log.error("cluster not ended name=%s; try: fog down %s", name, name)
        run.end()

    async def _start(self, context: LaunchContext, nodes: tuple[CloudNode, ...], folder: Path, gate: StartGate) -> None:
        try:
            await self._begin(context, nodes, folder / "plan.json")
        except asyncio.CancelledError:
            log.info("start of a cluster broken off")  # only ``end`` cancels, so the cancellation is not propagated
        except GdpError as error:
            await context.emit_event(_Failed(self, str(error)))
        else:
            gate.open(serving=True)

    async def _begin(self, context: LaunchContext, nodes: tuple[CloudNode, ...], file: Path) -> None:
        """Start or join the cluster, and return when it serves."""
        plan = await self._plan(context, nodes)
        file.write_text(plan.to_json(), encoding="utf-8")
        ends = () if self.cluster_spec.keep else ("--ends-with", "this launch")
        self._is_begun = True
        process = await asyncio.create_subprocess_exec(
            *FOG, "launch", str(file), "--detach", *ends, stderr=asyncio.subprocess.PIPE
        )
        try:
            reason = await _reason(process)
            code = await process.wait()
        except asyncio.CancelledError:
            process.terminate()
            await process.wait()
            raise
        if code:
            raise LocalError(f"cluster {plan.name} did not start: {reason or f'exit code {code}'}")

    async def _plan(self, context: LaunchContext, nodes: tuple[CloudNode, ...]) -> ClusterPlan:
        if self.cluster_spec.carried is not None:
            return self.cluster_spec.plan(nodes)
        found = await context.asyncio_loop.run_in_executor(None, offered, nodes)
        return self.cluster_spec.plan(nodes, self.cluster_spec.carry(found))


class _Ending(Action):  # type: ignore[misc]  # launch has no types
    """Action that ends a cluster; the launch waits for it."""

    _ending: asyncio.Task[None] | None = None

    def __init__(self, cluster: FogCluster, name: str, run: Run, gate: StartGate) -> None:
        super().__init__()
        self._cluster, self._name, self._run, self._gate = cluster, name, run, gate

    def execute(self, context: LaunchContext) -> None:
        ending = self._cluster.end(self._name, self._run, self._gate)
        self._ending = context.asyncio_loop.create_task(ending)

    def get_asyncio_future(self) -> asyncio.Future[None] | None:
        return self._ending


class _Failed(Event):  # type: ignore[misc]  # launch has no types
    """Event: a cluster does not serve."""

    name = "fog.launch.Failed"

    def __init__(self, cluster: FogCluster, reason: str) -> None:
        self.cluster, self.reason = cluster, reason


class _Fails(BaseEventHandler):  # type: ignore[misc]  # launch has no types
    """Event handler that ends the launch with the reason and exit code 1."""

    def __init__(self, matcher: Callable[[Event], bool]) -> None:
        super().__init__(matcher=matcher)

    def handle(self, event: _Failed, context: LaunchContext) -> None:
        super().handle(event, context)
        raise LocalError(event.reason)


def _hold(context: LaunchContext, words: str) -> None:
    """Prefix every process started from now on with words, in this scope and its enclosing scopes."""
    scopes: list[dict[str, str]] = []
    while True:
        here = context.launch_configurations
        here[_PREFIX] = f"{words} {here.get(_PREFIX, '')}".strip()
        scopes.append(dict(here))
        try:
            PopLaunchConfigurations().execute(context)
        except RuntimeError:  # this is the outermost scope
            break
    for scope in reversed(scopes[:-1]):
        PushLaunchConfigurations().execute(context)
        context.launch_configurations.clear()
        context.launch_configurations.update(scope)


async def _reason(process: asyncio.subprocess.Process) -> str:
    """Forward the standard error of a ``fog`` command; return its last error."""
    reason = ""
    assert process.stderr is not None
    while line := await process.stderr.readline():
        text = line.decode(errors="replace")
        if text.startswith(_ERROR):
            reason = text.removeprefix(_ERROR).strip()
        else:
            sys.stderr.write(text)
    return reason


watch_ros_launch()


def cloud_node(node: object, context: LaunchContext) -> CloudNode:
    """Return a node with all substitutions performed."""
    if not isinstance(node, Node) or node.node_package is None:
        raise LocalError(f"cloud_nodes: expected launch_ros.actions.Node with a package, not {type(node).__name__}")
    node._perform_substitutions(context)
    name = str(node.node_name).rpartition("/")[2]
    namespace = str(node.expanded_node_namespace or "")
    context.extend_locals({"ros_specific_arguments": {"name": f"__node:={name}", "ns": f"__ns:={namespace}"}})
    # The first word is the executable; this machine need not have its package.
    words = [str(perform_substitutions(context, word)) for word in node.cmd[1:]]
    package, executable = (
        str(perform_substitutions(context, normalize_to_list_of_substitutions(said)))
        for said in (node.node_package, node.node_executable)
    )
    environment = {
        str(perform_substitutions(context, key)): str(perform_substitutions(context, value))
        for key, value in node.additional_env or ()
    }
    is_named = not name.startswith("<") and not namespace.startswith("<")
    arguments = _without_files(words, name if is_named else None, namespace if is_named else None)
    return CloudNode(package, executable, tuple(arguments), environment)


def _without_files(words: Sequence[str], name: str | None, namespace: str | None) -> list[str]:
    kept: list[str] = []
    rest = iter(words)
    for word in rest:
        if word == "--params-file":
            path = Path(next(rest))
            is_made = path.name.startswith(_MADE) and path.parent == Path(tempfile.gettempdir())
            kept += parameters_in(path, name, namespace, has_tuples=is_made)
            if is_made:
                path.unlink()
        elif word == "-p":
            kept += [word, parameter_rule(next(rest))]
        else:
            kept.append(word)
    return [] if kept == ["--ros-args"] else kept
