"""Captures: images of one object under known lights, read from folders of files."""

from splinecli.capture.files import Overrides
from splinecli.capture.formats.images import read_image, read_mask
from splinecli.capture.formats.normal_files import read_normal_map
from splinecli.capture.layouts import capture_name, find_capture_files, find_captures
from splinecli.capture.light_files import read_light_directions, read_light_intensities
from splinecli.capture.linearise import RadiometricCalibration
from splinecli.capture.reader import CaptureOptions, open_capture
from splinecli.capture.record import Capture
from splinecli.capture.source import CaptureSource
from splinecli.records.capture_warnings import CaptureWarning

__all__ = [
    "Capture",
    "CaptureOptions",
    "CaptureSource",
    "CaptureWarning",
    "Overrides",
    "RadiometricCalibration",
    "capture_name",
    "find_capture_files",
    "find_captures",
    "open_capture",
    "read_image",
    "read_light_directions",
    "read_light_intensities",
    "read_mask",
    "read_normal_map",
]
