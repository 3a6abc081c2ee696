"""The command line: the only place with typer, rich, printing and exit codes.

It begins in main.py.
"""
