"""Items on workers of a Dask cluster: lost workers, memory, workers that do not fit, and many
captures.
"""

import json
import re
import socket
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import worker_tasks
from scenes import names_in, put, read_json, refuses, vectors, write_capture
from splinecli.cli.main import main
from splinecli.errors import InputError, ModelError, OutputError, SplinecliError, UsageError
from splinecli.maths.normals import unit
from splinecli.pipeline import batch
from splinecli.pipeline import distribution as distribution_module
from splinecli.pipeline.batch import (
    BatchItem,
    choose_workers,
    expected_bytes,
    infer_batch,
    list_captures,
)
from splinecli.pipeline.distribution import Distributor, LostError, Work, WorkItem, distributor
from splinecli.pipeline.infer_options import ClusterOptions, InferOptions
from splinecli.system.progress import SILENT

distributed = pytest.importorskip("distributed")
GB = 10**9


@pytest.fixture(scope="module")
def cluster():
    """Two worker processes of 4 GB. A worker that is killed is replaced."""
    with distribution_module._local_cluster(ClusterOptions(workers=2)) as cluster:
        yield cluster


@pytest.fixture
def client(cluster):
    with distributed.Client(cluster, set_as_default=False) as client:
        yield client


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def work(tmp_path):
    (tmp_path / "probe").touch()

    def make(do):
        return Work(partial(do, str(tmp_path)), str(tmp_path / "probe"))

    return make


def run(client, work, items, **options):
    distributor = Distributor(client, work, ClusterOptions(**options), SILENT)
    return {item.args[0]: result for item, result in distributor.run(items)}


def numbered(numbers, memory=0):
    return [WorkItem((number,), f"task{number}", memory) for number in numbers]


def test_an_item_that_kills_its_workers(client, work, tmp_path):
    results = run(client, work(worker_tasks.die_of_thirteen), numbered(range(20)))
    error = results.pop(13)
    assert isinstance(error, LostError) and error.exit_code == 1
    assert str(error).startswith("task13: its worker was lost 3 times, the last one tcp://")
    assert (tmp_path / "begun-13").read_text() == "xxx"
    assert results == {number: 2 * number for number in range(20) if number != 13}


def test_ctrl_c_leaves_workers_alone(client, work):
    """A terminal sends it to all processes; the command itself ends the workers."""
    pids = run(client, work(worker_tasks.survive_an_interrupt), numbered(range(6)))
    assert all(isinstance(pid, int) for pid in pids.values()) and len(set(pids.values())) <= 2


def test_items_share_the_memory_of_a_machine(client, work, monkeypatch):
    """Two items of two thirds of the memory run one after the other, small ones side by side."""
    monkeypatch.setattr(distribution_module, "available_memory", lambda: 3.0 * GB)
    alone = run(client, work(worker_tasks.count_neighbours), numbered(range(6), 2 * GB))
    assert set(alone.values()) == {1}
    beside = run(client, work(worker_tasks.count_neighbours), numbered(range(20), GB / 2))
    assert 2 in beside.values()
    # An item that seems too large runs alone: the capture itself checks its memory.
    assert set(
        run(client, work(worker_tasks.count_neighbours), numbered(range(2), 1e18)).values()
    ) == {1}


def test_a_task_for_no_worker(client, work):
    """A limit that Dask holds a worker to is known before the task kills the worker."""
    client.run(worker_tasks.set_resources, MEMORY=4 * GB)
    try:
        results = run(
            client,
            work(worker_tasks.double),
            [*numbered(range(2), GB), WorkItem((2,), "big", 5 * GB)],
        )
    finally:
        client.run(worker_tasks.set_resources, MEMORY=1000 * GB)
    assert str(results.pop(2)).startswith(
        "big: it takes about 5.0 GB of memory, but the largest worker has only 4.0 GB."
    )
    assert results == {0: 0, 1: 2}


def test_workers_that_do_not_fit(client, work, tmp_path):
    good = work(worker_tasks.double)
    cases = {
        "found splinecli [0-9.]+, expected 9.9 as on the command's machine": (
            UsageError,
            replace(good, versions={**good.versions, "splinecli": "9.9"}),
        ),
        "nowhere: the folder cannot be entered": (InputError, replace(good, folder="nowhere")),
        "elsewhere: the worker's folder is not the folder of the command's machine": (
            InputError,
            replace(good, probe=str(tmp_path / "elsewhere/probe")),
        ),
    }
    for message, (kind, other) in cases.items():
        (tmp_path / "elsewhere").mkdir(exist_ok=True)
        distributor = Distributor(client, other, ClusterOptions(), SILENT)
        with pytest.raises(kind, match=rf"{message}.* \(on the worker tcp://"):
            list(distributor.run(numbered(range(3))))


