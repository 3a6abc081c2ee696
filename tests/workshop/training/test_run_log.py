"""The log files of a run: metrics.csv and TensorBoard's events."""

import csv
from dataclasses import fields, replace

import pytest

from scenes import parametrize
from splinecli.workshop.training import EVENTS, METRICS
from splinecli.workshop.training.run_files import Metrics, RunLog, read_metrics

ROWS = [
    Metrics(50, 800, 0.1, 1e-3, 2.0, 20.0, 0.2, 0.1),
    Metrics(100, 1600, 0.2, 9e-4, 1.0, 10.0, 0.1, 0.05, 0.5, 7.25, 12.5),
    Metrics(125, 2000, 0.25, 8e-4, 0.5, 8.0, 0.08, 0.04, None, None, 9.0),
]


def log_of(folder, rows=ROWS, *, tensorboard=False):
    log = RunLog(folder, 0, tensorboard=tensorboard)
    for row in rows:
        log.append(row)


def test_metrics_round_trip(tmp_path):
    log_of(tmp_path)
    assert read_metrics(tmp_path / METRICS) == ROWS
    header, first, *_ = (tmp_path / METRICS).read_text().splitlines()
    assert header == ",".join(field.name for field in fields(Metrics))
    assert first == "50,800,0.1,0.001,2,20,0.2,0.1,,,"
    with (tmp_path / METRICS).open(newline="") as file:
        assert len(list(csv.reader(file))) == 4


@parametrize("step, kept", [(49, 0), (50, 1), (10**6, 3)])
def test_lines_of_a_later_step_are_dropped(tmp_path, step, kept):
    log_of(tmp_path)
    again = RunLog(tmp_path, step)
    assert (tmp_path / METRICS).exists() == (kept > 0)
    again.append(replace(ROWS[2], step=10**6 + 1))
    assert read_metrics(tmp_path / METRICS) == [*ROWS[:kept], replace(ROWS[2], step=10**6 + 1)]


@parametrize("step", ["9" * 5000, "²"])
def test_a_last_line_that_no_parser_likes_is_dropped(tmp_path, step):
    log_of(tmp_path, ROWS[:2])
    with (tmp_path / METRICS).open("a", encoding="utf-8") as file:
        file.write(f"{step},1" + ",1.0" * 9 + "\n")
    assert RunLog(tmp_path, 100).set_aside is None
    assert read_metrics(tmp_path / METRICS) == ROWS[:2]


def test_tensorboard_s_events(tmp_path):
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    log_of(tmp_path, tensorboard=True)
    events = EventAccumulator(str(tmp_path / EVENTS))
    events.Reload()
    losses = [(event.step, event.value) for event in events.Scalars("loss")]
    assert losses == [(50, 2.0), (100, 1.0), (125, 0.5)]
    assert [event.step for event in events.Scalars("validation_deg")] == [100, 125]
