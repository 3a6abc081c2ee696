"""Training pixels on disk, and how they are created."""
