"""Options of the panel Processes and machines."""

from __future__ import annotations

from typer import Option

WORKERS = Option(
    "1",
    metavar="N|auto",
    help="Compute N captures side by side, in processes of this machine (needs the extra 'cluster'). auto chooses by"
    " cores and memory.",
)
CLUSTER = Option(
    None,
    metavar="ADDRESS|FILE",
    help="Compute on the workers of a running Dask cluster: the address of its scheduler, or its scheduler file (needs"
    " the extra 'cluster').",
)
RETRIES = Option(
    None,
    metavar="N",
    min=0,
    help="Repeat a capture N times whose worker was lost, on other workers. [default: 2]",
)
SHARD = Option(
    None,
    metavar="I/N",
    help="Take every N-th capture only, from the I-th on. Together, 1/N to N/N are all captures.",
)
