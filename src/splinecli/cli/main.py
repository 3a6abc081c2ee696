"""Entry point: run the app, and turn every error into one message and an exit code."""

from __future__ import annotations

import io
import os
import signal
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path

import typer

from splinecli.cli.app import app
from splinecli.cli.usage_errors import usage_message
from splinecli.errors import OutputError, SplinecliError

INTERRUPTED = 130
DEFECT = 1
# Typer carries its own copy of click, in a place that changes with the version. This is click's base of usage errors.
_ClickUsageError: type[Exception] = typer.BadParameter.__mro__[1]


def main(args: Sequence[str] | None = None) -> int:
    """Run `splinecli ARGS` and return the exit code (the contract is in docs/files-and-frames.md)."""
    _repair_streams()
    _let_threads_sleep()
    command = typer.main.get_command(app)
    try:
        result = command.main(
            args=None if args is None else list(args), prog_name="splinecli", standalone_mode=False
        )
        sys.stdout.flush()
    except SplinecliError as error:
        return fail(str(error), error.exit_code)
    except _ClickUsageError as error:
        return fail(usage_message(error), 2)
    except BrokenPipeError:
        return _end_at_closed_pipe()
    except SystemExit as error:
        # Click turns a closed pipe into exit code 1.
        if isinstance(error.__context__, BrokenPipeError):
            return _end_at_closed_pipe()
        raise
    except (KeyboardInterrupt, typer.Abort):
        return fail("interrupted.", INTERRUPTED)
    except OSError as error:
        place = f"{error.filename}: " if error.filename else ""
        return fail(f"{place}cannot be read or written ({error.strerror}).", OutputError.exit_code)
    except Exception:
        traceback.print_exc()
        return fail("this is a defect of splinecli; please report it with the lines above.", DEFECT)
    if result == INTERRUPTED:
        return fail("interrupted.", INTERRUPTED)
    return result if isinstance(result, int) else 0


def fail(message: str, exit_code: int) -> int:
    """Print the message on stderr, in one line, and return the exit code."""
    print(f"splinecli: {message}", file=sys.stderr)
    return exit_code


def _end_at_closed_pipe() -> int:
    """Return 0: the reader of stdout has read enough, as `| head -1` does."""
    # Otherwise Python complains when it flushes stdout at its exit.
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 0


def _repair_streams() -> None:
    """Make streams usable that are closed (`>&-`) or cannot hold every character (an ASCII locale)."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, Path(os.devnull).open("w", encoding="utf-8"))  # noqa: SIM115 - for the process
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _let_threads_sleep() -> None:
    """Let PyTorch's threads sleep while they wait for each other, unless the user has chosen otherwise.

    By default they spin. On a machine that is busy with other work this takes cores from the thread that computes.
    PyTorch reads the variable when it is first imported.
    """
    if "GOMP_SPINCOUNT" not in os.environ:
        os.environ.setdefault("OMP_WAIT_POLICY", "passive")


def run() -> None:
    """Run the console script. SIGTERM, which job schedulers send, is treated like Ctrl-C."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    code = main()
    if "TORCHELASTIC_RUN_ID" in os.environ:
        # PyTorch's communication threads sometimes abort a process of torchrun after its work is done, and torchrun
        # counts that as a failure. os._exit does not wait for these threads.
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    sys.exit(code)
