"""The command line, which starts in main.py. Only this package uses typer and rich, prints, and
sets exit codes.
"""
