"""Implementation of the commands, whose arguments `drake_clutter.cli` parses."""
