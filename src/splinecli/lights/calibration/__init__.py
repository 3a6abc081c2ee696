"""Calibration of lights with mirror balls (directions) and gray targets (intensities)."""
