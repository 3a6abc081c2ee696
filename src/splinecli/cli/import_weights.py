"""`splinecli import-weights`: turn the authors' checkpoints into a weight file."""

from pathlib import Path

from typer import Argument, Option

from splinecli.cli import shared
from splinecli.errors import OutputError, printable


def import_weights(
    li_net: Path = Argument(..., metavar="G.ckpt", help="The authors' LI-Net, which they call the generator."),
    ne_net: Path = Argument(..., metavar="D.ckpt", help="The authors' NE-Net, which they call the discriminator."),
    output: Path = Option(..., "--output", "-o", metavar="FILE.safetensors", help="The weight file to write."),
    overwrite: bool = Option(False, "--overwrite", help="Replace an existing file."),
    quiet: bool = shared.QUIET,
) -> None:
    """Turn the checkpoints of the authors' SPLINE-Net (PyTorch) into a weight file.

    Other commands take the weight file with --weights. Both checkpoints must come from the same training
    step, such as 200000-G.ckpt and 200000-D.ckpt. Only tensors are read from them; code in them is not run.
    """
    if output.is_dir():
        raise OutputError("is a folder, expected a file", path=output, hint="Name a file with -o")
    if output.exists() and not overwrite:
        raise OutputError("exists already", path=output, hint="Add --overwrite, or choose another place with -o")

    from splinecli.networks.official import import_official
    from splinecli.networks.weights import save_weights

    save_weights(import_official(li_net, ne_net), output)
    if not quiet:
        print(printable(output))
