"""`python -m splinecli`."""

from splinecli.cli.main import run

run()
