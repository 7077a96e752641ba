#!/usr/bin/env python3
"""Drawings of docs/images as SVG: trust chain, sealing, name resolution, multicast tree, hedged call.

    scripts/drawings.py            # writes docs/images/*.svg
    scripts/drawings.py --check    # exits 1 where a committed file differs

Each drawing is a function of this file; the output depends on nothing else.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final
from xml.sax.saxutils import escape

IMAGES: Final = Path(__file__).resolve().parents[1] / "docs/images"
BLUE, PURPLE, GREEN, ORANGE, GREY = "#1971c2", "#6741d9", "#2f9e44", "#d9480f", "#7d8793"
INK, SOFT = "#1c2430", "#55606e"
_FILL: Final = {BLUE: "#e7f5ff", PURPLE: "#f3f0ff", GREEN: "#ebfbee", ORANGE: "#fff4e6", GREY: "#ffffff"}
_LINE_PX: Final = 16  # distance between the lines of a text


class Drawing:
    """An SVG picture under construction; all positions and sizes are in pixels."""

    def __init__(self, title: str, description: str, width: int, height: int) -> None:
        self._size = width, height
        self._head = f'  <title id="title">{escape(title)}</title>\n  <desc id="desc">{escape(description)}</desc>'
        self._parts: list[str] = []

    def box(self, x: int, y: int, width: int, height: int, text: Sequence[str], color: str = GREY) -> None:
        """Draw a box; the first line of its text is bold."""
        self._parts.append(
            f'<rect x="{x}" y="{y}" width="{width}" height="{height}" rx="8" fill="{_FILL[color]}"'
            f' stroke="{color}" stroke-width="1.8"/>'
        )
        top = y + (height - _LINE_PX * len(text)) // 2 + 12
        for number, line in enumerate(text):
            self.text(x + width // 2, top + number * _LINE_PX, line, bold=number == 0)

    def text(
        self, x: int, y: int, line: str, *, bold: bool = False, color: str = "", anchor: str = "middle", size: int = 0
    ) -> None:
        """Write one line; ``y`` is its base line."""
        size = size or (14 if bold else 12)
        weight = ' font-weight="600"' if bold else ""
        color = color or (INK if bold else SOFT)
        self._parts.append(
            f'<text x="{x}" y="{y}" font-size="{size}" fill="{color}" text-anchor="{anchor}"{weight}>'
            f"{escape(line)}</text>"
        )

    def arrow(self, points: Sequence[tuple[int, int]], color: str = SOFT, *, dashed: bool = False) -> None:
        """Draw an arrow along the points; the head stands at the last one."""
        path = "M " + " L ".join(f"{x} {y}" for x, y in points)
        dash = ' stroke-dasharray="6 5"' if dashed else ""
        self._parts.append(
            f'<path d="{path}" fill="none" stroke="{color}" stroke-width="2"{dash}'
            f' marker-end="url(#{_marker(color)})"/>'
        )

    def line(self, points: Sequence[tuple[int, int]], color: str = GREY, *, width: float = 1.5) -> None:
        """Draw a line without a head."""
        path = "M " + " L ".join(f"{x} {y}" for x, y in points)
        self._parts.append(f'<path d="{path}" fill="none" stroke="{color}" stroke-width="{width}"/>')

    def svg(self) -> str:
        """Return the file's text."""
        width, height = self._size
        colors = dict.fromkeys((SOFT, BLUE, PURPLE, GREEN, ORANGE, GREY))
        markers = "\n".join(
            f'    <marker id="{_marker(color)}" viewBox="0 0 10 10" refX="9" refY="5" markerWidth="7" markerHeight="7"'
            f' orient="auto"><path d="M 0 0 L 10 5 L 0 10 z" fill="{color}"/></marker>'
            for color in colors
        )
        parts = "\n".join(f"  {part}" for part in self._parts)
        return (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" height="{height}"'
            f' role="img"\n     aria-labelledby="title desc"'
            " font-family=\"Helvetica, Arial, 'DejaVu Sans', sans-serif\">\n"
            f"{self._head}\n  <defs>\n{markers}\n  </defs>\n"
            f'  <rect width="{width}" height="{height}" fill="#ffffff"/>\n{parts}\n</svg>\n'
        )


