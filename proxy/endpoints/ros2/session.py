"""Session: one node in one ROS 2 domain, and typed protocols of the used part of rclpy.

I/O; the only module here that starts rclpy. rclpy's executors take 100 µs and more a callback, and its experimental
``EventsExecutor`` delivered nothing to raw subscriptions when tried (7.1.6). So this package uses the handles of its
publishers and subscriptions directly, as its executors do.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Final, NamedTuple, Protocol, cast

from gdp.errors import LocalError
from proxy.endpoints.core.endpoint import Role
from proxy.endpoints.ros2.qos import service_profile, to_profile
from proxy.endpoints.ros2.types import class_of
from proxy.serial.channel import Qos

if TYPE_CHECKING:
    from rclpy.qos import QoSProfile


_REFUSED: Final = {
    Role.PUBLISHES: "cannot be advertised",
    Role.SUBSCRIBES: "cannot be subscribed to",
    Role.SERVES: "cannot be served",
    Role.CALLS: "cannot be dialled",
}


class Handle(Protocol):
    """An rcl object; it is valid at least while entered."""

    pointer: int

    def __enter__(self) -> object: ...
    def __exit__(self, kind: object, error: object, trace: object) -> None: ...


class GuardCondition(Handle, Protocol):
    """Wake-up source of a wait set."""

    def trigger_guard_condition(self) -> None:
        """Wake the wait set."""

    def destroy_when_not_in_use(self) -> None:
        """Free the object after its last use."""


class SubscriptionHandle(Handle, Protocol):
    """A subscription of rcl."""

    def take_message(self, kind: type, raw: bool, /) -> tuple[bytes, object] | None:
        """Return a message and its metadata; None: there is none."""


class PublisherHandle(Handle, Protocol):
    """A publisher of rcl."""

    def publish_raw(self, raw: bytes, /) -> None:
        """Publish CDR bytes."""

    def get_subscription_count(self) -> int:
        """Return the number of matched subscriptions."""


class RequestId(Protocol):
    """Identity of a request within its client."""

    sequence_number: int


class RequestInfo(Protocol):
    """Metadata of a request or a response."""

    request_id: RequestId


class ServiceHandle(Handle, Protocol):
    """A server of rcl."""

    def service_take_request(self, kind: type, /) -> tuple[object, RequestInfo] | tuple[None, None]:
        """Return a request and its metadata; None, None: there is none."""

    def service_send_response(self, response: object, request: RequestId, /) -> None:
        """Send a response."""


class ClientHandle(Handle, Protocol):
    """A client of rcl."""

    def send_request(self, request: object, /) -> int:
        """Send a request; return its sequence number."""

    def take_response(self, kind: type, /) -> tuple[RequestInfo | None, object]:
        """Return metadata and response; metadata None: there is none."""

    def service_server_is_available(self) -> bool:
        """Return whether a server matches the client."""


class ServiceType(Protocol):
    """The generated class of a service."""

    Request: type
    Response: type


class WaitSet(Handle, Protocol):
    """Wait set of rcl; every wait empties it."""

    def clear_entities(self) -> None:
        """Remove all entities."""

    def add_guard_condition(self, guard: GuardCondition, /) -> int:
        """Add a guard condition; return its index."""

    def add_subscription(self, subscription: SubscriptionHandle, /) -> int:
        """Add a subscription; return its index."""

    def add_service(self, service: ServiceHandle, /) -> int:
        """Add a server; return its index."""

    def add_client(self, client: ClientHandle, /) -> int:
        """Add a client; return its index."""

    def wait(self, timeout_ns: int, /) -> None:
        """Block until an entity is ready, at most ``timeout_ns`` nanoseconds."""

    def get_ready_entities(self, kind: str, /) -> list[int]:
        """Return the pointers of the ready entities of one kind."""

    def destroy_when_not_in_use(self) -> None:
        """Free the object after its last use."""


class Entity(Protocol):
    """rclpy's object around a handle."""

    handle: object


class TopicEnd(Protocol):
    """A publisher or subscription in the graph."""

    node_name: str
    node_namespace: str
    topic_type: str
    endpoint_gid: Sequence[int]
    qos_profile: QoSProfile


class NodeHandle(Handle, Protocol):
    """A node of rcl."""

    def get_count_publishers(self, topic: str, /) -> int:
        """Return the number of a topic's publishers."""

    def get_count_subscribers(self, topic: str, /) -> int:
        """Return the number of a topic's subscriptions."""


