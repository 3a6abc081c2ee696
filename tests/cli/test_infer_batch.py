"""One capture and many: what is skipped, kept or redone, failures, the exit code, the JSON and the index."""

from __future__ import annotations

import base64
import errno
import json
import os
import pickle
import re
from collections.abc import Callable
from pathlib import Path
from urllib.parse import unquote

import cv2
import numpy as np
import pytest
import tifffile

from splinecli import inference
from splinecli.capture import source
from splinecli.errors import InputError, OutputError, UsageError
from splinecli.files import UNFINISHED
from splinecli.methods.least_squares import LeastSquares
from splinecli.pipeline import distillation, input_checks, surface
from splinecli.pipeline.batch import infer_batch, worst_exit_code
from splinecli.pipeline.infer import infer_capture
from splinecli.pipeline.infer_options import InferOptions
from splinecli.pipeline.observer import Observer
from splinecli.publishing import UNDONE
from splinecli.results import albedo, clock, files


def read_report(folder: Path) -> dict:
    return json.loads((folder / "report.json").read_text("utf-8"))


def test_refuses_to_overwrite(capture, run, golden):
    run("infer", capture, "--method", "ls")
    before = read_report(Path("out/sphere"))
    result = run("infer", capture, "--method", "ls", "--n-lights", 4)
    assert (result.code, result.out) == (5, "")
    golden("error_exists.txt", result.err)
    assert read_report(Path("out/sphere")) == before
    assert run("infer", capture, "--method", "ls", "--n-lights", 4, "--overwrite").code == 0
    assert read_report(Path("out/sphere"))["n_lights"] == 4


def test_a_batch_goes_on_past_a_bad_capture(capture, make_capture, run, golden):
    make_capture("broken")
    Path("broken/image3.png").write_bytes(b"no picture")
    make_capture("third")
    result = run("infer", capture, "broken", "third", "--method", "ls")
    assert result.code == 3
    golden("batch.out.txt", result.out)
    golden("batch.err.txt", re.sub(r"[0-9]+\.[0-9]$", "SECONDS", result.err, flags=re.MULTILINE))
    assert sorted(path.name for path in Path("out").iterdir()) == ["index.html", "sphere", "third"]

    documents = json.loads(run("infer", capture, "broken", "--method", "ls", "--json", "--overwrite").out)
    assert documents[0] == read_report(Path("out/sphere"))
    assert documents[1]["capture"] == "broken"
    assert "image3.png" in documents[1]["error"]


