"""Training configurations and presets, and the names of them that load without PyTorch."""

import json
from dataclasses import replace
from pathlib import Path

from scenes import parametrize, put, refuses
from splinecli.errors import ModelError, UsageError
from splinecli.workshop import training
from splinecli.workshop.options import parse_light_counts
from splinecli.workshop.training.config import (
    GENERATOR,
    PRESETS,
    TrainingConfig,
    check_resumable,
    configure,
    parse_parameter,
    parse_sources,
    preset,
    read_config_file,
)


@parametrize("name", list(PRESETS))
def test_round_trip_through_json(name):
    config = preset(name, seed=7, minutes=0.5)
    assert TrainingConfig.from_dict(json.loads(json.dumps(config.to_dict()))) == config


@parametrize(
    "values, message",
    [
        ({"pixels": ["wall_share"]}, "'pixels' is .* expected a table of settings"),
        ({"steps": 0}, "training setting 'steps' is 0; expected a whole number of at least 1"),
        ({"learning_rate": "fast"}, "'learning_rate' is 'fast'; expected a number of at least 0"),
        ({"pixels": {"wall_share": 1.5}}, "'wall_share' is 1.5; expected a number from 0 to 1"),
        ({"pixels": {"cast_shadows": 1}}, "'cast_shadows' is 1; expected true or false"),
        (
            {"pixels": {"min_lights": 9, "max_lights": 8}},
            "max_lights are 9, 10, 8; expected them in ascending order",
        ),
        (
            {"sources": {"set": True}},
            "'sources' is {'set': True}; expected a table in which each value is a number of at"
            " least 0",
        ),
    ],
)
def test_refused(values, message):
    with refuses(message, ModelError):
        TrainingConfig.from_dict(values)


def test_presets_by_name():
    # The paper's section 4; its code where that is silent (docs/train.md).
    paper = preset("paper").to_dict()
    published = {
        "batch_size": 128,
        "learning_rate": 1e-4,
        "steps": 200_000,
        "beta1": 0.9,
        "beta2": 0.999,
        "weight_decay": 0.0,
        "updates": "alternating",
        "ne_net_updates": 5,
        "symmetric_weight": 2e-2,
        "asymmetric_weight": 2e-5,
        "eta": 1.0,
        "lambda_c": 50.0,
    }
    assert paper | published == paper
    assert tuple(PRESETS) == training.PRESET_NAMES
    assert training.DEFAULT_PRESET in PRESETS


@parametrize("asked", [None, "compact"])
def test_a_toml_file_over_a_preset(tmp_path, asked):
    """A preset that is asked for by name comes before the file's."""
    text = (
        'preset = "paper"\nbatch_size = 64\n[pixels]\nwall_share = 0.3\n[network]\nmap_size = 16\n'
    )
    base = preset(asked or "paper")
    pixels, network = replace(base.pixels, wall_share=0.3), replace(base.network, map_size=16)
    expected = replace(base, batch_size=64, pixels=pixels, network=network)
    assert configure(asked, put(tmp_path / "a.toml", text)) == expected


def test_sources_are_replaced_as_a_whole(tmp_path):
    file = put(tmp_path / "a.toml", '[sources]\n"/data/a" = 2.0\n"/data/b" = 1.0\n')
    assert configure(None, file).sources == {"/data/a": 2.0, "/data/b": 1.0}
    assert configure(None, file, [{"sources": {"/data/c": 1.0}}]).sources == {"/data/c": 1.0}
    with refuses("has no weight above 0", ModelError):
        configure(None, None, [{"sources": {}}])


def test_files_that_cannot_be_read(tmp_path):
    with refuses("found a folder, expected a text file", ModelError):
        read_config_file(tmp_path)
    for name, content, message in (
        ("a.json", b"{", r"a\.json: is not JSON"),
        ("a.json", b"[1]", r"a\.json: is not a table of settings"),
        ("a.toml", b"\na" + b".a" * 40_000 + b" = 1", r"a\.toml:2: found 40000 points in a line"),
        ("b.toml", b"preset = '\xff'", r"b\.toml: the file is not UTF-8 text"),
    ):
        (tmp_path / name).write_bytes(content)
        with refuses(message, ModelError):
            read_config_file(tmp_path / name)


