"""Commands and their sub-commands; arguments become known step by step, so each parser runs twice."""

from importlib import metadata

from ros2cli.plugin_system import PLUGIN_SYSTEM_VERSION, satisfies_version


class CommandExtension:
    NAME = None

    def __init__(self):
        satisfies_version(PLUGIN_SYSTEM_VERSION, "^0.1")

    def add_arguments(self, parser, cli_name):
        pass


def add_subparsers_on_demand(parser, cli_name, dest, group_name, hide_extensions=None, required=True, argv=None):
    chosen = parser.add_subparsers(title="Commands", metavar=f"Call `{cli_name} <command> -h` for more detailed usage.")
    chosen.dest = " " + dest.lstrip("_")
    chosen.required = required
    points = {each.name: each for each in metadata.entry_points().select(group=group_name)}
    parsers = {name: chosen.add_parser(name) for name in sorted(points)}
    root = getattr(parser, "_root_parser", parser)
    quiet = [(each, each.print_help, each.exit) for each in (parser, *parsers.values())]
    for each, _, leave in quiet:
        each.print_help = lambda: None
        each.exit = lambda status=0, message=None, leave=leave: leave(status, message) if status else None
    known, _ = root.parse_known_args(argv)
    for each, show, leave in quiet:
        each.print_help, each.exit = show, leave
    name = getattr(known, chosen.dest)
    for each in [name] if name else points:
        extension = points[each].load()()
        extension.NAME = each
        parsers[each].set_defaults(**{dest: extension})
        parser.epilog = f"{parser.epilog or ''}  {each}  {extension.__doc__.strip()}  "
        if name:
            parsers[each]._root_parser = root
            extension.add_arguments(parsers[each], f"{cli_name} {each}")
            del parsers[each]._root_parser
