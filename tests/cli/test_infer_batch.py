"""One capture and many: failures, the exit code, the JSON and the index."""

import errno
import json
import os
import pickle
import random
import re
from contextlib import contextmanager
from pathlib import Path
from unittest.mock import Mock
from urllib.parse import unquote

import pytest

from capture.test_cyclesps import write_object
from cli.conftest import read_report
from scenes import names_in, parametrize, put, read_json, refuses
from splinecli.errors import InputError, UsageError
from splinecli.estimate.methods.estimator import LeastSquares
from splinecli.pipeline.batch import infer_batch, list_captures
from splinecli.pipeline.infer import infer_capture
from splinecli.pipeline.infer_options import InferOptions, Shard
from splinecli.system.files import NoRoomError
from splinecli.system.progress import Observer


def test_a_batch_goes_on_past_a_bad_capture(capture, make_capture, run, golden):
    make_capture("broken")
    Path("broken/image3.png").write_bytes(b"no picture")
    make_capture("third")
    result = run(f"infer {capture} broken third --method ls", code=3)
    golden("batch.out.txt", result.out)
    golden("batch.err.txt", re.sub(r"[0-9]+\.[0-9]$", "SECONDS", result.err, flags=re.MULTILINE))
    assert names_in("out") == {"index.html", "sphere", "third"}

    documents = run(f"infer {capture} broken --method ls --json --overwrite", code=3).json
    assert documents[0] == read_report()
    assert documents[1]["capture"] == "broken"
    assert "image3.png" in documents[1]["error"]


def test_links_are_called_by_their_own_names(capture, run):
    for link in ("x/obj", "y/obj", "one", "two"):
        Path(link).parent.mkdir(exist_ok=True)
        Path(link).symlink_to(capture.absolute())
    run("infer x/obj y/obj --method ls", code=2)
    run("infer one two --method ls")
    assert names_in("out") == {"index.html", "one", "two"}


def test_two_kinds_of_images_of_a_cyclesps_object(capture, run):
    holder = capture.parent / "Ball"
    write_object(holder, "specular", "metallic")
    result = run(f"infer {holder / 'images_specular'} Ball/images_metallic --method ls")
    assert result.err.endswith("2 captures: 2 done; see out/index.html\n")
    assert names_in("out") == {"index.html", "Ball_specular", "Ball_metallic"}
    assert read_report("Ball_metallic")["capture"] == "Ball_metallic"
    # An object with several kinds is passed over among others, under its own name.
    says = "Ball: found 2 folders of images (images_metallic, images_specular)"
    run(f"infer {holder} {capture} --method ls --overwrite", input_error=says)


def test_an_index_of_several_captures(capture, make_capture, run):
    make_capture("a b")
    make_capture("broken")
    Path("broken/image3.png").write_bytes(b"no picture")
    Path("out").mkdir()
    put("out/index.html", "<html>my site</html>")
    captures = ("infer sphere broken --method ls --html", "a b")
    run(*captures, code=5, says="index.html: the file was not written by splinecli")
    Path("out/index.html").unlink()
    run(*captures, code=3)
    index = Path("out/index.html").read_text("utf-8")
    links = re.findall(r'href="([^"]+)"', index)
    assert {"sphere/page.html", "a%20b/page.html", "sphere/normals.npy"} <= set(links)
    assert all((Path("out") / unquote(link)).is_file() for link in links)
    assert "found neither PNG, TIFF, JPEG, BMP, PGM, PPM, WebP, AVIF nor HEIC" in index
    pages = re.findall(
        r'<img src="data:image/jpeg;base64,[^"]+" alt="Normal map of ([^"]+)"', index
    )
    assert pages == ["sphere", "a b"]
    run(*captures, code=3)  # our own index is replaced
    # Later results in the same place join it, and those of a single capture, too.
    run(f"infer {make_capture('fourth')} --method ls --overwrite", "a b")
    run(f"infer {make_capture('fifth')} --method ls")
    links = re.findall(r'href="([^"]+)"', Path("out/index.html").read_text("utf-8"))
    assert {f"{name}/normals.npy" for name in ("sphere", "a%20b", "fourth", "fifth")} <= set(links)
    assert len([link for link in links if link == "a%20b/normals.npy"]) == 1
    Path("place/index.html").mkdir(parents=True)
    run(f"infer {capture} fourth --method ls -o place --overwrite", code=5)