def _marker(color: str) -> str:
    return f"head-{color[1:]}"


def trust_chain() -> Drawing:
    """Return the two chains that meet in an advertisement."""
    drawing = Drawing(
        "Trust chain of an advertisement",
        "The owner's key signs a delegation to a node, the domain's root signs a membership of the same node, and the "
        "node signs the advertisement. Every RIB and reader verifies both chains.",
        900,
        330,
    )
    drawing.text(20, 30, "ownership: who may use the name", bold=True, color=ORANGE, anchor="start")
    drawing.text(20, 310, "membership: who is part of a trust domain", bold=True, color=BLUE, anchor="start")
    drawing.box(20, 50, 150, 62, ("owner's key", "stays on its machine"), ORANGE)
    drawing.box(255, 50, 165, 62, ("AdCert", "right, name, node, end", "at most 4 in a chain"), ORANGE)
    drawing.box(20, 220, 150, 62, ("domain's root key", "X.509, ECDSA P-256"), BLUE)
    drawing.box(255, 220, 165, 62, ("membership", "role, node's name, end"), BLUE)
    drawing.box(470, 132, 140, 68, ("node", "its name is the", "hash of its key"), PURPLE)
    drawing.box(690, 132, 190, 68, ("advertisement", "name, right, sequence,", "incarnation, lease"), GREEN)
    drawing.box(690, 240, 190, 50, ("RtCert", "switch may attract traffic"), PURPLE)
    drawing.arrow([(170, 81), (255, 81)], ORANGE)
    drawing.text(212, 74, "signs")
    drawing.arrow([(170, 251), (255, 251)], BLUE)
    drawing.text(212, 244, "signs")
    drawing.arrow([(420, 81), (540, 81), (540, 132)], ORANGE)
    drawing.text(480, 74, "delegates to")
    drawing.arrow([(420, 251), (520, 251), (520, 200)], BLUE)
    drawing.text(468, 244, "admits")
    drawing.arrow([(610, 166), (690, 166)], PURPLE)
    drawing.text(650, 159, "signs")
    drawing.arrow([(560, 200), (560, 265), (690, 265)], PURPLE)
    drawing.text(630, 258, "signs")
    drawing.text(785, 62, "Each RIB and each reader", bold=True)
    drawing.text(785, 80, "verifies both chains itself")
    drawing.text(785, 96, "and trusts no relay.")
    drawing.arrow([(785, 104), (785, 132)], GREEN, dashed=True)
    return drawing


def message_sealing() -> Drawing:
    """Return how a message becomes sealed fragments."""
    drawing = Drawing(
        "Sealing of a message",
        "A message is serialised, split into fragments that fit the path, each fragment is encrypted, and the last "
        "one carries one signature over all ciphertext.",
        900,
        400,
    )
    drawing.text(20, 44, "1  serialise", bold=True, anchor="start")
    drawing.box(230, 20, 640, 40, ("message: JSON, CBOR or CDR",), BLUE)
    drawing.text(20, 124, "2  fragment", bold=True, anchor="start")
    drawing.text(20, 142, "to fit the smallest MTU", anchor="start")
    for number in range(3):
        x = 230 + number * 220
        drawing.arrow([(x + 100, 60), (x + 100, 100)], BLUE)
        drawing.box(x, 100, 200, 40, (f"fragment {number}",), BLUE)
        drawing.arrow([(x + 100, 140), (x + 100, 180)], PURPLE)
        drawing.box(x, 180, 62, 52, ("header", "96 B"), GREY)
        drawing.box(x + 62, 180, 138, 52, ("ciphertext", "and tag"), PURPLE)
    drawing.text(20, 200, "3  encrypt each", bold=True, anchor="start")
    drawing.text(20, 218, "XAES-256-GCM; the header", anchor="start")
    drawing.text(20, 234, "without hops left is AAD", anchor="start")
    for number in range(3):
        x = 230 + number * 220
        drawing.arrow([(x + 100, 232), (x + 100, 284)], GREEN)
    drawing.box(230, 284, 640, 36, ("SHA-256 over header fields and all ciphertext, in order",), GREEN)
    drawing.text(20, 306, "4  hash, sign once", bold=True, anchor="start")
    drawing.arrow([(550, 320), (550, 346)], GREEN)
    drawing.box(400, 346, 300, 40, ("ECDSA P-256 signature of the writer",), ORANGE)
    drawing.arrow([(700, 366), (884, 366), (884, 206), (870, 206)], ORANGE)
    drawing.text(20, 362, "key: topic secret of the epoch, kind,", anchor="start")
    drawing.text(20, 378, "source, incarnation, destination", anchor="start")
    drawing.text(792, 358, "in the last fragment")
    return drawing


