"""Which files in a folder make a capture."""
