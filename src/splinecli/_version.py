"""The version of splinecli."""

__version__ = "0.3.0"
