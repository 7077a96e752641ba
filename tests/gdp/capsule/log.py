"""A capsule in memory, with messages of one writer."""

from __future__ import annotations

from dataclasses import dataclass, field

from gdp.capsule.chain import Chain, ChainWriter
from gdp.capsule.record import RecordType
from gdp.crypto.keys import SigningKey
from gdp.names import Name
from tests.gdp.message.sealed import WRITER, seal

NAME = Name(b"c" * 32)
SECOND_NS = 1_000_000_000


@dataclass
class Log:
    """Records of a capsule, as its writer made them."""

    key: SigningKey = WRITER
    name: Name = NAME
    wires: list[bytes] = field(default_factory=list)
    writer: ChainWriter = field(init=False)
    messages: int = 0

    def __post_init__(self) -> None:
        self.writer = ChainWriter(Chain(self.name, self.key.public), self.key)
        self.wires.append(self.writer.checkpoint(0))

    def add(self, count: int, size: int = 20) -> Log:
        """Append messages, one each tenth of a second, with a checkpoint where one is due."""
        for _ in range(count):
            self.messages += 1
            number = self.messages
            time_ns = number * SECOND_NS // 10
            message = number.to_bytes(8, "big") + b"%d" % number + bytes(size)
            frames = seal(number, message, signer=self.key)
            self.wires.append(self.writer.append(RecordType.MESSAGE, time_ns, frames, number, 1))
            if self.writer.is_due(time_ns):
                self.wires.append(self.writer.checkpoint(time_ns))
        return self

    def closed(self) -> Log:
        """End with a checkpoint."""
        if self.writer.has_new:
            self.wires.append(self.writer.checkpoint(self.writer.chain.time_ns))
        return self
