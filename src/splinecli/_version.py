"""The version of splinecli."""

__version__ = "0.4.0"