def _sequence(drawing: Drawing, names: Sequence[tuple[str, int]], bottom: int) -> dict[str, int]:
    places = dict(names)
    for name, x in names:
        drawing.line([(x, 60), (x, bottom)])
        drawing.box(x - 65, 24, 130, 36, (name,), BLUE)
    return places


def _step(
    drawing: Drawing, ends: tuple[int, int], y: int, text: str, color: str = SOFT, *, dashed: bool = False
) -> None:
    drawing.text((ends[0] + ends[1]) // 2, y - 6, text)
    drawing.arrow([(ends[0], y), (ends[1], y)], color, dashed=dashed)


def name_resolution() -> Drawing:
    """Return what happens when a switch has no entry for a destination."""
    drawing = Drawing(
        "Name resolution on a miss",
        "A switch without an entry keeps the frame pending and asks its RIB, which asks the tier above. The response "
        "carries the advertisement, becomes a table entry with a lease, and the pending frame goes on.",
        900,
        470,
    )
    at = _sequence(
        drawing,
        [("client", 85), ("data plane", 265), ("switch core", 445), ("RIB", 625), ("RIB, tier above", 805)],
        450,
    )
    client, plane, core, rib, upstream = at.values()
    _step(drawing, (client, plane), 95, "frame for a name")
    _step(drawing, (plane, core), 130, "no entry: punt", ORANGE)
    drawing.box(core - 80, 144, 160, 38, ("pending frames", "bounded"), ORANGE)
    _step(drawing, (core, rib), 212, "query")
    _step(drawing, (rib, upstream), 246, "not known here: query")
    _step(drawing, (upstream, rib), 280, "advertisement", GREEN)
    _step(drawing, (rib, core), 314, "advertisement", GREEN)
    drawing.box(core - 80, 326, 160, 38, ("name cache", "verified, with a lease"), GREEN)
    _step(drawing, (core, plane), 394, "install entry", GREEN)
    _step(drawing, (core, plane), 428, "pending frame goes on", GREEN)
    unknown = (
        "no node advertises the name:",
        "a negative response, cached briefly;",
        "the frame is dropped and counted",
    )
    drawing.box(rib - 30, 374, 240, 66, unknown, GREY)
    return drawing


def multicast_tree() -> Drawing:
    """Return three stages of a reverse-path tree."""
    drawing = Drawing(
        "Growth of a multicast tree",
        "Each new reader's switch sends a join towards the publisher. A join ends at the first switch that is already "
        "in the tree, and a frame is copied only where branches part.",
        960,
        360,
    )
    titles = ("1  the first reader joins", "2  a second reader joins", "3  one copy on each link")
    for stage, title in enumerate(titles):
        x = 20 + stage * 316
        drawing.text(x, 30, title, bold=True, anchor="start")
        drawing.box(x + 95, 50, 100, 36, ("publisher",), ORANGE)
        switches = {"S1": (x + 145, 130), "S2": (x + 145, 200), "S3": (x + 70, 270), "S4": (x + 220, 270)}
        readers = {"reader A": (x + 70, 336), "reader B": (x + 220, 336)}
        tree = {0: ("S1", "S2", "S3"), 1: ("S1", "S2", "S3", "S4"), 2: ("S1", "S2", "S3", "S4")}[stage]
        drawing.line([(x + 145, 86), (x + 145, 182)])
        drawing.line([(x + 145, 200), (x + 70, 270), (x + 70, 320)])
        drawing.line([(x + 145, 200), (x + 220, 270), (x + 220, 320)])
        for name, (cx, cy) in switches.items():
            drawing.box(cx - 28, cy - 17, 56, 34, (name,), GREEN if name in tree else GREY)
        for number, (name, (cx, cy)) in enumerate(readers.items()):
            active = number == 0 or stage > 0
            drawing.box(cx - 45, cy - 15, 90, 30, (name,), BLUE if active else GREY)
        if stage == 0:
            drawing.arrow([(x + 28, 254), (x + 98, 190)], PURPLE)
            drawing.arrow([(x + 122, 182), (x + 122, 148)], PURPLE)
            drawing.arrow([(x + 122, 112), (x + 122, 88)], PURPLE)
            drawing.text(x + 40, 206, "JOIN", color=PURPLE)
        elif stage == 1:
            drawing.arrow([(x + 262, 254), (x + 192, 190)], PURPLE)
            drawing.text(x + 258, 206, "JOIN", color=PURPLE)
            drawing.text(x + 236, 158, "ends at S2:", color=PURPLE)
            drawing.text(x + 236, 174, "already in the tree", color=PURPLE)
        else:
            drawing.arrow([(x + 168, 88), (x + 168, 112)], ORANGE)
            drawing.arrow([(x + 168, 148), (x + 168, 182)], ORANGE)
            drawing.arrow([(x + 98, 208), (x + 46, 252)], ORANGE)
            drawing.arrow([(x + 192, 208), (x + 244, 252)], ORANGE)
            drawing.text(x + 236, 158, "S2 copies", color=ORANGE)
            drawing.text(x + 236, 174, "the frame", color=ORANGE)
    return drawing


def hedged_call() -> Drawing:
    """Return the course of a hedged call over time."""
    drawing = Drawing(
        "A hedged call",
        "The client's proxy asks the fastest replica. Without a response within the expected time it asks a second "
        "one. The first response ends the call, and the other replica gets a cancellation.",
        900,
        430,
    )
    at = _sequence(drawing, [("ROS client", 85), ("client's proxy", 310), ("replica A", 560), ("replica B", 800)], 410)
    client, proxy, first, second = at.values()
    _step(drawing, (client, proxy), 96, "request")
    _step(drawing, (proxy, first), 126, "request, copy 1")
    drawing.box(first - 50, 140, 100, 66, ("slow",), ORANGE)
    drawing.line([(proxy - 14, 126), (proxy - 24, 126), (proxy - 24, 236), (proxy - 14, 236)], ORANGE)
    drawing.text(proxy - 34, 168, "no response within the", anchor="end")
    drawing.text(proxy - 34, 184, "time that nearly all need,", anchor="end")
    drawing.text(proxy - 34, 200, "and budget is left", anchor="end")
    _step(drawing, (proxy, second), 240, "request, copy 2", PURPLE)
    drawing.box(second - 50, 250, 100, 36, ("fast",), GREEN)
    _step(drawing, (second, proxy), 316, "response of B: the first one wins", GREEN)
    _step(drawing, (proxy, client), 342, "response", GREEN)
    _step(drawing, (proxy, first), 368, "cancel", PURPLE, dashed=True)
    drawing.box(first - 110, 380, 220, 42, ("late response of A", "dropped as a duplicate"), GREY)
    return drawing


DRAWINGS: Final[dict[str, Callable[[], Drawing]]] = {
    "trust-chain": trust_chain,
    "message-sealing": message_sealing,
    "name-resolution": name_resolution,
    "multicast-tree": multicast_tree,
    "hedged-call": hedged_call,
}


def stale(folder: Path) -> list[Path]:
    """Return the files of a folder that differ from what this script draws."""
    paths = {folder / f"{name}.svg": draw().svg() for name, draw in DRAWINGS.items()}
    return [path for path, text in paths.items() if not path.is_file() or path.read_text() != text]


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the drawings, or with ``--check`` compare them; return the exit code."""
    parser = argparse.ArgumentParser(description="Write the drawings of docs/images.")
    parser.add_argument("--check", action="store_true", help="write nothing; exit 1 where a file differs")
    if parser.parse_args(arguments).check:
        old = stale(IMAGES)
        for path in old:
            print(f"{path}: differs from scripts/drawings.py (run scripts/drawings.py)", file=sys.stderr)
        return bool(old)
    for name, draw in DRAWINGS.items():
        (IMAGES / f"{name}.svg").write_text(draw().svg())
    return 0


if __name__ == "__main__":
    sys.exit(main())
