"""Several processes have the losses of one process, and a run survives the failure of a process."""

import json
import os
import socket
import subprocess
import sys
from dataclasses import replace

import torch
from torch.testing import assert_close

from scenes import put
from splinecli.estimate.networks.weights import load_weights
from splinecli.workshop.training import METRICS, WEIGHTS
from splinecli.workshop.training.loop import Trainer
from splinecli.workshop.training.run_files import read_metrics

CPU = torch.device("cpu")
STEPS = 6


def environment(**more):
    kept = {
        name: text
        for name, text in os.environ.items()
        if not name.startswith(("TORCHELASTIC", "PYTEST"))
    }
    return kept | {"OMP_NUM_THREADS": "1"} | more


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return str(probe.getsockname()[1])


WORKER = """
import json, os, sys
from pathlib import Path
import torch
from splinecli.workshop.training import loop, tasks
from splinecli.workshop.training.config import TrainingConfig
from splinecli.workshop.training.loop import join_workers, leave_workers
tasks.VALIDATION_PIXELS = 16
workers, device = join_workers(torch.device("cpu"))
assert workers.agree(7.0 + workers.rank, device) == 7.0
for name, values in json.loads(Path("configs.json").read_text()).items():
    trainer = loop.Trainer(TrainingConfig.from_dict(values), Path(name), device, workers=workers)
    losses = torch.stack([trainer.step() for _ in range(int(sys.argv[1]))])
    torch.save((losses, trainer.network.state_dict()), f"{name} {workers.rank}.pt")
leave_workers()
# As the command does: PyTorch's own threads now and then abort a process that ends by itself.
os._exit(0)
"""


def test_two_processes_compute_what_one_does(tiny, tmp_path):
    config = replace(tiny, symmetric_weight=0.02, asymmetric_weight=1e-4, ne_net_updates=2)
    configs = {"joint": config, "alternating": replace(config, updates="alternating")}
    text = json.dumps({name: values.to_dict() for name, values in configs.items()})
    put(tmp_path / "configs.json", text)
    address = {"WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": free_port()}
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", WORKER, str(STEPS)],
            cwd=tmp_path,
            env=environment(RANK=rank, **address),
        )
        for rank in "01"
    ]
    try:
        assert [process.wait(timeout=100) for process in processes] == [0, 0]
    finally:
        for process in processes:
            process.kill()
    for name, values in configs.items():
        alone = Trainer(values, tmp_path / f"{name} alone", CPU)
        expected = torch.stack([alone.step() for _ in range(STEPS)])
        weights = alone.network.state_dict()
        states = []
        for rank in range(2):
            losses, state = torch.load(tmp_path / f"{name} {rank}.pt", weights_only=True)
            # Sums over the pixels are taken in another order: float32's rounding.
            assert_close(losses, expected, rtol=1e-5, atol=0, equal_nan=True)
            assert state.keys() == weights.keys()
            states.append(state)
            # Adam divides by the gradient's size, so where that is next to nothing rounding shows.
            assert_close(state, dict(weights), rtol=1e-3, atol=1e-5)
        assert all(torch.equal(states[0][key], states[1][key]) for key in weights)
        # Of two, the leader alone writes.
        assert (tmp_path / name / "config.json").exists()


FAILING = """
import os, signal
from splinecli.__main__ import run
from splinecli.workshop.training import loop, tasks
from splinecli.workshop.training.run_files import RunLog
loop.CHECKPOINT_SECONDS, loop.REPORT_STEPS, tasks.VALIDATION_PIXELS = 0.05, 5, 16
RunLog.draw = lambda self, maps: None
step = loop.Trainer.step
def failing(self):
    saved = (self.folder / loop.CHECKPOINT).exists()
    if self.workers.rank == 1 and saved and os.environ["TORCHELASTIC_RESTART_COUNT"] == "0":
        open("killed", "w").close()
        os.kill(os.getpid(), signal.SIGKILL)
    return step(self)
loop.Trainer.step = failing
run()
"""


def test_a_run_outlives_one_of_its_processes(tmp_path):
    # On the processor, one process of two is killed after the first checkpoint; torchrun starts
    # both again.
    put(tmp_path / "worker.py", FAILING)
    steps = 30
    settings = [
        "network.width=8",
        "network.li_blocks=1",
        "network.ne_blocks=1",
        "network.head_width=8",
    ]
    settings += ["batch_size=8", "precision=float32"]
    options = [word for setting in settings for word in ("--param", setting)]
    command = (
        f"{sys.executable} -m torch.distributed.run --standalone --max-restarts 1 --nproc-per-node"
        " 2 worker.py"
    )
    command += f" train -o run --steps {steps} --device cpu"
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    torchrun = subprocess.Popen(
        [*command.split(), *options], cwd=tmp_path, env=environment(), text=True, **pipes
    )
    try:
        out, err = torchrun.communicate(timeout=100)
    finally:
        torchrun.terminate()  # which it passes on to its workers
        torchrun.wait()
    assert torchrun.returncode == 0, err
    assert out == "run/weights.safetensors\n"
    rows = read_metrics(tmp_path / "run" / METRICS)
    assert rows[-1].step == steps
    assert sorted({row.step for row in rows}) == [row.step for row in rows]
    assert rows[0].step < steps  # the lines of before are still there
    assert load_weights(tmp_path / "run" / WEIGHTS).network.config.width == 8
    assert (tmp_path / "killed").exists()
