"""All pictures and plots: maps, curves, lights, calibrations and contact sheets."""