class Node(Protocol):
    """rclpy's node."""

    handle: NodeHandle

    @property
    def publishers(self) -> Iterator[Entity]:
        """Return the node's publishers."""

    def get_name(self) -> str:
        """Return the name without its namespace."""

    def get_namespace(self) -> str:
        """Return the namespace."""

    def get_topic_names_and_types(self, no_demangle: bool = ...) -> list[tuple[str, list[str]]]:
        """Return the graph's topics, each with its types."""

    def get_service_names_and_types(self) -> list[tuple[str, list[str]]]:
        """Return the graph's services, each with its types."""

    def get_node_names_and_namespaces(self) -> list[tuple[str, str]]:
        """Return the graph's nodes."""

    def get_publishers_info_by_topic(self, topic: str) -> list[TopicEnd]:
        """Return a topic's publishers."""

    def get_subscriptions_info_by_topic(self, topic: str) -> list[TopicEnd]:
        """Return a topic's subscriptions."""

    def get_service_names_and_types_by_node(self, node: str, space: str) -> list[tuple[str, list[str]]]:
        """Return a node's services, each with its types."""

    def get_client_names_and_types_by_node(self, node: str, space: str) -> list[tuple[str, list[str]]]:
        """Return the services of a node's clients, each with its types."""

    def create_publisher(self, kind: type, topic: str, qos: object, *, event_callbacks: object) -> Entity:
        """Create a publisher."""

    def create_subscription(
        self, kind: type, topic: str, callback: object, qos: object, *, callback_group: object, raw: bool,
        event_callbacks: object,
    ) -> Entity:  # fmt: skip
        """Create a subscription; ``raw``: its messages are CDR bytes."""

    def create_service(
        self, kind: type, name: str, callback: object, *, qos_profile: object, callback_group: object
    ) -> Entity:
        """Create a server."""

    def create_client(self, kind: type, name: str, *, qos_profile: object, callback_group: object) -> Entity:
        """Create a client."""

    def destroy_publisher(self, entity: Entity) -> bool:
        """Free a publisher."""

    def destroy_subscription(self, entity: Entity) -> bool:
        """Free a subscription."""

    def destroy_service(self, entity: Entity) -> bool:
        """Free a server."""

    def destroy_client(self, entity: Entity) -> bool:
        """Free a client."""

    def destroy_node(self) -> None:
        """Leave the graph and free the node."""


class Opened(NamedTuple):
    """An entity of the endpoint, and the node that owns it."""

    role: Role
    home: Node
    name: str
    type_name: str
    qos: Qos
    entity: Entity


class _Context(Protocol):
    handle: Handle

    def try_shutdown(self) -> None: ...
    def destroy(self) -> None: ...


@dataclass(frozen=True, slots=True)
class ContextNode:
    """A node in a separate context; further nodes may join it.

    Attributes:
        own: name and namespace of each node here.
    """

    node: Node
    context: _Context
    rcl: ModuleType
    own: set[tuple[str, str]] = field(default_factory=set)

    def guard(self) -> GuardCondition:
        """Return a new guard condition."""
        with self.context.handle:
            return cast("GuardCondition", self.rcl.GuardCondition(self.context.handle))

    def wait_set(self, subscriptions: int, services: int, clients: int) -> WaitSet:
        """Return a wait set for one guard condition and these numbers of entities."""
        with self.context.handle:
            return cast("WaitSet", self.rcl.WaitSet(subscriptions, 1, 0, clients, services, 0, self.context.handle))

    def create(self, role: Role, home: Node, name: str, type_name: str, qos: Qos) -> Opened:
        """Create an entity of a node; services have the default profile of services.

        Raises:
            LocalError: the type is not installed, or the name is refused.
        """
        kind = class_of(type_name)
        with translated(f"{name}: {_REFUSED[role]}"):
            if role is Role.PUBLISHES:
                entity = home.create_publisher(kind, name, to_profile(qos), event_callbacks=_silence(role))
            elif role is Role.SUBSCRIBES:
                entity = home.create_subscription(
                    kind,
                    name,
                    _ignore,
                    to_profile(qos),
                    callback_group=_group(),
                    raw=True,
                    event_callbacks=_silence(role),
                )
            elif role is Role.SERVES:
                entity = home.create_service(
                    kind, name, _ignore, qos_profile=service_profile(), callback_group=_group()
                )
            else:
                entity = home.create_client(kind, name, qos_profile=service_profile(), callback_group=_group())
        return Opened(role, home, name, type_name, qos, entity)

    def destroy(self, opened: Opened) -> None:
        """Free an entity."""
        home, entity = opened.home, opened.entity
        if opened.role is Role.PUBLISHES:
            home.destroy_publisher(entity)
        elif opened.role is Role.SUBSCRIBES:
            home.destroy_subscription(entity)
        elif opened.role is Role.SERVES:
            home.destroy_service(entity)
        else:
            home.destroy_client(entity)

    def create_node(self, full_name: str) -> Node:
        """Create a further node, without anything.

        Raises:
            LocalError: the name is refused.
        """
        space, _, name = full_name.rpartition("/")
        self.own.add((name, space or "/"))
        with translated(f"{full_name}: cannot be a node"):
            node = _bare_node(name, space, self.context)
        for publisher in list(node.publishers):  # of parameters' events
            node.destroy_publisher(publisher)
        return node

    def destroy_node(self, full_name: str, node: Node) -> None:
        """Free a further node."""
        space, _, name = full_name.rpartition("/")
        node.destroy_node()
        self.own.discard((name, space or "/"))

    def close(self) -> None:
        """Leave the graph."""
        self.node.destroy_node()
        self.context.try_shutdown()
        self.context.destroy()


