"""Training pixels on disk, and their creation."""
