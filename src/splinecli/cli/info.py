"""`splinecli info`: what `infer` would read from a capture, and what to expect."""

from __future__ import annotations

from splinecli.cli.console import Messages, print_report
from splinecli.cli.options import inputs, outputs
from splinecli.pipeline.info import InfoOptions, describe_capture, summary_lines


def info(
    capture: inputs.Capture,
    lights: inputs.InfoLights = None,
    intensities: inputs.InfoIntensities = None,
    mask: inputs.InfoMask = None,
    ground_truth: inputs.InfoGroundTruth = None,
    transfer: inputs.Transfer = "linear",
    ambient: inputs.Ambient = None,
    flat_field: inputs.FlatField = None,
    white_level: inputs.WhiteLevel = None,
    plot: outputs.LightPlot = None,
    overwrite: outputs.OverwritePlot = False,
    as_json: outputs.Json = False,
    quiet: outputs.Quiet = False,
) -> None:
    """Show what `infer` would read from CAPTURE, without running it.

    Prints the layout and files of the capture, the size and bit depth of the images, their white level and exposure,
    the elevation of the lights, and the memory and time that infer needs. Writes nothing but the plot.
    """
    options = InfoOptions(
        capture=capture,
        lights=lights,
        intensities=intensities,
        mask=mask,
        ground_truth=ground_truth,
        transfer=transfer,
        ambient=ambient,
        flat_field=flat_field,
        white_level=white_level,
        plot=plot,
        overwrite=overwrite,
    )
    report = describe_capture(options, Messages(quiet=quiet))
    print_report(report, "\n".join(summary_lines(report)), as_json=as_json, quiet=quiet)
