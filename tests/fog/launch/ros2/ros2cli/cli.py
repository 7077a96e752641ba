"""Command ``ros2``."""

import argparse

from ros2cli.command import add_subparsers_on_demand


def main(*, script_name="ros2", argv=None, description=None, extension=None):
    parser = argparse.ArgumentParser(description=description)
    add_subparsers_on_demand(parser, script_name, "_command", "ros2cli.command", required=False, argv=argv)
    args = parser.parse_args(args=argv)
    if getattr(args, "_command", None) is None:
        parser.print_help()
        return 0
    return args._command.main(parser=parser, args=args)
