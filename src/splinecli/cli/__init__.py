"""The command line: the only place with typer, rich, printing and exit codes."""

from splinecli.cli.main import main

__all__ = ["main"]
