"""Links that go down in the middle of a run, each at its time.

Place: shell.
"""

from __future__ import annotations

import asyncio
from collections.abc import Sequence

from gdp.testbed.namespaces import Namespaces
from proxy.ring.children import cancel
from proxy.ring.options import Cut
from proxy.ring.progress import Teller

__all__ = ["Cutting"]


class Cutting:
    """The cuts of one run. Their seconds count from now."""

    def __init__(self, namespaces: Namespaces, cuts: Sequence[Cut], teller: Teller) -> None:
        self._namespaces = namespaces
        self._teller = teller
        self._tasks = {cut: asyncio.ensure_future(self._cut(cut)) for cut in cuts}

    async def stop(self) -> None:
        """Cut no more."""
        await cancel(*self._tasks.values())

    def complaints(self) -> list[str]:
        """Return, once stopped, which cuts came too late.

        Raises:
            LocalError: the time of one came, and it failed.
        """
        return [f"the cut {cut} came too late" for cut, task in self._tasks.items() if _missed(task)]

    async def _cut(self, cut: Cut) -> None:
        await asyncio.sleep(cut.after_s)
        await asyncio.to_thread(self._namespaces.cut, cut.a, cut.b)
        self._teller.step(f"cut {cut.a}-{cut.b}")


def _missed(task: asyncio.Future[None]) -> bool:
    """Tell whether a cut's time never came.

    Raises:
        LocalError: its time came, and it failed.
    """
    if task.cancelled():
        return True
    task.result()
    return False
