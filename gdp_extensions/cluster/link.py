"""Cluster link: connections to the primaries of a Valkey or Redis Cluster, the map of slots, batches, notifications.

I/O; blocking, with short time limits. After a failure of a primary, the link does not use it for a moment. It reads the
map of slots again from the other servers, and so finds the replica after its promotion.
"""

from __future__ import annotations

import select
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from typing import Final

from redis import Redis
from redis.backoff import NoBackoff
from redis.client import PubSub
from redis.crc import key_slot
from redis.exceptions import (
    AskError,
    ClusterDownError,
    MasterDownError,
    MovedError,
    ReadOnlyError,
    RedisError,
    ResponseError,
    TryAgainError,
)
from redis.retry import Retry

from gdp.config.config import ClusterConfig
from gdp.errors import LocalError, StoreError
from gdp.host_port import split_host_port
from gdp.intervals import PACE_S, PROMPT_S, UPKEEP_S
from gdp.names import Name

_ALPHABET: Final = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789-_"
CHANNELS: Final = tuple(b"{%c}" % char for char in _ALPHABET)  # hash tags: names share 64 slots, and one channel each
_REPLICA_MS: Final = 100  # a replica confirms within about a millisecond
_ELSEWHERE: Final = (AskError, ClusterDownError, MasterDownError, MovedError, ReadOnlyError, TryAgainError)
_NO_REPLICAS: Final = "NOREPLICAS"

Address = tuple[str, int]
Command = tuple[bytes | str | int, ...]  # the second item is the key that decides the slot


def tag_of(name: Name) -> bytes:
    """Return the hash tag, and channel, of a name."""
    return CHANNELS[name[0] & 63]