@pytest.mark.parametrize(
    "arguments",
    [("--n-lights", 2), ("--light-indices", "0,0,1"), ("--device", "cuda"), ("--weights", "spline-net")],
)
def test_usage_errors_end_a_batch_at_once(arguments, capture, make_capture, run, monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    make_capture("second")
    method = "spline-net" if "--device" in arguments else "ls"
    result = run("infer", capture, "second", "--method", method, *arguments)
    assert (result.code, result.out, result.err.count("\n")) == (2, "", 1)
    assert not Path("out").exists()


def test_a_batch_goes_on_where_it_ended(capture, make_capture, run):
    make_capture("second")
    broken = make_capture("third") / "image3.png"
    whole = broken.read_bytes()
    broken.write_bytes(b"no picture")
    captures = ("sphere", "second", "third")
    first = run("infer", *captures, "--method", "ls")
    assert (first.code, "3 captures: 2 done, 1 failed; see" in first.err) == (3, True)
    before = {name: (Path("out") / name / "normals.npy").stat().st_mtime_ns for name in captures[:2]}
    broken.write_bytes(whole)
    Path("out", f".index.html.x{UNFINISHED}").touch()  # a killed process was writing this
    again = run("infer", *captures, "--method", "ls")
    assert again.code == 0
    assert f"splinecli: warning: out: {UNDONE}" in again.err
    assert again.out.startswith("out/third: ")
    assert "out/second: already done, skipped\n" in again.err
    assert again.err.endswith("3 captures: 1 done, 2 already done; see out/index.html\n")
    assert before == {name: (Path("out") / name / "normals.npy").stat().st_mtime_ns for name in before}
    # The same in JSON has all reports.
    reports = json.loads(run("infer", *captures, "--method", "ls", "--json").out)
    assert [report["capture"] for report in reports] == list(captures)


def change_light_file(capture: Path) -> tuple[str, ...]:
    light = capture / "light_directions.txt"
    light.write_text(light.read_text() + "# measured anew\n")
    return ()


def change_the_version(capture: Path) -> tuple[str, ...]:
    path = Path("out") / capture / "report.json"
    path.write_text(path.read_text().replace('"version": "', '"version": "0.0.'))
    return ()


CHANGES = {
    "made with another --n-lights": lambda _: ("--n-lights", "4"),
    "other input files": change_light_file,
    "made by version 0.0.": change_the_version,
}


@pytest.mark.parametrize("reason", CHANGES)
@pytest.mark.parametrize("others", [(), ("second",)], ids=["one", "several"])
def test_changed_captures_are_kept_or_redone(capture, make_capture, run, reason, others):
    """One capture and several obey the same rules."""
    make_capture("second")
    call = ("infer", capture, *others, "--method", "ls")
    assert run(*call).code == 0
    extra = CHANGES[reason](capture)
    before = (Path("out/sphere/normals.npy").stat().st_mtime_ns, read_report(Path("out/sphere")))
    kept = run(*call, *extra)
    assert (kept.code, kept.out) == (5, "")
    line = next(line for line in kept.err.splitlines() if "out/sphere: " in line)
    assert reason in line
    assert "Add --update to redo what changed, --overwrite to redo everything" in line
    assert (Path("out/sphere/normals.npy").stat().st_mtime_ns, read_report(Path("out/sphere"))) == before
    first, *_ = json.loads(run(*call, *extra, "--json").out)
    assert (first["capture"], first["exit_code"], reason in first["error"]) == ("sphere", 5, True)
    updated = run(*call, *extra, "--update")
    assert updated.code == 0
    assert Path("out/sphere/normals.npy").stat().st_mtime_ns > before[0]
    if others and not extra:
        assert "out/second: already done, skipped" in updated.err
    assert run(*call, *extra).code == 0


def link_elsewhere(path: Path) -> None:
    path.rename("elsewhere")
    path.symlink_to(Path("elsewhere").absolute())


def surrogate_among_files(path: Path) -> None:
    report = json.loads(path.read_text())
    path.write_text(json.dumps({**report, "files": ["\ud800"]}))


UNFINISHED_FOLDERS: dict[str, tuple[str, Callable[[Path], object], str]] = {
    "no report": ("report.json", Path.unlink, "has no report.json"),
    "linked report": ("report.json", link_elsewhere, "has no report.json"),
    "missing": ("normals.png", Path.unlink, "normals.png is missing"),
    "linked": ("normals.npy", link_elsewhere, "normals.npy is missing"),
    "cut short": ("normals.npy", lambda path: os.truncate(path, 100), "normals.npy has another size than"),
    "no such name": ("report.json", surrogate_among_files, "\\ud800 is missing"),
}


@pytest.mark.parametrize("name", UNFINISHED_FOLDERS)
def test_an_unfinished_folder_is_computed_again(capture, run, name):
    call = ("infer", capture, "--method", "ls")
    assert run(*call).code == 0
    whole = {path.name: path.stat().st_size for path in Path("out/sphere").iterdir()}
    file, damage, reason = UNFINISHED_FOLDERS[name]
    damage(Path("out/sphere", file))
    elsewhere = Path("elsewhere").read_bytes() if Path("elsewhere").exists() else None
    again = run(*call)
    assert (again.code, again.out[:11]) == (0, "out/sphere:")
    assert reason in again.err
    assert "so it is computed again" in again.err
    assert {path.name: path.stat().st_size for path in Path("out/sphere").iterdir()}.keys() == whole.keys()
    assert not any(path.is_symlink() for path in Path("out/sphere").iterdir())
    assert elsewhere in (None, Path("elsewhere").read_bytes() if elsewhere else b"")
    report = read_report(Path("out/sphere"))
    sizes = {
        path.name: path.stat().st_size for path in Path("out/sphere").iterdir() if path.suffix != ".json"
    }
    assert report["file_sizes"] == sizes
    assert "already done, skipped" in run(*call).err


def test_an_edited_mask_and_an_integrated_surface_stay(capture, run):
    (capture / "mask.png").unlink()
    call = ("infer", capture, "--method", "ls", "--auto-mask", "--surface")
    assert run(*call, "--overwrite").code == 0
    assert run("integrate", "out/sphere", "--format", "ply", "--stiffness", 0, "--overwrite").code == 0
    assert run("integrate", "out/sphere", "--format", "ply", "--overwrite").code == 0
    with Path("out/sphere/found_mask.png").open("ab") as file:
        file.write(b"edited")
    assert "already done, skipped" in run(*call).err


def test_files_of_the_user_in_the_capture_are_kept(capture, run):
    (capture / "normals.png").write_text("drawn by hand")
    for update in ((), ("--update",)):
        result = run("infer", capture, "--method", "ls", "-o", capture.parent, *update)
        assert result.code == 5
        assert "sphere: contains normals.png, but no report.json" in result.err
        assert "Add --overwrite" in result.err
    assert (capture / "normals.png").read_text() == "drawn by hand"


def test_a_link_in_the_place_of_a_result_folder_fails_its_capture_only(capture, make_capture, run):
    make_capture("second")
    Path("elsewhere").mkdir()
    Path("out").mkdir()
    Path("out/sphere").symlink_to(Path("elsewhere").absolute())
    for overwrite in ((), ("--overwrite",)):
        result = run("infer", capture, "second", "--method", "ls", *overwrite)
        assert (result.code, "out/sphere: found a link, expected a folder" in result.err) == (5, True)
        assert Path("out/second/report.json").is_file()
        assert not list(Path("elsewhere").iterdir())


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("files", [1, 2]),
        ("files", ["\ud800"]),
        ("files", ["../../kept"]),
        ("files", {"a": 1}),
        ("file_sizes", 5),
        ("file_sizes", None),
        ("warnings", [1]),
        ("warnings", [{"text": ["\ud800"]}]),
        ("seconds", {"read": "x"}),
        ("n_pixels", "\ud800"),
        ("angular_error_deg", {"mean": []}),
        ("capture", "\ud800"),
        ("error", ["\ud800"]),
    ],
)
def test_a_bad_report_of_another_capture_is_no_matter(capture, make_capture, run, key, value):
    make_capture("second")
    assert run("infer", "second", "--method", "ls").code == 0
    path = Path("out/second/report.json")
    Path("kept").touch()
    path.write_text(json.dumps({**json.loads(path.read_text()), key: value}))
    make_capture("third")
    result = run("infer", capture, "third", "--method", "ls")
    assert (result.code, "Traceback" in result.err) == (0, False)
    page = Path("out/index.html").read_text("utf-8")
    assert "sphere" in page and "third" in page
    # The same where the capture itself comes next.
    assert run("infer", "second", "--method", "ls", "--update").code == 0
    assert json.loads(path.read_text())["capture"] == "second"


