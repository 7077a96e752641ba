"""Pacer of a path: when the next frame may leave by the pace alone."""

from __future__ import annotations

from typing import Final

DELAY_MOST_S: Final = 0.25  # by the pace; longer only if one frame takes longer
_CREDIT_SHARE, _CREDIT_MOST_S = 0.125, 0.01  # of a round trip; less than a time slice loses the pace on a busy core


class Pacer:
    """Pace of the frames of all flows on one path.

    Attributes:
        mtu: bytes of a full frame.
        due_s: monotonic second of the next frame.
        bytes_s: rate at which frames may leave; none is limited before the first round trip.
        is_paced: a frame waits only for the pace, so a late sender may catch up.
        credit_s: with how much time of the pace it may then.
        others: bytes of other paths so far.
    """

    def __init__(self, mtu: int) -> None:
        self.mtu = mtu
        self.due_s = 0.0
        self.bytes_s = float("inf")
        self.is_paced = False
        self.credit_s = 0.0
        self.others = 0

    def set_rate(self, bytes_s: float, rtt_s: float) -> None:
        """Set the rate, and the smoothed round trip; 0: none yet."""
        credit_s = _CREDIT_SHARE * rtt_s
        self.bytes_s, self.credit_s = bytes_s, credit_s if credit_s < _CREDIT_MOST_S else _CREDIT_MOST_S

    def charge_other(self, size: int, now_s: float) -> None:
        """Delay what follows by the time that so many bytes of another path take."""
        self.others += size
        self.charge(size, now_s)

    def charge(self, size: int, now_s: float) -> None:
        """Delay what follows by the time that so many bytes take.

        The delay has a bound, because what leaves while another path governs may exceed this one's pace for long.
        """
        from_s = now_s - self.credit_s if self.is_paced else now_s
        due_s = (self.due_s if self.due_s > from_s else from_s) + size / self.bytes_s
        if due_s > now_s + DELAY_MOST_S:
            due_s = min(due_s, now_s + max(DELAY_MOST_S, self.mtu / self.bytes_s))
        self.due_s = due_s