def test_names_that_are_no_text(capture, make_capture, run):
    odd = make_capture("odd").rename(os.fsdecode(b"x\xff"))
    run(f"infer {capture} {odd} --method ls")
    assert 'href="x%FF/normals.npy"' in Path("out/index.html").read_text("utf-8")


def test_a_folder_that_is_given_twice_counts_once(capture, run):
    result = run(
        f"infer {capture} {capture.absolute()} others/../sphere sphere/ --method ls --json"
    )
    (document,) = result.json
    assert result.err == ""
    assert document["capture"] == "sphere"
    assert not Path("out/index.html").exists()


REFUSED_ARGUMENTS = """
--maps albedo confidence | 2 | confidence: the folder does not exist. Write lists with commas
--lights none.txt | 3 | none.txt: the file does not exist.
--mask none.png | 3 | none.png: the file does not exist.
--flat-field none | 3 | none: the folder does not exist.
--maps albedo,depth | 2 | --maps contains 'depth'
--transfer rec709 | 2 | 'rec709'; expected auto, linear, srgb, or gamma:G with G from 0.1 to 10
--white-level 0 | 2 | --white-level is '0'; expected a number above 0
--weights spline-net | 2 | method ls does not use weights
--maps confidence | 2 | method ls does not provide confidence
--update --overwrite | 2 | --overwrite and --update cannot be used together
--workers 0 | 2 | --workers is '0'; expected a number of at least 1, or auto
--workers many | 2 | --workers is 'many'; expected a number of at least 1, or auto
--workers 2 --cluster tcp://a:1 | 2 | --workers and --cluster cannot be used together
--shard 3/2 | 2 | --shard is 3/2; expected I/N with I from 1 to N
--shard half | 2 | --shard is 'half'; expected I/N
--cluster none.json | 2 | --cluster is none.json; expected an address such as tcp://scheduler:8786
"""


@parametrize("arguments, code, message", REFUSED_ARGUMENTS)
def test_arguments_are_checked_before_the_first_capture(
    arguments, code, message, capture, make_capture, run, monkeypatch
):
    if "--cluster" in arguments:
        pytest.importorskip("distributed")
    make_capture("second")
    infer = Mock()
    monkeypatch.setattr("splinecli.pipeline.batch.infer_capture", infer)
    call, code = f"infer {capture} second --method ls {arguments}", int(code)
    assert run(call, code=code, says=message, out="").err.count("\n") == 1
    assert not infer.called and not Path("out").exists()
    documents = run(f"{call} --json", code=code).json
    assert [document["exit_code"] for document in documents] == [code]
    assert message in documents[0]["error"]


def test_options_are_written_and_read_back(capture, run):
    """They are the report's `options`, go through JSON and pickle, and tell what changes the
    results.
    """
    given = {"n_lights": 5, "seed": 3, "formats": ("npy",), "maps": ("albedo",)}
    options = InferOptions(method="ls", white_level=60_000.5, output="elsewhere", **given)
    values = options.as_dict()
    assert InferOptions.from_dict(json.loads(json.dumps(values))) == options
    assert pickle.loads(pickle.dumps(options)) == options
    assert infer_capture(capture, options)["options"] == values
    assert read_json("elsewhere/sphere/report.json")["options"] == values
    for changed, expected in (({"output": "x", "device": "cpu"}, []), ({"seed": 4}, ["--seed"])):
        assert options.changes(InferOptions.from_dict({**values, **changed})) == expected
    with pytest.raises(UsageError):
        InferOptions(align=True, scale="1/2")


class Watcher(Observer):
    """Keeps the steps of each bar, and calls a function at each with all notes of its bar."""

    def __init__(self, at_each=lambda notes: None):
        self.bars, self.at_each = {}, at_each

    @contextmanager
    def progress(self, label, total, *, start=0.0, unit=""):
        steps = self.bars.setdefault(label, [])

        def advance(amount, note=""):
            steps.append((amount, note))
            self.at_each([note for _, note in steps])

        yield advance


