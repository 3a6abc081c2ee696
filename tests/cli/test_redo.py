"""What an earlier run has left is skipped, kept, redone or refused; `splinecli watch` computes what
arrives once.
"""

import json
import os
import shutil
from functools import partial
from pathlib import Path
from unittest.mock import Mock

from cli.conftest import read_report
from scenes import names_in, parametrize, put, read_json, table
from splinecli.pipeline.batch import infer_batch
from splinecli.pipeline.infer_options import InferOptions
from splinecli.system.files import UNFINISHED
from splinecli.system.publishing import UNDONE
from splinecli.workshop.save_weights import save_weights
from tiny_networks import random_network


def test_refuses_to_overwrite(capture, run, golden):
    run(f"infer {capture} --method ls")
    before = read_report()
    golden("error_exists.txt", run(f"infer {capture} --method ls --n-lights 4", code=5, out="").err)
    assert read_report() == before
    run(f"infer {capture} --method ls --n-lights 4 --overwrite")
    assert read_report()["n_lights"] == 4


def test_a_batch_goes_on_where_it_ended(capture, make_capture, run):
    make_capture("second")
    broken = make_capture("third") / "image3.png"
    whole = broken.read_bytes()
    broken.write_bytes(b"no picture")
    captures = ("sphere", "second", "third")
    run("infer --method ls", *captures, input_error="3 captures: 2 done, 1 failed; see")
    before = [Path("out", name, "normals.npy").stat().st_mtime_ns for name in captures[:2]]
    broken.write_bytes(whole)
    Path("out", f".index.html.x{UNFINISHED}").touch()  # a killed process was writing this
    says = f"splinecli: warning: out: {UNDONE}", "out/second: already done, skipped\n"
    again = run("infer --method ls", *captures, says=says)
    assert again.out.startswith("out/third: ")
    assert again.err.endswith("3 captures: 1 done, 2 already done; see out/index.html\n")
    assert before == [Path("out", name, "normals.npy").stat().st_mtime_ns for name in captures[:2]]
    # The same in JSON has all reports.
    reports = run("infer --method ls --json", *captures).json
    assert [report["capture"] for report in reports] == list(captures)


def replace_in(path, old, new):
    put(path, path.read_text().replace(old, new, 1))
    return ""


CHANGES = {
    "made with another --n-lights": lambda _: "--n-lights 4",
    "other input files": lambda capture: replace_in(
        capture / "light_directions.txt", "\n", " # anew\n"
    ),
    "made by version 0.0.": lambda capture: replace_in(
        Path("out") / capture / "report.json", '"version": "', '"version": "0.0.'
    ),
}


@parametrize("reason", CHANGES)
@parametrize("others", ["", "second"], ids=["one", "several"])
def test_changed_captures_are_kept_or_redone(capture, make_capture, run, reason, others):
    """One capture and several obey the same rules."""
    make_capture("second")
    call = f"infer {capture} {others} --method ls"
    run(call)
    extra = CHANGES[reason](capture)
    normals = Path("out/sphere/normals.npy")
    before = normals.stat().st_mtime_ns, read_report()
    kept = run(f"{call} {extra}", code=5, out="")
    line = next(line for line in kept.err.splitlines() if "out/sphere: " in line)
    assert reason in line
    assert "Add --update to redo changed captures, --overwrite to redo everything" in line
    assert (normals.stat().st_mtime_ns, read_report()) == before
    first, *_ = run(f"{call} {extra} --json", code=5).json
    assert (first["capture"], first["exit_code"], reason in first["error"]) == ("sphere", 5, True)
    updated = run(f"{call} {extra} --update")
    assert normals.stat().st_mtime_ns > before[0]
    if others and not extra:
        assert "out/second: already done, skipped" in updated.err
    run(f"{call} {extra}")


def link_elsewhere(path):
    path.rename("elsewhere")
    path.symlink_to(Path("elsewhere").absolute())


def surrogate_among_files(path):
    put(path, json.dumps({**read_json(path), "files": ["\ud800"]}))


UNFINISHED_FOLDERS = {
    "no report": ("report.json", Path.unlink, "has no report.json"),
    "linked report": ("report.json", link_elsewhere, "has no report.json"),
    "missing": ("normals.png", Path.unlink, "normals.png is missing"),
    "linked": ("normals.npy", link_elsewhere, "normals.npy is missing"),
    "cut short": (
        "normals.npy",
        lambda path: os.truncate(path, 100),
        "the size of normals.npy differs from",
    ),
    "no such name": ("report.json", surrogate_among_files, "\\ud800 is missing"),
}


@parametrize("name", UNFINISHED_FOLDERS)
def test_an_unfinished_folder_is_computed_again(capture, run, name):
    call = f"infer {capture} --method ls"
    run(call)
    whole = names_in("out/sphere")
    file, damage, reason = UNFINISHED_FOLDERS[name]
    damage(Path("out/sphere", file))
    elsewhere = {path: path.read_bytes() for path in Path().glob("elsewhere")}
    assert run(call, says=(reason, "so the capture is computed again")).out[:11] == "out/sphere:"
    assert names_in("out/sphere") == whole
    assert not any(path.is_symlink() for path in Path("out/sphere").iterdir())
    assert {path: path.read_bytes() for path in elsewhere} == elsewhere
    sizes = {name: Path("out/sphere", name).stat().st_size for name in whole - {"report.json"}}
    assert read_report()["file_sizes"] == sizes
    run(call, says="already done, skipped")


