"""The console script and `python -m splinecli`."""

import os
import sys
import warnings

from splinecli.cli.signals import (
    DEFERRED,
    INTERRUPTED,
    end_on_signals,
    ignore_signals,
    report_interruption,
)


def run() -> None:
    """Run the command given by the arguments, and exit. SIGTERM is treated like Ctrl-C."""
    try:
        end_on_signals()
        # NumPy's products are small and, on a busy machine, several times as fast on one core. The
        # variable is read once.
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
        if not sys.warnoptions:  # python -W
            warnings.simplefilter("ignore")  # from libraries, such as NumPy
            # This also applies to Python's process that counts semaphores, because SIGTERM may end
            # this process first.
            os.environ.setdefault("PYTHONWARNINGS", "ignore")
        # The imports take a second or more. Signals are handled in the meantime.
        from splinecli.cli.main import main

        if DEFERRED.is_set():  # otherwise the command would start and soon be ended
            raise KeyboardInterrupt
        code = main()
    except KeyboardInterrupt:  # outside the command
        ignore_signals()
        code = report_interruption()
    ignore_signals()
    if code == INTERRUPTED or "TORCHELASTIC_RUN_ID" in os.environ:
        # os._exit does not wait for threads. If Dask's threads are just starting, they would print
        # tracebacks. PyTorch's threads sometimes abort a process after its work is done, which
        # torchrun reports as a failure.
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    sys.exit(code)


if __name__ == "__main__":
    run()
