"""Rate limit of a device: a token bucket at its egress, which control and urgent frames pass first.

I/O. Source: tc-tbf(8), tc-pfifo_fast(8); Linux, ``include/uapi/linux/pkt_sched.h``. Frames of all data planes pass the
egress queue of a tunnel's device, so the limit needs nothing of a data plane. Queues go with their device::

    tcmsg         family (1)  padding (3)  index (4)  handle (4)  parent (4)  info (4)
    tc_ratespec   cell log (1)  link layer (1)  overhead (2)  cell align (2)  minimum (2)  bytes per second (4)
    tc_tbf_qopt   rate, peak rate (12 each)  limit (4)  buffer (4)  mtu (4)
"""

from __future__ import annotations

import socket
import struct
from contextlib import closing
from typing import Final

from gdp.errors import LocalError
from gdp.ports.netlink import NUMBER, ROOT, TRAFFIC, Change, NetlinkSocket, RefusedError, Rtm, attribute
from gdp.ports.tunnel.devices import find_device, refusal_text, set_queue_length

_QUEUE_S: Final = 0.05  # ordinary frames that wait longer are dropped
_FRAME_BYTES: Final = 1_500
_BURST_S: Final = 0.02
_BURST_MIN_BYTES: Final = 16 << 10
_QUEUE_MIN_FRAMES: Final = 16
_RATE: Final = struct.Struct("=BBHhHI")
_KIND, _OPTIONS = 1, 2  # TCA_KIND, TCA_OPTIONS
_PARAMETERS, _BURST = 1, 6  # TCA_TBF_PARMS, TCA_TBF_BURST
_ETHERNET: Final = 1  # TC_LINKLAYER_ETHERNET
_BUCKET, _BUCKET_CLASS, _BANDS = 0x1_0000, 0x1_0001, 0x2_0000  # handles 1:, 1:1 and 2:


def limit_rate(ifname: str, bytes_per_s: int) -> None:
    """Limit what a device sends, Ethernet headers included; the limit before is replaced.

    Args:
        bytes_per_s: ``RELAY_RATE_MIN`` to ``RELAY_RATE_MAX``.

    Raises:
        LocalError: the device is missing, or the kernel refuses: it may lack the queueing discipline ``tbf``.
    """
    device = find_device(ifname)
    if device is None:
        raise LocalError(f"rate of {ifname}: no such device")
    frames = max(int(bytes_per_s * _QUEUE_S) // _FRAME_BYTES, _QUEUE_MIN_FRAMES)
    burst = max(int(bytes_per_s * _BURST_S), _BURST_MIN_BYTES)
    rate = _RATE.pack(0, _ETHERNET, 0, 0, 0, bytes_per_s)
    parameters = rate + bytes(_RATE.size) + NUMBER.pack(frames * _FRAME_BYTES) + bytes(2 * NUMBER.size)
    options = attribute(_PARAMETERS, parameters) + attribute(_BURST, NUMBER.pack(burst))
    with closing(NetlinkSocket()) as netlink:
        try:
            set_queue_length(device.ifindex, frames)
            for kind, handle, parent, facts in (
                (b"tbf\0", _BUCKET, ROOT, attribute(_OPTIONS, options)),
                (b"pfifo_fast\0", _BANDS, _BUCKET_CLASS, b""),
            ):
                body = TRAFFIC.pack(socket.AF_UNSPEC, device.ifindex, handle, parent, 0)
                netlink.change(Rtm.NEWQDISC, body + attribute(_KIND, kind) + facts, Change.CREATE | Change.REPLACE)
        except RefusedError as error:
            raise LocalError(f"rate of {ifname}: {refusal_text(error)}") from error
