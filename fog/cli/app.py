"""``fog`` command: clusters of replicated ROS services on machines that may be preempted.

I/O; each verb is a function of another module. Exit status: 0 done, 2 wrong input, 130 after Ctrl-C.
"""

from __future__ import annotations

from fog.cli import scale, status
from fog.cli.down import down
from fog.cli.launch import launch
from fog.cli.logs import logs
from fog.cli.plan import cost_table, plan
from fog.cli.wheels import wheels_command
from fog.providers.local.cli import local_app
from fog.site import open_site
from gdp.cli.program import Program
from gdp.cli.version import Version

app = Program("fog", help="Replicated ROS services on machines that may be taken away.", no_args_is_help=True)
main = app.run

app.command("launch")(launch)
app.command("ls")(status.ls)
app.command("status")(status.status)
app.add_typer(scale.scale, name="scale")
app.command("push")(scale.push)
app.command("logs")(logs)
app.command("ssh")(scale.ssh)
app.command("cost")(status.cost)
app.command("plan")(plan)
app.command("prices")(cost_table)
app.command("down")(down)
app.command("wheels")(wheels_command)
app.command("supervise")(scale.supervise)
app.add_typer(local_app(lambda: open_site(None).state / "local"), name="local")


@app.callback()
def _fog(version: Version = False) -> None:
    del version  # the option's callback ends the command


if __name__ == "__main__":
    main()
