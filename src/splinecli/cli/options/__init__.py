"""The options of the commands: each is declared once, with its type, its help and its completion."""