def test_the_pipeline_reports_to_an_observer(capture, make_capture):
    make_capture("second")
    (capture / "mask.png").unlink()
    watcher = Watcher()
    outcomes = list(infer_batch([capture, Path("second")], InferOptions(method="ls"), watcher))
    found = [(one.report["capture"], one.status) for one in outcomes]
    assert found == [("sphere", "done"), ("second", "done")]
    assert list(watcher.bars) == ["sphere", "second"]
    for steps in watcher.bars.values():
        amounts, notes = zip(*steps, strict=True)
        assert " ".join(dict.fromkeys(notes)) == "reading checking estimating maps writing"
        assert min(amounts) >= 0 and 0.5 < sum(amounts) <= 1 + 1e-9


@parametrize("stage", "reading estimating")
@parametrize("name", "light_directions.txt image3.png")
def test_a_file_that_changes_during_the_run_is_read_anew_in_the_next(capture, stage, name):
    """The report states the files that were used, not those that lie there at the end."""

    def meddle(notes):
        if notes[-1] == stage and notes.count(stage) == 1:
            (capture / name).write_bytes((capture / name).read_bytes() + b"\n")

    options, statuses = InferOptions(method="ls"), []
    for observer in (Watcher(meddle), Observer(), Observer()):
        (outcome,) = infer_batch([capture], options, observer, redo="changed")
        statuses.append(outcome.status)
    assert statuses == ["done", "done", "skipped"]


def test_shards_give_the_results_of_the_whole(capture, make_capture, run):
    names = ["sphere", *map(str, (make_capture(name) for name in ("Second", "third", "\u00e9")))]
    run("infer --method ls -o whole", *names)
    for number in (3, 1, 2, 5, 4):
        result = run(f"infer --method ls --shard {number}/5", *names)
        assert result.out.count("\n") == (number < 5)
    for name in names:
        parts = [Path(place, name, "normals.npy").read_bytes() for place in ("out", "whole")]
        assert parts[0] == parts[1]
    links = re.findall(r'href="([^"]+)/normals.npy"', Path("out/index.html").read_text("utf-8"))
    assert sorted(map(unquote, links)) == sorted(names)


def test_json_lines(capture, make_capture, run):
    """Each line is there when its capture ends, also where an error ends the batch."""
    make_capture("second")
    Path("broken").mkdir()
    call = "infer sphere broken second --method ls"
    lines = run(f"{call} --jsonl", code=3).out.splitlines()
    assert lines == [json.dumps(document) for document in run(f"{call} --json", code=3).json]
    for arguments in ("--json", "--method magic", "--strange"):
        document = run(f"{call} --jsonl {arguments}", code=2).json
        assert (document["capture"], document["exit_code"]) == (None, 2)


DENIED = PermissionError(errno.EACCES, "Permission denied", "sphere/image1.png")
FAILURES = {
    "unreadable image": (DENIED, 3),
    "bad input": (InputError("the image is damaged"), 3),
    "usage": (UsageError("too few lights"), 2),
    "defect": (RuntimeError("oops"), 1),
    "no memory": (MemoryError("too large"), 1),
}


@parametrize(
    "place", [(InferOptions, "open"), (LeastSquares, "estimate")], ids=["open", "estimate"]
)
def test_a_failure_is_that_of_its_capture(place, make_capture, run, monkeypatch):
    """The others go on, whatever is raised and wherever."""
    names = [str(make_capture(name)) for name in (*FAILURES, "good")]
    errors, original = iter([error for error, _ in FAILURES.values()]), getattr(*place)

    def fail(*arguments, **options):
        if (error := next(errors, None)) is not None:
            raise error
        return original(*arguments, **options)

    monkeypatch.setattr(*place, fail)
    result = run("infer --method ls --json", *names, code=1)
    *failed, good = result.json
    expected = [(name, code) for name, (_, code) in FAILURES.items()]
    assert [(one["capture"], one["exit_code"]) for one in failed] == expected
    assert good == read_report("good")
    assert failed[0]["error"] == "sphere/image1.png: cannot be read (Permission denied)."
    assert all(f"splinecli: {one['error']}\n" in result.err for one in failed)
    assert result.err.count("Traceback") == 1
    assert "RuntimeError: oops. This is a defect of splinecli. Please report it" in result.err


