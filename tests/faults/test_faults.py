"""Commands under kills, on a tiny disk, under limits, and two at once."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from numpy.random import default_rng

from kills import content
from scenes import parametrize, refuses, run_python, shell, vectors, write_capture, write_image
from splinecli.cli.main import main
from splinecli.estimate.methods.estimator import LeastSquares
from splinecli.maths.normals import unit
from splinecli.pipeline.infer import infer_capture
from splinecli.pipeline.infer_options import InferOptions
from splinecli.system.publishing import held_folder

pytestmark = pytest.mark.skipif(
    sys.platform != "linux", reason="POSIX processes, limits and mounts"
)

COMMAND = f"{sys.executable} -m splinecli"
LIGHTS = unit(vectors("0 0 1; 0.5 0 1; -0.5 0 1; 0 0.5 1; 0.1 -0.5 1"))


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with a flat capture of 60 x 60 pixels and the results of an earlier run in `out`."""
    noise = default_rng(0).integers(0, 2000, (len(LIGHTS), 60, 60))
    images = np.uint16(50_000 * LIGHTS[:, 2, None, None] + noise)
    write_capture(tmp_path / "a", images, LIGHTS, names="{}.png")
    monkeypatch.chdir(tmp_path)
    assert main(["infer", "a", "--method", "ls", "-q"]) == 0
    return tmp_path


def test_kills_of_every_command():
    script = Path(__file__).with_name("kill_commands.py")
    done = shell(f"{sys.executable} {script} --steps 2 --kills 7")
    assert done.returncode == 0, done.stdout + done.stderr
    for command in ("infer", "calibrate", "integrate", "evaluate", "prepare", "info", "train"):
        assert f"{command}: " in done.stdout
    assert "0 failed" in done.stdout


@parametrize("disk_kb", [16, 128])
def test_a_full_disk_leaves_what_was_there(folder, disk_kb):
    """The disk has room for no results; or for one set, and is filled after it."""
    mount = f"mount -t tmpfs -o size={disk_kb}k tiny disk"
    infer = f"{COMMAND} infer a --method ls -o disk --overwrite --format npy -q"
    fill = f"{infer} && cp -r disk before && cat /dev/zero >disk/fill 2>/dev/null;"
    script = (
        f"mkdir disk; {mount} || exit 77; cp a/light_directions.txt disk/kept; "
        f"{fill if disk_kb == 128 else ''} {infer}; echo $? >code; rm -f disk/fill; cp -r disk left"
    )
    done = shell(f"unshare --map-root-user --mount bash -c '{script}'", cwd=folder)
    if done.returncode or not (folder / "code").exists():
        pytest.skip(f"this system does not let the test mount a disk ({done.stderr.strip()})")
    assert (folder / "code").read_text() == "5\n"
    assert done.stderr.count("\n") == 1
    assert "No space left on device" in done.stderr or "the disk may be full" in done.stderr
    assert done.stderr.startswith("splinecli: disk/a") and "unfinished" not in done.stderr
    left = content(folder / "left")
    if disk_kb == 16:
        assert set(left) == {"kept"}
        assert not (folder / "left" / "a").exists()
    else:
        assert "a/normals.npy" in left and left == content(folder / "before")


@pytest.fixture(scope="module")
def large(tmp_path_factory):
    """A capture of 1.2 megapixels, whose reading takes long enough to be interrupted."""
    folder = tmp_path_factory.mktemp("large")
    lights = np.tile(LIGHTS, (4, 1))
    noise = default_rng(0).integers(0, 20_000, (1000, 1200), np.uint16)
    write_image(folder / "00.png", noise)
    for number in range(1, len(lights)):
        os.link(folder / "00.png", folder / f"{number:02d}.png")
    np.savetxt(folder / "lights.txt", lights)
    return folder


