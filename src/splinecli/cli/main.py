"""Entry point: runs the app and turns what goes wrong into one message and an exit code."""

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
from splinecli.errors import OutputError, SplinecliError

INTERRUPTED = 130
DEFECT = 1
# Typer carries its own copy of click, elsewhere in each version; this is click's base of all usage errors.
_ClickUsageError: type[Exception] = typer.BadParameter.__mro__[1]


def main(args: Sequence[str] | None = None) -> int:
    """Run `splinecli ARGS` and return the exit code (the contract is in docs/files-and-frames.md)."""
    _mend_streams()
    command = typer.main.get_command(app)
    try:
        result = command.main(
            args=None if args is None else list(args), prog_name="splinecli", standalone_mode=False
        )
        sys.stdout.flush()
    except SplinecliError as error:
        return fail(str(error), error.exit_code)
    except _ClickUsageError as error:
        message = error.format_message().rstrip(".")  # type: ignore[attr-defined]
        context = getattr(error, "ctx", None)
        where = context.command_path if context else "splinecli"
        return fail(f"{message}. See '{where} --help'.", 2)
    except BrokenPipeError:
        # The reader of stdout went away, as `| head` does. Python would complain again at its exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
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
    """Say what went wrong, in one line on stderr, and hand back the exit code."""
    print(f"splinecli: {message}", file=sys.stderr)
    return exit_code


def _mend_streams() -> None:
    """Make streams usable that are closed (`>&-`) or cannot hold every character (an ASCII locale)."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, Path(os.devnull).open("w", encoding="utf-8"))  # noqa: SIM115 - for the process
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def run() -> None:
    """The console script. SIGTERM, which job schedulers send, ends as cleanly as Ctrl-C."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    code = main()
    if "TORCHELASTIC_RUN_ID" in os.environ:
        # PyTorch's communication threads now and then abort a process of torchrun that ends by itself, after all
        # is done; torchrun would take that for a failure.
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    sys.exit(code)