def test_gpu_workers_only(client, work):
    with refuses("no worker has the Dask resource GPU", UsageError):
        run(client, work(worker_tasks.double), numbered(range(3)), gpu=True)
    client.run(worker_tasks.set_resources, GPU=1)
    try:
        assert run(client, work(worker_tasks.double), numbered(range(3)), gpu=True) == {
            0: 0,
            1: 2,
            2: 4,
        }
    finally:
        client.run(worker_tasks.set_resources, GPU=0)


def write_captures(names):
    """Write small captures of different content into the working folder; `broken` has no images."""
    lights = unit(vectors("0 0 1; 0.5 0 1; -0.5 0 1; 0 0.5 1; 0.1 -0.5 1"))
    for seed, name in enumerate(names):
        images = np.random.default_rng(seed).integers(20_000, 50_000, (5, 12, 15), np.uint16)
        write_capture(Path(name), images[: 0 if name == "broken" else 5], lights)
    return names


def results_in(folder):
    files = {str(path.relative_to(folder)): path.read_bytes() for path in Path(folder).glob("*/*")}
    measured = rb'"(seconds": \{[^}]*\}|peak_memory_mib": [0-9.]+)'
    return {name: re.sub(measured, b"", files[name]) for name in files}


def test_a_cluster_gives_what_one_process_gives(cluster, tmp_path, monkeypatch, capfd):
    names = [*write_captures(["b", "broken", "a", "c", "d"]), "missing"]
    call = ["infer", *names, "--maps", "albedo", "--method", "ls"]

    def documents(*more):
        assert main([*call, *more, "--jsonl"]) == 3
        lines = capfd.readouterr().out.splitlines()
        return sorted(map(json.loads, lines), key=lambda document: document["capture"])

    def comparable(found):
        return [{**document, "seconds": None, "peak_memory_mib": None} for document in found]

    alone = documents("-o", "out")
    expected = results_in("out")
    Path("out").rename("alone")
    together = documents("-o", "out", "--cluster", cluster.scheduler_address)
    assert comparable(together) == comparable(alone)
    assert results_in("out") == expected
    rows = [
        re.findall(r'<th scope="row">.*', Path(f"{place}/index.html").read_text())
        for place in ("out", "alone")
    ]
    assert rows[0] == rows[1] and len(rows[0]) == len(names)
    assert names_in("out") == {"a", "b", "c", "d", "index.html"}
    # What is done is skipped: the reports have the seconds of the first run.
    put("scheduler.json", json.dumps({"address": cluster.scheduler_address}))
    assert documents("-o", "out", "--cluster", "scheduler.json") == together


def test_the_cores_are_shared_out(monkeypatch, work):
    """Of seven cores, each of three workers gets two, whatever the user allows above that."""
    monkeypatch.setattr(distribution_module, "count_available_cores", lambda: 7)
    monkeypatch.setenv("OMP_NUM_THREADS", "16")
    options = ClusterOptions(workers=3)
    with distribution_module.connected(options) as client:
        assert run(client, work(worker_tasks.threads), numbered(range(1))) == {0: "2"}


def test_shards_side_by_side_share_a_folder(cluster, tmp_path, capfd):
    """Another batch that writes the index of the folder leaves the mark by which workers know
    it.
    """
    call = ["infer", *write_captures(["a", "b", "c", "d"]), "--method", "ls", "-o", "out"]
    options = ClusterOptions(address=cluster.scheduler_address)
    with distributor(partial(worker_tasks.double, "out"), Path("out"), options, SILENT) as workers:
        assert main([*call, "--shard", "1/2"]) == 0
        assert [result for _, result in workers.run(numbered(range(2)))] in ([0, 2], [2, 0])
    assert names_in("out") == {"a", "c", "index.html"}
    assert "unfinished" not in capfd.readouterr().err


