"""splinecli: surface normals from a few photographs under known lights (photometric stereo, SPLINE-Net)."""

__version__ = "0.2.0"
