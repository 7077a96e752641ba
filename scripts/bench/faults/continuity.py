"""Which ends must be connected at each moment of a run, and how long its readers were silent then.

Sans-I/O. Moments are nanoseconds of one clock, that of the records.
"""

from __future__ import annotations

from faults.accounts import Books, Silence, Timeline
from faults.oracle import Broken, Oracle
from faults.plan import Plan


class Continuity:
    """Pairs of publisher and reader, with the times in which graph and policy connect them.

    Args:
        plan: the network.
        books: with the arrivals at each reader.
    """

    def __init__(self, plan: Plan, books: Books) -> None:
        self._plan, self._books, self._oracle = plan, books, Oracle(plan)
        self._must = {pair: Timeline() for pair in self._oracle.pairs()}

    def note(self, at_ns: int, broken: Broken) -> None:
        """Record what must be connected from now on."""
        for (_, publisher, reader), timeline in self._must.items():
            timeline.note(at_ns, connected=self._oracle.must_talk(publisher, reader, broken))

    def unreached(self) -> list[str]:
        """Return the flows, in words, of which nothing has come."""
        return [
            f"{self._plan.flows[channel].topic} at {reader}"
            for channel, _, reader in self._must
            if not self._books.arrivals_ns[channel, reader]
        ]

    def silences(self, begin_ns: int, end_ns: int, above_s: float) -> list[Silence]:
        """Return the longer silences of connected readers in a time."""
        return [
            silence
            for (channel, _, reader), must in self._must.items()
            for silence in self._books.silences(channel, reader, begin_ns, end_ns, must, above_s)
        ]

    def broken_promises(self, begin_ns: int, last_ns: int, end_ns: int, limit_s: float, well_s: float) -> list[str]:
        """Return in words the silences that are too long.

        Args:
            last_ns: end of the last fault.
            limit_s: longest silence before that.
            well_s: longest silence after it.
        """
        kinds = ("after the last fault", last_ns, end_ns, well_s), ("black hole", begin_ns, last_ns, limit_s)
        return [
            f"{kind}: {self._words(silence, begin_ns)}"
            for kind, from_ns, to_ns, most_s in kinds
            for silence in self.silences(from_ns, to_ns, most_s)
        ]

    def _words(self, silence: Silence, begin_ns: int) -> str:
        topic, at_s = self._plan.flows[silence.channel].topic, (silence.begin_ns - begin_ns) / 1e9
        return f"{topic} at {silence.reader}: {silence.seconds:.2f} s of silence from {at_s:.2f} s on"