class ClusterLink:
    """Blocking access to the primaries.

    Raises:
        LocalError: no server is reachable at the start, or the servers are no cluster.
    """

    def __init__(self, config: ClusterConfig) -> None:
        self._config = config
        self._password = config.password()
        self._nodes: tuple[Address, ...] = tuple(map(split_host_port, config.nodes))
        self._clients: dict[Address, Redis] = {}
        self._primaries: dict[bytes, Address] = {}  # by hash tag
        self._refreshed_s = float("-inf")
        self._listening: dict[Address, PubSub] = {}
        self._readable = select.epoll()
        self._pinged_s = 0.0
        self._alone_until_s: dict[Address, float] = {}
        self.failures = 0
        try:
            self._refresh()
        except StoreError as error:
            raise LocalError(f"the cluster cannot be reached: {error}") from error

    def fileno(self) -> int:
        """Return a descriptor that is readable while notifications wait."""
        return self._readable.fileno()

    def primaries(self) -> list[Redis]:
        """Return a client of each primary."""
        return [self._client(at) for at in dict.fromkeys(self._primaries.values())]

    def primary_of(self, name: Name) -> Address:
        """Return host and port of the primary that holds a name."""
        return self._primaries[tag_of(name)]

    def ask_primaries(self, command: Command) -> list[object]:
        """Send a command to each primary and return the replies.

        A ``StoreError`` takes the place of the reply of a server that did not respond or is no longer a primary.
        """
        replies = [reply for at in dict.fromkeys(self._primaries.values()) for reply in self._batch(at, [command])]
        if any(isinstance(reply, StoreError) for reply in replies):
            self._try_refresh()
        return replies

    def execute(self, commands: Sequence[tuple[bytes, Command]], *, writes: bool = False) -> list[object]:
        """Send commands, each with the hash tag of its keys, in one batch for each primary.

        Args:
            writes: wait until a replica of each primary has the writes, so that they outlive the primary. If no replica
                confirms in time, the primary alone has them.

        Returns the replies in order; a ``StoreError`` takes the place of a missing one.
        """
        replies: list[object] = [StoreError("not sent")] * len(commands)
        batch = self._batch_of_writes if writes else self._batch
        for _attempt in range(2):
            open_ = [index for index, reply in enumerate(replies) if isinstance(reply, StoreError)]
            if not open_:
                break
            if _attempt and not self._try_refresh():
                break
            by_primary: dict[Address, list[int]] = defaultdict(list)
            for index in open_:
                by_primary[self._primaries[commands[index][0]]].append(index)
            for at, indices in by_primary.items():
                for index, reply in zip(indices, batch(at, [commands[i][1] for i in indices]), strict=True):
                    replies[index] = reply
        return replies

    def listen(self) -> bool:
        """Subscribe to every channel; return whether the subscription is new, so that changes may have been missed."""
        wanted = set(self._primaries.values())
        if wanted == self._listening.keys():
            return False
        self._stop_listening()
        try:
            for at in wanted:
                subscription = self._client(at).pubsub()
                self._listening[at] = subscription
                for channel in (each for each in CHANNELS if self._primaries[each] == at):
                    subscription.ssubscribe(channel)
                assert subscription.connection is not None
                self._readable.register(subscription.connection._sock, select.EPOLLIN)
        except RedisError:
            self._failed()
            return False
        return True

    def notifications(self) -> Iterator[bytes]:
        """Yield the messages of the channels; if a connection fails, the next ``listen`` makes all of them again."""
        for subscription in list(self._listening.values()):
            try:
                while (message := subscription.get_message(timeout=0)) is not None:
                    if message["type"] == "smessage":
                        yield message["data"]
                    elif message["type"] == "sunsubscribe":  # the slot has moved
                        raise RedisError("unsubscribed")
            except (RedisError, OSError):
                self._failed()
                return

    def keep_alive(self, now_s: float) -> None:
        """Send a ping, if it is due, on the connections that only listen."""
        if now_s - self._pinged_s < UPKEEP_S:
            return
        self._pinged_s = now_s
        try:
            for subscription in self._listening.values():
                subscription.ping()
        except (RedisError, OSError):
            self._failed()
        if not self._listening:
            self._try_refresh()

    def close(self) -> None:
        """Close every connection."""
        self._stop_listening()
        self._readable.close()
        for client in self._clients.values():
            client.close()
        self._clients.clear()

    def _batch(self, at: Address, commands: list[Command]) -> list[object]:
        pipeline = self._client(at).pipeline(transaction=False)
        for command in commands:
            pipeline.execute_command(*command)
        try:
            replies: list[object] = pipeline.execute(raise_on_error=False)
        except (RedisError, OSError) as error:
            self.failures += 1
            return [StoreError(str(error))] * len(commands)
        return [_translated(reply) for reply in replies]

    def _batch_of_writes(self, at: Address, commands: list[Command]) -> list[object]:
        if time.monotonic() < self._alone_until_s.get(at, 0.0):
            return self._batch(at, commands)
        *replies, replicas = self._batch(at, [*commands, (b"WAIT", 1, _REPLICA_MS)])
        if replicas == 0:
            self._alone_until_s[at] = time.monotonic() + UPKEEP_S  # do not wait for a missing replica
        return replies

    def _client(self, at: Address) -> Redis:
        client = self._clients.get(at)
        if client is None:
            its = self._config
            client = self._clients[at] = Redis(
                host=at[0],
                port=at[1],
                username=its.username or None,
                password=self._password or None,
                socket_timeout=PROMPT_S,
                socket_connect_timeout=PROMPT_S,
                retry=Retry(NoBackoff(), 0),
                ssl=its.ca is not None,
                ssl_ca_certs=None if its.ca is None else str(its.ca),
                ssl_certfile=None if its.cert is None else str(its.cert),
                ssl_keyfile=None if its.key is None else str(its.key),
            )
        return client

    def _try_refresh(self) -> bool:
        try:
            self._refresh()
        except StoreError:
            return False
        return True

    def _refresh(self) -> None:
        """Read the map of slots from the first server that has one. Raises ``StoreError``: no server has one."""
        if time.monotonic() - self._refreshed_s < PACE_S:
            raise StoreError("read the map of slots a moment ago")
        reason = "no server is configured"
        for at in dict.fromkeys([*self._primaries.values(), *self._nodes]):
            try:
                shards = self._client(at).execute_command("CLUSTER SLOTS")
            except (RedisError, OSError) as error:
                reason = f"{at[0]}:{at[1]}: {error}"
                continue
            primaries = dict(_primaries(shards))
            if len(primaries) == len(CHANNELS):
                self._primaries = primaries
                self._refreshed_s = time.monotonic()
                return
            reason = f"{at[0]}:{at[1]}: not every slot is served"
        self._refreshed_s = time.monotonic()
        raise StoreError(reason)

    def _failed(self) -> None:
        self.failures += 1
        self._stop_listening()
        self._try_refresh()

    def _stop_listening(self) -> None:
        for subscription in self._listening.values():
            subscription.close()
        self._listening.clear()


def _primaries(shards: Sequence[Sequence[object]]) -> Iterator[tuple[bytes, Address]]:
    slots = {key_slot(tag): tag for tag in CHANNELS}
    for shard in shards:
        first, last, primary = int(str(shard[0])), int(str(shard[1])), shard[2]
        assert isinstance(primary, list)
        host, port = primary[0], int(primary[1])
        at = (host.decode() if isinstance(host, bytes) else str(host), port)
        yield from ((tag, at) for slot, tag in slots.items() if first <= slot <= last)


def _translated(reply: object) -> object:
    """Return a reply; a reply that means "not here, not now" becomes a ``StoreError``.

    The library has classes for most of these, and removes the server's error word from the text.
    """
    is_temporary = isinstance(reply, _ELSEWHERE) or str(reply).startswith(_NO_REPLICAS)
    if isinstance(reply, ResponseError) and not is_temporary:
        return LocalError(str(reply))
    return StoreError(str(reply)) if isinstance(reply, RedisError) else reply
