"""Fields of captured frames as tshark shows them, and as the Scapy layers have them."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final
from xml.etree import ElementTree as ET

import pytest
from scapy.fields import FlagsField
from scapy.layers.l2 import Ether
from scapy.packet import NoPayload, Packet, Padding, Raw
from scapy.utils import PcapWriter

from gdp.frame.codec import HOPS_MASK, SECOND_PATH
from gdp.frame.layers import GDP, PAYLOADS, CborBytesField, HopsField, Statement
from gdp_extensions.dissector.dissector import dissector, prefix_of

needs_tshark: Final = pytest.mark.skipif(shutil.which("tshark") is None, reason="tshark is not installed")
Shown = dict[str, str | int]


def write_pcap(path: Path, frames: Iterable[bytes]) -> None:
    with PcapWriter(str(path), linktype=1, nano=True) as writer:
        writer.write_header(None)
        for frame in frames:
            writer.write_packet(frame, sec=1, usec=0)


def tshark(capture: Path, *arguments: str, folder: Path) -> str:
    """Run tshark with the dissector as its only plugin; return its output."""
    plugin = folder / "gdp.lua"
    plugin.write_text(dissector(), encoding="utf-8")
    command = ["tshark", "-r", str(capture), "-X", f"lua_script:{plugin}", *arguments]
    where = {**os.environ, "WIRESHARK_CONFIG_DIR": str(folder), "HOME": str(folder)}
    ended = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120, env=where)
    assert "Lua" not in ended.stderr, ended.stderr
    return ended.stdout


def shown_by_tshark(capture: Path, folder: Path) -> list[Shown]:
    """Return the fields of each frame with our EtherType, by filter name: bytes as hex digits, numbers, text."""
    text = tshark(capture, "-T", "pdml", folder=folder)
    assert "Lua Error" not in text
    assert "_ws.lua.error" not in text
    return [
        _fields(packet)
        for packet in ET.fromstring(text).iter("packet")
        if packet.find("proto[@name='gdp']") is not None
    ]


def _fields(packet: ET.Element) -> Shown:
    found: Shown = {}
    for field in packet.iter("field"):
        name, text = field.get("name", ""), field.get("show", "")
        if not name.startswith("gdp."):
            continue
        assert name not in found, name
        if name.rpartition(".")[2] in _BYTES:
            found[name] = field.get("value", "")
        elif name.endswith((".text", ".reason")):
            found[name] = text
        else:
            found[name] = int({"True": "1", "False": "0", "": "0"}.get(text, text), 0)
    return found


def shown_by_scapy(frame: bytes) -> Shown:
    """Return the same for one Ethernet frame, without what is said of malformed ones."""
    found: Shown = {}
    layer: Packet = Ether(frame).payload
    while not isinstance(layer, NoPayload):
        if isinstance(layer, Raw | Padding):
            name = "gdp.padding" if isinstance(layer, Padding) else "gdp.payload"
            found[name] = bytes(layer.load).hex()
        else:
            prefix = "gdp." if isinstance(layer, GDP) else f"gdp.{prefix_of(type(layer))}."
            for field in layer.fields_desc:
                _add(found, prefix + field.name, field, getattr(layer, field.name))
        layer = layer.payload
    return {name: value for name, value in found.items() if value != ""}


def _add(found: Shown, name: str, field: object, value: bytes | int) -> None:
    if isinstance(value, bytes):
        found[name] = value.hex()
        if isinstance(field, CborBytesField) and value:
            found[f"{name}.text"] = field.i2repr(None, value)
        return
    number = found[name] = int(value)
    if isinstance(field, FlagsField):
        found.update({f"{name}.{flag}": number >> bit & 1 for bit, flag in enumerate(field.names)})
    if isinstance(field, HopsField):
        found.update({f"{name}.left": number & HOPS_MASK, f"{name}.second_path": int(bool(number & SECOND_PATH))})


def _bytes_names() -> frozenset[str]:
    layers: Sequence[type[Packet]] = [GDP, Statement, *(layer for pair in PAYLOADS.values() for layer in pair)]
    fields = [(layer(), each.name) for layer in layers for each in layer.fields_desc]
    return frozenset(
        {name for layer, name in fields if isinstance(getattr(layer, name), bytes)} | {"payload", "padding"}
    )


_BYTES: Final = _bytes_names()


def assert_same(frames: Sequence[bytes], shown: Sequence[Shown]) -> None:
    """Compare every field of every frame."""
    assert len(shown) == len(frames)
    for frame, fields in zip(frames, shown, strict=True):
        fields_shown = {
            name: value for name, value in fields.items() if not name.startswith(("gdp.malformed", "gdp.cut"))
        }
        assert fields_shown == shown_by_scapy(frame), frame.hex()