@parametrize(
    "text, expected",
    [
        ("seed=3", {"seed": 3}),
        ("pixels.cast_shadows=false", {"pixels": {"cast_shadows": False}}),
        ("updates=alternating", {"updates": "alternating"}),
        ('updates="alternating"', {"updates": "alternating"}),
        ("network.size = paper", {"network": {"size": "paper"}}),
        ("start_from=/data/a=b.safetensors", {"start_from": "/data/a=b.safetensors"}),
        ("a.b.c=1", {"a": {"b": {"c": 1}}}),
        ("sources={generator = 1.0}", {"sources": {"generator": 1.0}}),
        ("seed=", {"seed": ""}),
    ],
)
def test_parameters(text, expected):
    assert parse_parameter(text) == expected


@parametrize("text", "seed =3 a..b=1")
def test_bad_parameters(text):
    with refuses(f"{text!r}; expected NAME=VALUE such as", UsageError):
        parse_parameter(text)


def test_a_run_on_other_sources_is_refused(tmp_path):
    other = configure(changes=[{"sources": {"/data/set": 1.0}}], base=TrainingConfig())
    with refuses(
        r"the run was started with sources\./data/set = None, not 1\.0", ModelError
    ) as caught:
        check_resumable(TrainingConfig(), other, tmp_path)
    assert caught.value.path == tmp_path


def test_a_setting_that_is_not_given_stays_as_it_was():
    started = preset("compact", seed=5, batch_size=32)
    assert (
        configure(base=started) == configure(changes=[{"batch_size": 32}], base=started) == started
    )
    # A preset gives all settings.
    assert configure("compact", changes=[{"seed": 5}], base=started) == preset("compact", seed=5)


def test_length_and_rate_of_a_run_may_change(tmp_path):
    file = put(tmp_path / "a.toml", "steps = 12\nlearning_rate = 1e-4")
    started = preset("compact", seed=5)
    asked = configure(None, file, [{"minutes": 3.0}], base=started)
    assert asked == preset("compact", seed=5, steps=12, learning_rate=1e-4, minutes=3.0)
    check_resumable(started, asked, tmp_path)


def test_the_home_folder_is_expanded_in_every_path(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    config = configure(changes=[{"sources": {"~/set": 1.0}}, {"start_from": "~/mine.safetensors"}])
    assert config.sources == {str(tmp_path / "set"): 1.0}
    assert config.start_from == str(tmp_path / "mine.safetensors")


@parametrize(
    "text, expected",
    [("10", (10, 10, 10)), ("4-96", (4, 96, 10)), ("3-8", (3, 8, 8)), ("12-40", (12, 40, 12))],
)
def test_light_counts(text, expected):
    assert tuple(parse_light_counts(text).values()) == expected


def test_sources_of_the_command_line():
    sets = [Path("a"), Path("b")]
    assert parse_sources([], None) == {GENERATOR: 1.0}
    assert parse_sources(sets, None) == {"a": 1.0, "b": 1.0}
    assert parse_sources(sets, 0.5) == {"a": 1.0, "b": 1.0, GENERATOR: 0.5}
    assert parse_sources([], 0.0) == {}


def test_removed_settings_of_earlier_versions(tmp_path):
    unused = put(tmp_path / "old.toml", "[pixels]\nmeasured_share = 0.0\nmeasured_materials = ''\n")
    assert configure("compact", unused) == preset("compact")
    used = put(tmp_path / "used.toml", "[pixels]\nmeasured_share = 0.5\n")
    with refuses(
        r"measured_share' is 0\.5, but training with measured materials was r", ModelError
    ):
        configure("compact", used)