def test_other_weights_on_a_worker(cluster, tmp_path, monkeypatch):
    folders = [Path(name) for name in write_captures(["a"])]
    weights = SimpleNamespace(weights={"sha256": "1234"})
    monkeypatch.setattr(batch, "make_method", lambda options: weights)
    options = ClusterOptions(address=cluster.scheduler_address)
    with refuses("expected 1234 as on the machine of the command", ModelError):
        list(infer_batch(folders, InferOptions(method="cnn-ps"), cluster=options))
    assert not Path("out").exists()


def test_no_scheduler(monkeypatch):
    put("broken.json", "{}")
    monkeypatch.setattr(distribution_module, "CONNECT_SECONDS", 0.2)
    monkeypatch.setattr(distribution_module, "ANSWER_SECONDS", 0.2)
    with socket.create_server(("127.0.0.1", 0)) as server:  # no scheduler
        addresses = [
            "tcp://127.0.0.1:1",
            "strange://x",
            "http://x",
            "none.json",
            "broken.json",
            "tcp://",
        ]
        for address in (*addresses, f"tcp://127.0.0.1:{server.getsockname()[1]}"):
            with refuses(r"no Dask scheduler answers at|expected an address such as", UsageError):
                distribution_module.connected(ClusterOptions(address=address)).__enter__()


def test_a_capture_that_a_worker_does_not_see(client, tmp_path, monkeypatch):
    """The command sees the folder, so it is not missing for it."""
    member = BatchItem(tmp_path / "unseen", "unseen")
    outcome, _ = client.submit(
        batch._infer, InferOptions(method="ls"), "nothing", None, 0, member, pure=False
    ).result()
    expected = (
        rf"{tmp_path}/unseen: the folder does not exist on the worker tcp://[0-9.:]+\. Workers must"
    )
    assert re.match(expected, outcome.report["error"]) and outcome.exit_code == 3


def test_trials_on_workers(cluster, tmp_path, monkeypatch, capfd):
    names = write_captures(["data/b", "data/damaged", "data/a", "data/without"])
    for name in names[:3]:
        np.save(f"{name}/normals_gt.npy", np.float32(np.broadcast_to([0, 0, 1], (12, 15, 3))))
    Path("data/damaged/002.png").write_bytes(b"no picture")
    call = "evaluate data --method ls --method iw12 --n-lights 3 --n-lights all"

    def results(output, *more):
        assert main([*call.split(), "-o", output, *more]) == 3
        document = read_json(Path(output, "results.json"))
        text = re.sub(r'"seconds[a-z_]*": [0-9.e-]+', "", json.dumps(document))
        return text, capfd.readouterr().err, Path(output, "trials.jsonl").read_text().count("\n")

    alone = results("alone", "--trials", "3", "--jobs", "1")
    # What an earlier command has scored is not scored again.
    results("out", "--trials", "2", "--cluster", cluster.scheduler_address)
    first = Path("out/trials.jsonl").read_text()
    assert results("out", "--trials", "3", "--cluster", cluster.scheduler_address) == alone
    assert Path("out/trials.jsonl").read_text().startswith(first)
    assert alone[2] == 2 * 2 * (3 + 1) and "data/damaged" in alone[1]
    assert results("out", "--trials", "3", "--cluster", cluster.scheduler_address) == alone


def test_errors_travel(client):
    for error in (
        InputError("wrong", path="a", line=3, hint="Do it"),
        OutputError("full"),
        SplinecliError("x"),
    ):
        found = client.submit(lambda error: error, error, pure=False).result()
        assert type(found) is type(error)
        assert str(found) == str(error)
        assert vars(found) == vars(error)


def test_the_number_of_workers(tmp_path, monkeypatch):
    """Captures of 12 x 15 pixels take little; the machine of the test has four cores and memory for
    three.
    """
    members = list_captures([Path(name) for name in write_captures(["a", "broken", "c", "d", "e"])])
    options = InferOptions(method="ls")
    assert 0 < expected_bytes(members[0], options) < 10**6
    assert expected_bytes(members[1], options) == 0
    monkeypatch.setattr("splinecli.pipeline.batch.count_available_cores", lambda: 4)
    monkeypatch.setattr("splinecli.pipeline.batch.available_memory", lambda: 1.7e9)
    assert choose_workers(members, options) == 3
    assert choose_workers(members[:2], options) == 2