def test_ctrl_c_while_a_large_capture_is_read(large, tmp_path):
    """One thread decodes an image while another uses the one before: both end,
    and nothing is left.
    """
    command = [*COMMAND.split(), "infer", str(large), "--method", "ls", "-o", str(tmp_path / "out")]
    # A shell that runs the tests in the background may have switched Ctrl-C off.
    process = subprocess.Popen(
        command,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    # The lock is taken just before the images are read. A few milliseconds earlier, the folders and
    # the lock are made and removed once, to look for earlier results.
    lock = tmp_path / "out" / large.name / ".lock"
    deadline = time.monotonic() + 60
    while not lock.exists() and time.monotonic() < deadline:
        time.sleep(0.01)
    time.sleep(0.2)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert (process.returncode, err) == (130, "splinecli: interrupted.\n")
    assert content(tmp_path) == {}


def test_too_little_memory_for_the_results(folder, monkeypatch):
    """The images fit, the albedo does not. This is said before the normals are estimated."""
    before = content(folder / "out")
    monkeypatch.setattr(
        "splinecli.pipeline.infer.results_bytes", lambda *_, maps, **__: 10**15 * ("albedo" in maps)
    )
    options = InferOptions(method="ls", maps=("albedo",), output=str(folder / "out"))
    monkeypatch.setattr(LeastSquares, "estimate", None)
    with refuses(r"the results of 3600 pixels take 1000000\.0 GB of memory") as caught:
        infer_capture(folder / "a", options)
    assert (
        caught.value.hint == "Mask the object, or use --scale or --crop, or leave out --maps albedo"
    )
    assert content(folder / "out") == before


def test_a_limit_on_the_size_of_files_keeps_earlier_results(folder):
    before = content(folder / "out")
    done = shell(
        f"ulimit -f 4; trap '' XFSZ; {COMMAND} infer a --method ls --overwrite -q", cwd=folder
    )
    assert (done.returncode, done.stderr.count("\n")) == (5, 1)
    assert content(folder / "out") == before


LIMITED = """
import json, resource, sys
from splinecli.cli.main import main
command = ["infer", "a", "--method", "ls", "-q", "--overwrite"]
most = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
codes = [main(command)]  # imports what it needs
for limit in range(3, 20):
    resource.setrlimit(resource.RLIMIT_NOFILE, (limit, most))
    codes.append(main(command))
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
    codes.append(main(command[:-1]))
print(json.dumps(codes))
"""


def test_a_limit_on_open_files(folder):
    """The command is refused with one message as long as the limit is too low, and the next start
    finds results.
    """
    done = run_python(LIMITED, cwd=folder)
    assert done.returncode == 0, done.stderr
    first, *codes = json.loads(done.stdout)
    limited, unlimited = codes[::2], codes[1::2]
    assert first == limited[-1] == 0
    assert set(unlimited) == {0}, done.stderr
    assert limited[0] in (3, 5)
    assert set(limited) <= {0, 3, 5}, done.stderr
    messages = [
        line for line in done.stderr.splitlines() if not line.startswith("splinecli: warning: ")
    ]
    assert len(messages) == sum(code != 0 for code in limited)
    assert "Traceback" not in done.stderr
    assert {"capture.png", "normals.npy", "normals.png", "report.json"} == set(
        content(folder / "out" / "a")
    )


BUSY = (
    "splinecli: out/a: another splinecli process is writing to this folder. Wait until it has"
    " finished, or choose another -o.\n"
)


def test_a_second_writer_is_refused(folder):
    before = content(folder / "out")
    with held_folder(folder / "out/a"):
        done = shell(f"{COMMAND} infer a --method ls --overwrite -q", cwd=folder)
    assert (done.returncode, done.stderr) == (5, BUSY)
    assert content(folder / "out") == before


def test_two_writers_of_one_folder(folder):
    """One may be refused; what is left is whole."""
    infer = [*COMMAND.split(), "infer", "a", "--method", "ls", "--overwrite", "-q", "--format"]
    commands = [
        subprocess.Popen([*infer, form], cwd=folder, stderr=subprocess.PIPE, text=True)
        for form in ("npy", "tiff")
    ]
    ended = [(command.communicate(timeout=120)[1], command.returncode) for command in commands]
    assert any(code == 0 for _, code in ended)
    for message, code in ended:
        assert (code, message) in ((0, message), (5, BUSY))
    assert set(content(folder / "out" / "a")) in (
        {"capture.png", "normals.npy", "report.json"},
        {"capture.png", "normals.tiff", "report.json"},
    )


def test_an_output_folder_without_permission(folder):
    """As an ordinary user, also where the tests run as root."""
    (folder / "closed").mkdir(mode=0o555)
    rights = "-dac_override,-dac_read_search"
    prefix = f"setpriv --bounding-set={rights} --inh-caps={rights} " if os.geteuid() == 0 else ""
    for command in ("infer a --method ls", "integrate out/a", "calibrate a --circle 30,30,20"):
        done = shell(f"{prefix}{COMMAND} {command} -o closed -q", cwd=folder)
        assert done.returncode == 5, done.stderr
        assert done.stderr.startswith("splinecli: closed: no permission to write to this folder")
