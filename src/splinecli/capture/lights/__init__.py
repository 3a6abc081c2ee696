"""Light files, and draws of lights."""
