"""Checkpoints restore a run completely, and damaged ones are refused."""

from pathlib import Path

import pytest
import torch

from splinecli.errors import ModelError
from splinecli.networks.weights import save_weights
from splinecli.training.config import TrainingConfig
from splinecli.training.loop import CHECKPOINT, Trainer
from splinecli.training.run_files import read_checkpoint_config

CPU = torch.device("cpu")
pytestmark = pytest.mark.usefixtures("no_pictures")


@pytest.fixture
def trainer(tiny: TrainingConfig, tmp_path: Path) -> Trainer:
    made = Trainer(tiny, tmp_path, CPU)
    made.step()
    made.save()
    return made


def test_a_weight_file_is_no_checkpoint(trainer: Trainer, tmp_path: Path) -> None:
    save_weights(trainer.network, tmp_path / CHECKPOINT)
    with pytest.raises(ModelError, match="found splinecli-weights-1, expected splinecli-checkpoint-2"):
        read_checkpoint_config(tmp_path / CHECKPOINT)


def test_no_changed_byte_goes_unnoticed(trainer: Trainer, tmp_path: Path) -> None:
    path = tmp_path / CHECKPOINT
    whole = path.read_bytes()
    for position in (8, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:position] + bytes([whole[position] ^ 1]) + whole[position + 1 :])
        with pytest.raises(ModelError):
            read_checkpoint_config(path)


def test_settings_of_a_later_splinecli(trainer: Trainer, tmp_path: Path) -> None:
    path = tmp_path / CHECKPOINT
    whole = path.read_bytes()
    # The checksum does not cover the header. The new text has the same length, so that the header stays valid.
    assert whole.count(b"batch_size") == 1
    path.write_bytes(whole.replace(b"batch_size", b"batch_sise"))
    with pytest.raises(ModelError, match="unknown training setting 'batch_sise'"):
        read_checkpoint_config(path)
    renamed = whole.replace(b'\\"pixels\\": 16', b'\\"pixelz\\": 16')
    assert renamed != whole
    path.write_bytes(renamed)
    with pytest.raises(ModelError, match="the checkpoint is incomplete"):
        Trainer(trainer.config, tmp_path, CPU, resume=True)
    path.write_bytes(whole.replace(b"batch_size", b"batch size").replace(b'\\"seed\\": 0', b'\\"seed\\"  0'))
    with pytest.raises(ModelError, match="the entry 'config' in the file is not JSON"):
        read_checkpoint_config(path)
