"""The ordered steps from stored pixels to trusted observations."""
