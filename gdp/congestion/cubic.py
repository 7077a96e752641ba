"""CUBIC: a window that follows a cubic function of the time since the last loss.

Sans-I/O. Source: RFC 9438, sections 4.2 to 4.7. Windows are in frames. A paced flow meets more losses at a drop-tail
queue than one that sends in bursts, so that it yields: it reduces less and grows faster than the RFC's constants.
"""

from __future__ import annotations

from typing import Final

_C: Final = 0.8  # section 5: 0.4
_BETA: Final = 0.8  # section 4.6: 0.7
_GROWTH_MAX: Final = 1.5  # of the target over the window, section 4.2


class Cubic:
    """Window of one flow.

    Args:
        window: frames, to begin with.
        beta: what a loss leaves of the window.
        scale: of the cubic function, in frames/s^3.
    """

    def __init__(self, window: float, now_s: float, *, beta: float = _BETA, scale: float = _C) -> None:
        self._beta, self._scale = beta, scale
        self._alpha = 3 * (1 - beta) / (1 + beta)  # section 4.3
        self.window: float
        self._reno: float
        self._max: float
        self._k_s: float
        self._epoch_s: float
        self._is_slow_start = True
        self._begin(window, window, now_s)

    def acknowledged(self, frames: float, now_s: float, rtt_s: float) -> None:
        """Grow by what an acknowledgement of so many frames allows; before the first loss, double each round trip."""
        if self._is_slow_start:
            self.window += frames
            return
        ahead_s = now_s - self._epoch_s + rtt_s
        target = self._max + self._scale * (ahead_s - self._k_s) ** 3
        target = min(max(target, self.window), _GROWTH_MAX * self.window)
        alpha = self._alpha if self._reno < self._max else 1.0
        self._reno += alpha * frames / self.window
        self.window = max(self.window + (target - self.window) * frames / self.window, self._reno)

    def lost(self, now_s: float, least: float, peak_least: float = 0.0) -> None:
        """Reduce the window once for a loss.

        Args:
            least: shortest window.
            peak_least: the window grows back to this one at least, as it does to the one before the loss.
        """
        self._is_slow_start = False
        peak = self.window * (1 + self._beta) / 2 if self.window < self._max else self.window  # fast convergence
        self._begin(max(self.window * self._beta, least), max(peak, peak_least), now_s)

    def raise_to(self, least: float) -> None:
        """Raise the window to so many frames at least."""
        self.window = max(self.window, least)

    def resume(self, pause_s: float) -> None:
        """Continue after a time that does not count."""
        self._epoch_s += pause_s

    def _begin(self, window: float, peak: float, now_s: float) -> None:
        self.window = self._reno = window
        self._max = peak
        self._epoch_s = now_s
        self._k_s = (max(peak - window, 0.0) / self._scale) ** (1 / 3)
