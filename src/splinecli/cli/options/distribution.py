"""Options of the panel Processes and machines."""

from __future__ import annotations

from typer import Option

WORKERS = Option(
    "1",
    metavar="N|auto",
    help="Compute N captures side by side, in processes of this machine (needs the extra 'cluster'). auto chooses by"
    " cores and memory.",
)
TRIAL_WORKERS = Option(
    "1",
    "--workers",
    metavar="N|auto",
    help="Score trials in N processes of this machine, in place of --jobs threads (needs the extra 'cluster'). auto is"
    " the number of cores.",
)
TRIAL_CLUSTER = Option(
    None,
    "--cluster",
    metavar="ADDRESS|FILE",
    help="Score trials on the workers of a running Dask cluster: the address of its scheduler, or its scheduler file"
    " (needs the extra 'cluster').",
)
SCENE_WORKERS = Option(
    "1",
    "--workers",
    metavar="N|auto",
    help="Render N scenes side by side, in processes of this machine (needs the extra 'cluster'). auto is the number"
    " of cores.",
)
CLUSTER = Option(
    None,
    metavar="ADDRESS|FILE",
    help="Compute on the workers of a running Dask cluster: the address of its scheduler, or its scheduler file (needs"
    " the extra 'cluster').",
)
SHARD = Option(
    None,
    metavar="I/N",
    help="Process shard I of N: captures I, I+N, I+2N, ...",
)
