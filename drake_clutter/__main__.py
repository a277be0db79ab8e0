"""`python -m drake_clutter` is the command `drake-clutter`."""

from drake_clutter.cli import main

main()
