"""The console script, and `python -m splinecli`."""

from __future__ import annotations

import os
import sys

from splinecli.cli.signals import end_on_sigterm, ignore_signals, report_interruption


def run() -> None:
    """Run the command of the arguments and exit. SIGTERM is treated like Ctrl-C."""
    try:
        end_on_sigterm()
        # The imports take a second or more. A signal that comes meanwhile is handled, too.
        from splinecli.cli.main import main

        code = main()
    except KeyboardInterrupt:  # outside of the command
        code = report_interruption()
    ignore_signals()
    if "TORCHELASTIC_RUN_ID" in os.environ:
        # PyTorch's communication threads sometimes abort a process of torchrun after its work is done, and torchrun
        # counts that as a failure. os._exit does not wait for these threads.
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    sys.exit(code)


if __name__ == "__main__":
    run()