def test_contradicting_options(capture, run):
    both = run("infer", capture, "--method", "ls", "--update", "--overwrite")
    assert (both.code, "contradict each other" in both.err) == (2, True)


def test_another_object_of_the_same_name(capture, make_capture, run):
    make_capture("third")
    assert run("infer", capture, "--method", "ls").code == 0
    Path("others").mkdir()
    Path("others/sphere").symlink_to(Path("third").absolute())
    other = run("infer", "others/sphere", "--method", "ls")
    assert (other.code, "out/sphere: contains results made from other input files" in other.err) == (5, True)


def test_links_are_called_by_their_own_names(capture, run):
    for link in ("x/obj", "y/obj", "one", "two"):
        Path(link).parent.mkdir(exist_ok=True)
        Path(link).symlink_to(capture.absolute())
    assert run("infer", "x/obj", "y/obj", "--method", "ls").code == 2
    assert run("infer", "one", "two", "--method", "ls").code == 0
    assert sorted(path.name for path in Path("out").iterdir()) == ["index.html", "one", "two"]


def test_two_kinds_of_images_of_a_cyclesps_object(capture, run):
    holder = capture.parent / "Ball"
    for kind in ("specular", "metallic"):
        (holder / f"images_{kind}").mkdir(parents=True)
        for index in range(8):
            picture = cv2.imread(str(capture / f"image{index + 1}.png"), cv2.IMREAD_UNCHANGED)
            tifffile.imwrite(holder / f"images_{kind}/{index:05}.tif", np.dstack([picture] * 3))
    (holder / "light.txt").write_bytes((capture / "light_directions.txt").read_bytes())
    for name in ("inboundary.png", "onboundary.png"):
        (holder / name).write_bytes((capture / "mask.png").read_bytes())
    result = run("infer", holder / "images_specular", "Ball/images_metallic", "--method", "ls")
    assert result.code == 0
    assert result.err.endswith("2 captures: 2 done; see out/index.html\n")
    assert {path.name for path in Path("out").iterdir()} == {"index.html", "Ball_specular", "Ball_metallic"}
    assert read_report(Path("out/Ball_metallic"))["capture"] == "Ball_metallic"
    # An object with several kinds is passed over among others, under its own name.
    result = run("infer", holder, capture, "--method", "ls", "--overwrite")
    assert result.code == 3
    assert "Ball: found 2 folders of images (images_metallic, images_specular)" in result.err


