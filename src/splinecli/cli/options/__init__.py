"""The options of the commands. Each is declared once, with its default, its help and its completion."""