def test_files_without_permission(make_capture, run_without_privileges):
    """The parser must not refuse a folder: it would end the batch before the first capture."""
    closed, image, good = (make_capture(name) for name in ("closed", "image", "good"))
    (image / "image1.png").chmod(0)
    closed.chmod(0)
    result = run_without_privileges(f"infer {closed} {image} {good} --method ls --json", code=3)
    closed.chmod(0o755)
    first, second, third = result.json
    assert (first["exit_code"], second["exit_code"]) == (3, 3)
    assert first["error"] == "closed: the folder cannot be read (Permission denied)."
    assert "image/image1.png" in second["error"]
    assert third == read_report("good")


def test_what_is_no_folder_is_the_failure_of_its_capture(capture, run):
    """A pattern such as captures/* may match files too; they do not stop the captures."""
    put("notes.txt", "mine")
    result = run(f"infer nowhere notes.txt {capture} --method ls --json", code=3)
    first, second, third = result.json
    missing = {"capture": "nowhere", "error": "nowhere: the folder does not exist.", "exit_code": 3}
    assert first == missing
    assert "notes.txt: found a file, expected a folder" in second["error"]
    assert third == read_report()
    # Earlier results of other options do not hide it.
    capture.rename("moved")
    says = ("sphere: the folder does not exist", "2 captures: 1 done, 1 missing; see out/index")
    run("infer sphere moved --method ls --n-lights 4", input_error=says)


@parametrize("workers", [1, 2])
def test_folders_that_cannot_be_written_do_not_end_a_batch(
    make_capture, run_without_privileges, workers
):
    names = ["closed", "file", "good"]
    for name in names:
        make_capture(name)
    Path("out/closed").mkdir(parents=True, mode=0o555)
    put("out/file", "mine")
    call = f"infer --method ls --jsonl --workers {workers}"
    lines = run_without_privileges(call, *names, code=5).out.splitlines()
    found = {document["capture"]: document for document in map(json.loads, lines)}
    assert (found["closed"]["exit_code"], found["file"]["exit_code"]) == (5, 5)
    assert found["closed"]["error"].startswith("out/closed: no permission to write to this folder")
    assert found["good"] == read_report("good")


@parametrize("error", [NoRoomError("full"), OSError(errno.ENOSPC, "No space left on device")])
def test_a_full_disk_ends_a_batch(error, capture, make_capture, run, monkeypatch):
    monkeypatch.setattr("splinecli.results.files.write_estimate", Mock(side_effect=error))
    result = run(f"infer {capture} {make_capture('second')} --method ls --json", code=5)
    (document,) = result.json
    assert (document["capture"], document["exit_code"]) == (None, 5)
    assert not Path("out/second").exists()


def test_images_in_place_of_their_folder(run, capture):
    message = (
        "splinecli: 8 images were given, expected the folder with the images. Pass the folder"
        " 'sphere'.\n"
    )
    run("infer --method ls", *sorted(capture.glob("image*.png")), code=2, err=message)


@parametrize("count, captures", [(1, 5), (3, 0), (7, 23), (40, 23)])
def test_the_union_of_the_shards_is_the_whole(count, captures, tmp_path):
    """Each shard sees the folders in an order of its own, as shells of different languages give
    it.
    """
    names = [f"{'aBéz'[index % 4]}{index}" for index in range(captures)]
    for name in names:
        (tmp_path / name).mkdir()
    rng, parts = random.Random(0), []
    for number in range(1, count + 1):
        folders = [tmp_path / name for name in rng.sample(names, captures)]
        parts.append([member.name for member in list_captures(folders, Shard(number, count))])
        assert parts[-1] == [folder.name for folder in folders if folder.name in parts[-1]]
    assert sorted(name for part in parts for name in part) == sorted(names)
    assert max(map(len, parts)) - min(map(len, parts)) <= 1


@parametrize("text", f"1 0/3 4/3 1/0 -1/3 a/b 1/3/5 1.0/3 {'9' * 30}/1")
def test_other_shards_are_refused(text):
    with refuses("--shard is", UsageError):
        Shard.parse(text)


def test_captures_of_one_name_in_different_shards(tmp_path):
    folders = [tmp_path / place / "same" for place in "ab"]
    for folder in folders:
        folder.mkdir(parents=True)
    with refuses("have the same name", UsageError):
        list_captures([*folders, Path("none")], Shard(1, 3))
