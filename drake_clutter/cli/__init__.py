"""Command-line interface: one module per command, which parses options and prints results.

The work is done in `drake_clutter.commands`.
"""

from drake_clutter.cli.app import app, main

__all__ = ["app", "main"]