def test_an_index_of_several_captures(capture, make_capture, run):
    make_capture("a b")
    make_capture("broken")
    Path("broken/image3.png").write_bytes(b"no picture")
    Path("out").mkdir()
    Path("out/index.html").write_text("<html>my site</html>", "utf-8")
    captures = (capture, "a b", "broken", "--method", "ls", "--html")
    kept = run("infer", *captures)
    assert (kept.code, "index.html: was not written by splinecli" in kept.err) == (5, True)
    Path("out/index.html").unlink()
    assert run("infer", *captures).code == 3
    index = Path("out/index.html").read_text("utf-8")
    links = re.findall(r'href="([^"]+)"', index)
    assert {"sphere/page.html", "a%20b/page.html", "sphere/normals.npy"} <= set(links)
    assert all((Path("out") / unquote(link)).is_file() for link in links)
    assert "found neither PNG, TIFF nor JPEG" in index
    pages = re.findall(r'<img src="data:image/jpeg;base64,([^"]+)" alt="Normal map of ([^"]+)"', index)
    assert [name for _, name in pages] == ["sphere", "a b"]
    normals = cv2.imread("out/sphere/normals.png", cv2.IMREAD_UNCHANGED) / 257
    small = cv2.imdecode(np.frombuffer(base64.b64decode(pages[0][0]), np.uint8), cv2.IMREAD_COLOR)
    assert small.shape == normals.shape  # it is small already
    assert np.abs(small - normals).mean() < 7  # JPEG halves the resolution of colours; exchanged channels: 40
    assert run("infer", *captures).code == 3  # our own index is replaced
    # Later results in the same place join it, and those of a single capture, too.
    make_capture("fourth")
    make_capture("fifth")
    assert run("infer", "fourth", "a b", "--method", "ls", "--overwrite").code == 0
    assert run("infer", "fifth", "--method", "ls").code == 0
    links = re.findall(r'href="([^"]+)"', Path("out/index.html").read_text("utf-8"))
    assert {f"{name}/normals.npy" for name in ("sphere", "a%20b", "fourth", "fifth")} <= set(links)
    assert len([link for link in links if link == "a%20b/normals.npy"]) == 1
    Path("place/index.html").mkdir(parents=True)
    assert run("infer", capture, "fourth", "--method", "ls", "-o", "place", "--overwrite").code == 5


def test_names_that_are_no_text(capture, make_capture, run):
    odd = make_capture("odd").rename(os.fsdecode(b"x\xff"))
    assert run("infer", capture, odd, "--method", "ls").code == 0
    assert 'href="x%FF/normals.npy"' in Path("out/index.html").read_text("utf-8")


def test_a_defect_is_called_one(capture, run, monkeypatch):
    def fail(*_: object, **__: object) -> None:
        raise ZeroDivisionError("oops")

    monkeypatch.setattr(LeastSquares, "estimate", fail)
    result = run("infer", capture, "--method", "ls")
    assert result.code == 1
    assert "ZeroDivisionError: oops" in result.err
    assert result.err.endswith(
        "splinecli: sphere: ZeroDivisionError: oops. This is a defect of splinecli."
        " Please report it with the lines above.\n"
    )


FAILURES = {
    "unreadable image": (PermissionError(errno.EACCES, "Permission denied", "sphere/image1.png"), 3),
    "bad input": (InputError("the image is damaged"), 3),
    "usage": (UsageError("too few lights"), 2),
    "defect": (RuntimeError("oops"), 1),
    "no memory": (MemoryError("too large"), 1),
}