def open_session(domain: int, name: str) -> ContextNode:
    """Join a domain as a node without parameters, log topic or type service."""
    _check_rmw()
    try:
        import rclpy
        from rclpy.context import Context
        from rclpy.impl.implementation_singleton import rclpy_implementation
        from rclpy.signals import SignalHandlerOptions
    except ImportError as error:
        raise LocalError(
            "rclpy cannot be imported: source your ROS 2 (. /opt/ros/<distribution>/setup.sh), "
            f"or pip install 'gdp-ros[ros2]' ({_first_line(error)})"
        ) from error
    try:
        context = Context()
        rclpy.init(args=[], context=context, domain_id=domain, signal_handler_options=SignalHandlerOptions.NO)
        node = _bare_node(name, "", cast("_Context", context))
    except (RuntimeError, OSError, ImportError) as error:  # rclpy's own errors are RuntimeErrors
        raise LocalError(
            f"ROS 2 does not start in domain {domain}: {_first_line(error)}; is the RMW library installed that "
            "RMW_IMPLEMENTATION names? (pip install 'gdp-ros[ros2]' brings rmw_fastrtps_cpp)"
        ) from error
    own = {(node.get_name(), node.get_namespace())}
    return ContextNode(node, cast("_Context", context), cast("ModuleType", rclpy_implementation), own)


def _bare_node(name: str, space: str, context: _Context) -> Node:
    import rclpy
    from rclpy.parameter import Parameter

    node = rclpy.create_node(
        name,
        namespace=space,
        context=context,
        enable_rosout=False,
        start_parameter_services=False,
        use_global_arguments=False,
        parameter_overrides=[Parameter("start_type_description_service", value=False)],
    )
    return cast("Node", node)


def _group() -> object:
    """Return a callback group for one entity: a node's default group would keep every entity for ever."""
    from rclpy.callback_groups import ReentrantCallbackGroup

    return ReentrantCallbackGroup()


def _silence(role: Role) -> object:
    """Return event callbacks that do nothing; incompatible QoS is detected in the graph instead."""
    try:
        from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
    except ImportError:  # before Iron
        from rclpy.qos_event import PublisherEventCallbacks, SubscriptionEventCallbacks
    kind = PublisherEventCallbacks if role is Role.PUBLISHES else SubscriptionEventCallbacks
    return cast("object", kind(use_default_callbacks=False))


def _ignore(*_: object) -> None:
    """Ignore a callback that rclpy requires; the wait-set thread reads data before any callback could run."""


def _check_rmw() -> None:
    """Refuse an RMW that is not installed: rcl would end the process with exit status 102."""
    wanted = os.environ.get("RMW_IMPLEMENTATION", "")
    prefixes = [*os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep), sys.prefix]
    folders = [*os.environ.get("LD_LIBRARY_PATH", "").split(os.pathsep), *(f"{prefix}/lib" for prefix in prefixes)]
    libraries = {path.stem[3:] for folder in folders if folder for path in Path(folder).glob("librmw_*.so")}
    known = sorted(name for name in libraries if not re.search(r"__|_shared_|_common|_implementation", name))
    if wanted and known and wanted not in known:
        raise LocalError(
            f"RMW_IMPLEMENTATION names {wanted}, but this machine has only {', '.join(known)}: "
            f"install ros-<distribution>-{wanted.replace('_', '-')}, or unset it"
        )


@contextmanager
def translated(what: str) -> Iterator[None]:
    """Translate rclpy's error for a refused name, type or profile into a LocalError."""
    from rclpy.exceptions import NameValidationException, NoTypeSupportImportedException

    try:
        yield
    except (RuntimeError, ValueError, NameValidationException, NoTypeSupportImportedException) as error:
        raise LocalError(f"{what}: {_first_line(error)}") from error


def _first_line(error: BaseException) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:200]
