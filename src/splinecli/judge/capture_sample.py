"""The evidence of a capture that is read from files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from splinecli.capture import CaptureSource
from splinecli.capture.formats.decoders import page_of
from splinecli.capture.sample import Sample
from splinecli.judge.evidence import Evidence, gray_intensities
from splinecli.maths import Floats
from splinecli.system.files import equal_files, reading


@dataclass(frozen=True, eq=False)
class CaptureSample(Evidence):
    """The evidence of images and lights in files."""

    @classmethod
    def of_source(
        cls,
        source: CaptureSource,
        samples: tuple[Sample, Sample],
        indices: Sequence[int],
        *,
        truth: Floats | None = None,
        strict: bool = False,
    ) -> CaptureSample:
        """Return the checks' input for the images with these indices, from the capture's files,
        sample and closeup.
        """
        (sample, closeup), lamps, measured = samples, source.lamps, source.intensities_measured
        images = [source.files.images[index] for index in indices]
        with reading(source.files.folder):
            single = page_of(images[0])[0] == images[0] and source.channels is None
            copies = equal_files(images) if single else []
        return cls(
            source.image_names(indices),
            source.light_directions,
            indices,
            sample,
            closeup,
            measured,
            intensities=gray_intensities(source.light_intensities[list(indices)])
            if measured
            else None,
            eight_bit=any(
                (source.facts[index].stated_size or ((), 0))[1] == 1 for index in indices
            ),
            lamps=lamps.over(source, sample.mask, step=sample.step)
            if lamps is not None and lamps.used
            else None,
            has_positions=lamps is not None,
            found=source.find_lights is not None,
            origin=source.files.light_directions or Path("light_directions"),
            frame=source.light_frame,
            linear=source.radiometry.curve == 1,
            truth=truth,
            strict=strict,
            in_channels=source.channels is not None,
            copies=copies,
        )