@pytest.mark.parametrize("failure", FAILURES)
@pytest.mark.parametrize("place", ["open", "estimate"])
def test_a_failure_is_that_of_its_capture(failure, place, capture, make_capture, run, monkeypatch):
    """The others go on, whatever is raised and wherever."""
    make_capture("second")
    error, code = FAILURES[failure]
    target = {"open": (InferOptions, "open"), "estimate": (LeastSquares, "estimate")}[place]
    original, calls = getattr(*target), []

    def fail_first(*arguments: object, **options: object) -> object:
        calls.append(arguments)
        if len(calls) == 1:
            raise error
        return original(*arguments, **options)

    monkeypatch.setattr(*target, fail_first)
    result = run("infer", capture, "second", "--method", "ls", "--json")
    assert result.code == code
    first, second = json.loads(result.out)
    assert (first["capture"], first["exit_code"], second["capture"]) == ("sphere", code, "second")
    assert second == read_report(Path("out/second"))
    if failure == "unreadable image":
        assert first["error"] == "sphere/image1.png: cannot be read (Permission denied)."
    assert ("Traceback" in result.err) == (failure == "defect")
    assert f"splinecli: {first['error']}\n" in result.err


def test_an_image_without_permission(capture, make_capture, run_without_privileges):
    make_capture("second")
    (capture / "image1.png").chmod(0)
    result = run_without_privileges("infer", capture, "second", "--method", "ls")
    assert (result.code, "sphere/image1.png" in result.err) == (3, True)
    assert Path("out/second/report.json").is_file()


def test_a_folder_without_permission(capture, make_capture, run_without_privileges):
    """The parser must not refuse it: it would end the batch before the first capture."""
    make_capture("second")
    capture.chmod(0)
    result = run_without_privileges("infer", capture, "second", "--method", "ls", "--json")
    capture.chmod(0o755)
    first, second = json.loads(result.out)
    assert (result.code, first["capture"], first["exit_code"]) == (3, "sphere", 3)
    assert first["error"] == "sphere: the folder cannot be read (Permission denied)."
    assert second == read_report(Path("out/second"))


def test_a_light_file_without_permission(capture, run_without_privileges):
    lights = Path("lights.txt")
    lights.write_bytes((capture / "light_directions.txt").read_bytes())
    lights.chmod(0)
    result = run_without_privileges("infer", capture, "--lights", lights, "--method", "ls", "--json")
    (document,) = json.loads(result.out)
    assert (result.code, document["exit_code"], "lights.txt" in document["error"]) == (3, 3, True)


def test_a_missing_folder_is_the_failure_of_its_capture(capture, run):
    result = run("infer", "nowhere", capture, "--method", "ls", "--json")
    first, second = json.loads(result.out)
    assert (result.code, first) == (
        3,
        {"capture": "nowhere", "error": "nowhere: the folder does not exist.", "exit_code": 3},
    )
    assert second == read_report(Path("out/sphere"))
    assert result.err.endswith("2 captures: 1 done, 1 missing; see out/index.html\n")
    # Earlier results of other options do not hide it.
    capture.rename("moved")
    gone = run("infer", "sphere", "moved", "--method", "ls", "--n-lights", 4)
    assert (gone.code, "sphere: the folder does not exist" in gone.err) == (3, True)
    assert Path("out/moved/report.json").is_file()


def test_a_folder_that_is_given_twice_counts_once(capture, run):
    result = run(
        "infer", capture, capture.absolute(), "others/../sphere", "sphere/", "--method", "ls", "--json"
    )
    (document,) = json.loads(result.out)
    assert (result.code, result.err, document["capture"]) == (0, "", "sphere")
    assert not Path("out/index.html").exists()


