"""What the commands of `drake-clutter` do; `drake_clutter.cli` only parses their arguments."""
