"""Every picture and plot: maps, curves, lights, calibrations, contact sheets."""