@pytest.mark.parametrize(
    "error", [OutputError("the folder is full"), OSError(errno.ENOSPC, "No space left on device")]
)
def test_a_full_disk_ends_a_batch(error, capture, make_capture, run, monkeypatch):
    make_capture("second")

    def fail(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr("splinecli.results.files.write_estimate", fail)
    result = run("infer", capture, "second", "--method", "ls", "--json")
    (document,) = json.loads(result.out)
    assert (result.code, document["capture"], document["exit_code"]) == (5, None, 5)
    assert not Path("out/second").exists()


def test_the_worst_exit_code():
    assert worst_exit_code([]) == 0
    assert worst_exit_code([0, 3, 0]) == 3
    assert worst_exit_code([5, 3, 2]) == 5
    assert worst_exit_code([5, 1, 3]) == 1  # a defect


def test_a_folder_of_photographs_and_a_stray_file(capture, run):
    """A pattern such as captures/* may match files too; they do not stop the captures."""
    Path("notes.txt").write_text("mine")
    result = run("infer", capture, "notes.txt", "--method", "ls")
    assert (result.code, "notes.txt: found a file, expected a folder" in result.err) == (3, True)
    assert Path("out/sphere/report.json").is_file()


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (
            ("--maps", "albedo", "confidence"),
            2,
            "confidence: the folder does not exist. Write lists with commas",
        ),
        (("--lights", "none.txt"), 3, "none.txt: the file does not exist."),
        (("--mask", "none.png"), 3, "none.png: the file does not exist."),
        (("--intensities", "none.txt"), 3, "none.txt: the file does not exist."),
        (("--ground-truth", "none.mat"), 3, "none.mat: the file does not exist."),
        (("--ambient", "none.png"), 3, "none.png: the file does not exist."),
        (("--flat-field", "none"), 3, "none: the folder does not exist."),
        (("--maps", "albedo,depth"), 2, "--maps has 'depth'"),
        (("--format", "bmp"), 2, "--format has 'bmp'"),
        (("--method", "magic"), 2, "no method named 'magic'"),
        (("--transfer", "rec709"), 2, "the transfer curve is 'rec709'"),
        (("--white-level", "0"), 2, "the white level is 0, expected a number above 0"),
        (("--weights", "spline-net"), 2, "method ls uses no weights"),
        (("--maps", "confidence"), 2, "method ls gives no confidence"),
        (("--update", "--overwrite"), 2, "--overwrite and --update contradict each other"),
    ],
)
def test_arguments_are_checked_before_the_first_capture(
    arguments, code, message, capture, make_capture, run, monkeypatch
):
    make_capture("second")
    touched = []
    monkeypatch.setattr("splinecli.pipeline.member.infer_capture", lambda *_, **__: touched.append(1))
    method = () if "--method" in arguments else ("--method", "ls")
    result = run("infer", capture, "second", *method, *arguments)
    assert (result.code, result.out, touched) == (code, "", [])
    assert message in result.err
    assert not Path("out").exists()
    documents = json.loads(run("infer", capture, "second", *method, *arguments, "--json").out)
    assert [document["exit_code"] for document in documents] == [code]
    assert message in documents[0]["error"]


