"""The command line: a file for each command, which parses and prints; what is done is in `drake_clutter.commands`."""

from drake_clutter.cli.app import app, main

__all__ = ["app", "main"]
