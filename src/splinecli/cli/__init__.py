"""The command line, whose entry point is main.py. No other package uses typer or rich, prints, or
sets exit codes.
"""
