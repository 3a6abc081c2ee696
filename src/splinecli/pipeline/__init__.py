"""The work of each command on one or more captures, without a terminal."""
