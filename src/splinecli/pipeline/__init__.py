"""The work of each command on one or more captures, independent of the terminal."""
