"""Start or continue a run in a folder, alone or with the other processes of torchrun."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

from splinecli.system.devices import choose_device, use_available_cores
from splinecli.system.files import check_writable
from splinecli.system.publishing import held_folder
from splinecli.training.checkpoint import read_checkpoint_config
from splinecli.training.config import TrainingConfig
from splinecli.training.config_files import Settings, check_resumable, configure
from splinecli.training.defaults import CHECKPOINT
from splinecli.training.distributed import join_workers, leave_workers, restarts_are_allowed
from splinecli.training.loop import Trainer


def configure_run(
    folder: Path, preset_name: str | None, file: Path | None, changes: Sequence[Settings], *, resume: bool
) -> tuple[TrainingConfig, bool]:
    """Return the configuration of a run, and whether it continues. Raises ModelError, UsageError.

    It continues on request, or after torchrun has started its processes again: with --max-restarts, one command both
    starts a run and continues it. Without a preset, settings of such a run that are not given stay.
    """
    if not (resume or (restarts_are_allowed() and (folder / CHECKPOINT).exists())):
        return configure(preset_name, file, changes), False
    started = read_checkpoint_config(folder / CHECKPOINT)
    asked = configure(preset_name, file, changes, base=started)
    check_resumable(started, asked, folder / CHECKPOINT)
    return asked, True


@contextmanager
def open_run(
    config: TrainingConfig,
    folder: Path,
    device_name: str,
    *,
    resume: bool,
    tensorboard: bool,
    warn: Callable[[str], object],
) -> Iterator[Trainer]:
    """Join the other processes, lock the folder and yield the trainer.

    Args:
        config: from `configure_run`.
        device_name: "auto", "cpu" or "cuda".
        warn: receives a sentence about what a killed process had left in the folder.

    Raises:
        UsageError: the processes cannot share a batch, the device is not available, or TensorBoard is not installed.
        ModelError: the checkpoint does not fit, or weights to start from cannot be used.
        InputError: a pixel set cannot be used.
        OutputError: the folder cannot be written, or has a run in it and `resume` is not set.
    """
    check_writable(folder)
    use_available_cores()
    workers, device = join_workers(choose_device(device_name))
    with ExitStack() as stack:
        stack.callback(leave_workers)
        workers.shards(config.shards)  # raises UsageError before the folder is made
        if workers.leads:
            stack.enter_context(held_folder(folder, warn))
        yield Trainer(config, folder, device, resume=resume, workers=workers, tensorboard=tensorboard)
