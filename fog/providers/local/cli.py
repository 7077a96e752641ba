"""``fog local``: fault injection on local machines.

I/O; the application that registers it supplies the folder of records.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from fog.providers.local import fault_injection
from gdp.cli.node import failing_clearly
from gdp.host.run_registry import RunRegistry

Machine = Annotated[str, typer.Argument(help="its id, or its name where only one is called so")]
Seconds = Annotated[float, typer.Option("--seconds", min=0.0, help="until it is taken")]
Off = Annotated[bool, typer.Option("--off", help="let it go on")]
Back = Annotated[bool, typer.Option("--off", help="have them again")]
Share = Annotated[float, typer.Option("--share", min=0.0, help="of one processor; 0: what its hardware has")]
Ms = Annotated[float, typer.Option("--ms", min=0.0, help="each way; 0: none")]


def local_app(directory: Callable[[], Path]) -> typer.Typer:
    """Return the verbs; ``directory``: called when a verb runs, returns the folder of the provider's records."""
    app = typer.Typer(
        no_args_is_help=True, help="Let something happen to a local machine. Example: fog local notice m2 --seconds 30"
    )

    @app.command()
    def notice(machine: Machine, seconds: Seconds = 120.0) -> None:
        """Give notice: the machine is taken after some seconds."""
        with failing_clearly():
            fault_injection.notice(RunRegistry(directory()), machine, seconds)

    @app.command()
    def kill(machine: Machine) -> None:
        """Kill all of the machine at once."""
        with failing_clearly():
            fault_injection.kill(RunRegistry(directory()), machine)

    @app.command()
    def freeze(machine: Machine, off: Off = False) -> None:
        """Stop the machine where it is."""
        with failing_clearly():
            (fault_injection.thaw if off else fault_injection.freeze)(RunRegistry(directory()), machine)

    @app.command()
    def slow(machine: Machine, share: Share = 0.1) -> None:
        """Let the machine have a share of one processor."""
        with failing_clearly():
            fault_injection.slow(RunRegistry(directory()), machine, share or None)

    @app.command(name="sold-out")
    def sold_out(off: Back = False) -> None:
        """Refuse every new spot machine, as a cloud without capacity does; those there are go on."""
        with failing_clearly():
            (fault_injection.restock if off else fault_injection.sell_out)(directory())

    @app.command()
    def delay(machine: Machine, ms: Ms = 100.0) -> None:
        """Make the machine's link longer."""
        with failing_clearly():
            fault_injection.delay(RunRegistry(directory()), machine, ms)

    return app