def test_json_is_a_list_also_where_nothing_could_be_read(run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = run("infer", "nofolder", "--json")
    assert result.code == 3
    assert json.loads(result.out) == [
        {"capture": "nofolder", "error": "nofolder: the folder does not exist.", "exit_code": 3}
    ]
    assert result.err == "splinecli: nofolder: the folder does not exist.\n"


def test_options_are_written_and_read_back(capture, run):
    """They are the report's `options`, go through JSON and pickle, and tell what changes the results."""
    options = InferOptions(
        method="ls",
        n_lights=5,
        seed=3,
        formats=("npy",),
        maps=("albedo",),
        white_level=60_000.5,
        output="elsewhere",
    )
    assert InferOptions.from_dict(json.loads(json.dumps(options.as_dict()))) == options
    assert pickle.loads(pickle.dumps(options)) == options
    assert infer_capture(capture, options)["options"] == options.as_dict()
    assert read_report(Path("elsewhere/sphere"))["options"] == options.as_dict()
    assert options == InferOptions.from_dict({**options.as_dict(), "output": "x", "device": "cpu"})
    assert options != InferOptions.from_dict({**options.as_dict(), "seed": 4})
    for wrong in (
        {"formats": ("bmp",)},
        {"maps": ("depth",)},
        {"convention": "up"},
        {"mask": "m.png", "auto_mask": True},
    ):
        with pytest.raises(UsageError):
            InferOptions(**wrong)


def test_the_pipeline_reports_to_an_observer(capture, make_capture):
    make_capture("second")
    (capture / "mask.png").unlink()

    class Recorder(Observer):
        def __init__(self) -> None:
            self.stages: list[tuple[str, float]] = []

        def progress(self, label, total, *, start=0.0, unit=""):
            self.stages.append((label, total))
            return super().progress(label, total, start=start)

    recorder = Recorder()
    outcomes = list(infer_batch([capture, Path("second")], InferOptions(method="ls"), recorder))
    assert [(one.capture, one.status, one.exit_code) for one in outcomes] == [
        ("sphere", "done", 0),
        ("second", "done", 0),
    ]
    assert recorder.stages == [
        ("sphere: reading", 8),
        ("sphere: estimating", 576),
        ("second: reading", 8),
        ("second: estimating", 448),
    ]


@pytest.mark.parametrize("stage", ["reading", "estimating"])
@pytest.mark.parametrize("name", ["light_directions.txt", "image3.png"])
def test_a_file_that_changes_during_the_run_is_read_anew_in_the_next(capture, stage, name):
    """The report states the files that were used, not those that lie there at the end."""

    class Meddler(Observer):
        def progress(self, label, total, *, start=0.0, unit=""):
            if label == f"sphere: {stage}":
                (capture / name).write_bytes((capture / name).read_bytes() + b"\n")
            return super().progress(label, total)

    def status(observer: Observer) -> str:
        (outcome,) = infer_batch([capture], InferOptions(method="ls"), observer, redo="changed")
        return outcome.status

    assert [status(Meddler()), status(Observer()), status(Observer())] == ["done", "done", "skipped"]


def test_the_report_states_the_seconds_of_all_stages(capture, monkeypatch):
    now = 0.0

    def takes(seconds: float, function):
        def call(*arguments, **options):
            nonlocal now
            now += seconds
            return function(*arguments, **options)

        return call

    monkeypatch.setattr(clock.time, "perf_counter", lambda: now)
    for module, name, seconds in (
        (source.CaptureSource, "read", 1),
        (input_checks, "check_capture", 10),
        (distillation, "distil_for", 100),
        (inference, "estimate_normals", 1000),
        (albedo, "albedo_map", 10_000),
        (surface, "make_surface", 100_000),
        (files, "write_normals", 1_000_000),
    ):
        monkeypatch.setattr(module, name, takes(seconds, getattr(module, name)))
    options = InferOptions(method="ls", surface=True, maps=("albedo",), formats=("npy",))
    found = infer_capture(capture, options)["seconds"]
    assert {stage: seconds for stage, seconds in found.items() if seconds} == {
        "read": 1, "check": 10, "distil": 100, "estimate": 1000, "pictures": 10_000, "surface": 100_000,
        "write": 1_000_000, "total": 1_111_111,
    }  # fmt: skip
    assert list(found) == [*clock.STAGES, "total"]


def test_as_stored_is_named_and_a_white_level_is_used(capture, run):
    for path in capture.glob("image*.png"):
        picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        cv2.imwrite(str(path), np.minimum(picture, 57_000).astype(np.uint16))
    call = ("infer", capture, "--method", "ls", "--overwrite", "--json", "--white-level", 57_000)
    restored, stored = (json.loads(run(*call, *extra).out)[0] for extra in ((), ("--as-stored",)))
    assert (restored["reading"], stored["reading"]) == ("restored", "as stored")
    assert restored["white_level"] == {"value": 57_000, "origin": "given"}
    assert restored["angular_error_deg"]["mean"] < 0.1 < stored["angular_error_deg"]["mean"]
    assert restored["options"]["white_level"] == 57_000


def test_shards_give_the_results_of_the_whole(capture, make_capture, run):
    names = ["sphere", *map(str, (make_capture(name) for name in ("Second", "third", "\u00e9")))]
    assert run("infer", *names, "--method", "ls", "-o", "whole").code == 0
    for number in (3, 1, 2, 5, 4):
        result = run("infer", *names, "--method", "ls", "--shard", f"{number}/5")
        assert result.code == 0
        assert result.out.count("\n") == (number < 5)
    for name in names:
        parts = [Path(place, name, "normals.npy").read_bytes() for place in ("out", "whole")]
        assert parts[0] == parts[1]
    links = re.findall(r'href="([^"]+normals.npy)"', Path("out/index.html").read_text("utf-8"))
    assert sorted(unquote(link) for link in links) == sorted(f"{name}/normals.npy" for name in names)


def test_json_lines(capture, make_capture, run):
    """Each line is there when its capture ends, also where an error ends the batch."""
    make_capture("second")
    Path("broken").mkdir()
    call = ("infer", "sphere", "broken", "second", "--method", "ls")
    lines = run(*call, "--jsonl").out.splitlines()
    assert lines == [json.dumps(document) for document in json.loads(run(*call, "--json").out)]
    for arguments in (("--jsonl", "--json"), ("--jsonl", "--method", "magic"), ("--jsonl", "--strange")):
        result = run(*call, *arguments)
        document = json.loads(result.out)
        assert (result.code, document["capture"], document["exit_code"]) == (2, None, 2)
