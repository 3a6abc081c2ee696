"""`splinecli import-weights`: the authors' checkpoints in, a weight file out."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from splinecli.cli.options import QuietOption
from splinecli.errors import OutputError


def import_weights(
    li_net: Annotated[Path, typer.Argument(metavar="G.ckpt", help="The authors' LI-Net, their generator.")],
    ne_net: Annotated[
        Path, typer.Argument(metavar="D.ckpt", help="The authors' NE-Net, their discriminator.")
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="FILE.safetensors", help="The weight file to write.")
    ],
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an earlier file.")] = False,
    quiet: QuietOption = False,
) -> None:
    """Turn the checkpoints of the authors' SPLINE-Net (PyTorch) into a weight file.

    Give it to --weights. The two files belong to one step of their training, such as 200000-G.ckpt and
    200000-D.ckpt. Only tensors are read from them; no code in them is run.
    """
    if output.is_dir():
        raise OutputError("is a folder, expected a file", path=output, hint="Name a file with -o")
    if output.exists() and not overwrite:
        raise OutputError(
            "exists already", path=output, hint="Add --overwrite, or choose another place with -o"
        )

    from splinecli.networks.official import import_official
    from splinecli.networks.weights import save_weights

    save_weights(import_official(li_net, ne_net), output)
    if not quiet:
        print(output)
