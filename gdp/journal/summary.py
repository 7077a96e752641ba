"""Summary of an incident for people: what came, went and was lost, by neighbour, kind and name, and when."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator
from datetime import datetime, timezone
from typing import Final

from gdp.frame.codec import CONTROL_FROM, DESTINATION_AT, HEADER_BYTES, KIND_AT, SOURCE_AT
from gdp.journal.incident import Incident, well_formed
from gdp.journal.replay import kind_of
from gdp.names import Name

_LINES: Final = 20  # of the timeline
_FRAMES: Final = ("in", "out", "bytes in", "bytes out")
_Row = dict[str, object]


def summary(incident: Incident) -> dict[str, list[_Row]]:
    """Return tables by their title. Raises ``LocalError``: the incident is of the wrong form."""
    with well_formed("head or an entry"):
        head, events = incident.head, list(_events(incident))
        begin_s, end_s = (events[0][0], events[-1][0]) if events else (head["begun"][0],) * 2
        step_s = (end_s - begin_s) / _LINES or 1.0
        tables: dict[str, defaultdict[str, Counter[str]]] = {
            title: defaultdict(Counter) for title in ("neighbour", "kind", "name", "second")
        }
        for at_s, what, port, mac, frame in events:
            places = {"second": f"{int((at_s - begin_s) / step_s) * step_s:.2f}"}
            if what in _FRAMES:
                places |= {"neighbour": f"{head['ports'].get(str(port), port)} {mac.hex(':')}", "kind": kind_of(frame)}
            if len(frame) >= HEADER_BYTES and frame[KIND_AT] < CONTROL_FROM:
                places["name"] = Name(frame[DESTINATION_AT:SOURCE_AT]).short
            for title, key in places.items():
                tables[title][key].update({what: 1, f"bytes {what}": len(frame)} if what in _FRAMES else {what: 1})
        about: _Row = {
            "node": head["label"],
            "from": datetime.fromtimestamp(begin_s - head["begun"][0] + head["begun"][1], timezone.utc).isoformat(),
            "seconds": round(end_s - begin_s, 3),
            "entries": len(incident.entries),
            "replay": head["unrepeatable"]
            or (f"{head['first']} entries before were lost" if head["first"] else "exact"),
        }
        drops: list[_Row] = [{"reason": reason, "dropped": count} for reason, count in head["drops"].items()]
        return {
            "incident": [about],
            "drops": drops,
            **{
                title: [{title: key, **dict.fromkeys(_FRAMES, 0), **found} for key, found in rows.items()]
                for title, rows in tables.items()
            },
        }


def _events(incident: Incident) -> Iterator[tuple[float, str, int, bytes, bytes]]:
    """Yield second, what happened (``in``, ``out`` or a call), port, neighbour's address, frame."""
    at_s = float(incident.head["begun"][0])
    for kind, *arguments in incident.entries:
        moments = [each[0] for each in arguments if isinstance(each, list) and len(each) == 2]
        at_s = float(arguments[0]) if kind == "send" else moments[-1] if moments else at_s
        if kind == "receive":
            for port, mac, frame, _ in arguments[0]:
                yield at_s, "in", port, mac, frame
        elif kind == "sent":
            yield at_s, "out", arguments[0], arguments[1], arguments[2]
        elif kind == "port_changed":
            yield at_s, "port up" if arguments[1] else "port down", 0, b"", b""
        elif kind in ("add_port", "revoke", "query_name", "raised", "diagnostics.ask"):
            yield at_s, kind, 0, b"", b""