def test_an_edited_mask_and_an_integrated_surface_stay(capture, run):
    (capture / "mask.png").unlink()
    call = f"infer {capture} --method ls --auto-mask --surface"
    run(f"{call} --overwrite")
    run("integrate out/sphere --format ply --discontinuity 0 --overwrite")
    run("integrate out/sphere --format ply --overwrite")
    with Path("out/sphere/found_mask.png").open("ab") as file:
        file.write(b"edited")
    run(call, says="already done, skipped")


def test_a_link_in_the_place_of_a_result_folder_fails_its_capture_only(capture, make_capture, run):
    make_capture("second")
    Path("elsewhere").mkdir()
    Path("out").mkdir()
    Path("out/sphere").symlink_to(Path("elsewhere").absolute())
    for overwrite in ("", "--overwrite"):
        says = "out/sphere: found a link, expected a folder"
        run(f"infer {capture} second --method ls {overwrite}", code=5, says=says)
        assert Path("out/second/report.json").is_file()
        assert not list(Path("elsewhere").iterdir())


BAD_REPORTS = r"""
files | [1, 2]
files | ["\ud800"]
files | ["../../kept"]
files | {"a": 1}
file_sizes | 5
file_sizes | null
warnings | [1]
warnings | [{"text": ["\ud800"]}]
seconds | {"read": "x"}
n_pixels | "\ud800"
angular_error_deg | {"mean": []}
capture | "\ud800"
error | ["\ud800"]
"""


def test_bad_reports_of_other_captures_are_no_matter(capture, make_capture, run):
    bad = table(BAD_REPORTS)
    names = [str(make_capture(f"c{number}")) for number in range(len(bad))]
    run("infer --method ls", *names)
    Path("kept").touch()
    for name, (key, value) in zip(names, bad, strict=True):
        path = Path("out", name, "report.json")
        put(path, json.dumps({**read_json(path), key: json.loads(value)}))
    assert "Traceback" not in run(f"infer {capture} {make_capture('third')} --method ls").err
    page = Path("out/index.html").read_text("utf-8")
    assert "sphere" in page and "third" in page
    # The same where the captures themselves come next.
    run("infer --method ls --update", *names)
    assert [read_json(Path("out", name, "report.json"))["capture"] for name in names] == names
    assert Path("kept").is_file()


def test_files_of_the_user_in_the_capture_are_kept(capture, run):
    put(capture / "normals.png", "drawn by hand")
    for update in ("", "--update"):
        says = "sphere: contains normals.png, but no report.json"
        run(f"infer {capture} --method ls -o {capture.parent} {update}", code=5, says=says)
    assert (capture / "normals.png").read_text() == "drawn by hand"


def test_other_weights_in_the_home_folder(capture, monkeypatch, tmp_path):
    """The command line expands `~`; from Python, it arrives as it is."""
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("USERPROFILE", str(tmp_path))
    options = InferOptions(weights="~/w.safetensors")
    for width, status in ((8, "done"), (8, "skipped"), (16, "changed")):
        save_weights(random_network(width=width), tmp_path / "w.safetensors")
        (outcome,) = infer_batch([capture], options)
        assert outcome.status == status


def test_captures_are_computed_as_they_arrive_and_only_once(
    run, capture, make_capture, monkeypatch
):
    """Something happens at each look at the folder; then Ctrl-C."""
    parts = Path("parts")
    (parts / "bad").mkdir(parents=True)
    (parts / "bad/done").touch()

    def look(steps):
        def sleep(seconds):
            if not steps:
                raise KeyboardInterrupt
            steps.pop(0)()

        monkeypatch.setattr("time.sleep", sleep)

    # Meanwhile, the folder is away for two looks.
    steps = [lambda: parts.rename("away"), lambda: None, lambda: Path("away").rename(parts)]
    copy = partial(shutil.copytree, capture, parts / "-first 1")
    look([*steps, copy, lambda: (parts / "-first 1/done").touch()])
    command = f"watch {parts} --marker done -- --method ls --jsonl -o out"
    result = run(command, code=130, says="parts: the folder is available again")
    failed, again, done = map(json.loads, result.out.splitlines())
    assert (failed["capture"], failed["exit_code"]) == ("bad", 3) and again == failed
    message = "parts: the folder cannot be read (No such file or directory). Waiting for it."
    assert result.err.count(message) == 1
    assert done["capture"] == "-first 1"
    assert done["method"] == "ls"
    before = Path("out/-first 1/report.json").stat().st_mtime_ns
    look([])
    run(command, code=130, says="out/-first 1: already done, skipped")
    assert Path("out/-first 1/report.json").stat().st_mtime_ns == before


def test_an_interruption_of_a_capture_ends_it(run, capture, monkeypatch):
    Path("parts").mkdir()
    capture.rename("parts/sphere")
    monkeypatch.setattr("splinecli.pipeline.batch.run_member", Mock(side_effect=KeyboardInterrupt))
    run("watch parts --settle 0 -- --method ls", code=130, says="interrupted")


REFUSED_OPTIONS = """
--json | --json prints a list at the end, but watch does not end
--shard 1/2 | --shard splits a list of captures
other | found other after '--', expected options for infer
-o sphere/../sphere | the results would be among the captures
--methd ls | no option --methd
--method lss | no method named 'lss'
--overwrite --update | cannot be used together
"""


@parametrize("options, problem", REFUSED_OPTIONS)
def test_wrong_options_are_refused(run, capture, options, problem):
    run(f"watch {capture} --settle 0 -- {options}", usage_error=problem)


def test_no_folder(run, capture):
    run("watch nowhere", input_error="nowhere: the folder cannot be read")
