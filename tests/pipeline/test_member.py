"""Shards of a batch."""

import random
from pathlib import Path

import pytest

from splinecli.errors import UsageError
from splinecli.pipeline.batch import list_captures
from splinecli.pipeline.infer_options import Shard


@pytest.mark.parametrize("count", [1, 2, 3, 7, 40])
@pytest.mark.parametrize("captures", [0, 1, 5, 23])
def test_the_union_of_the_shards_is_the_whole(count, captures, tmp_path):
    """Each shard sees the folders in an order of its own, as shells of different languages give it."""
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


@pytest.mark.parametrize("text", ["", "1", "0/3", "4/3", "1/0", "-1/3", "a/b", "1/3/5", "1.0/3", "9" * 30 + "/1"])
def test_other_shards_are_refused(text):
    with pytest.raises(UsageError, match="--shard is"):
        Shard.parse(text)


def test_captures_of_one_name_in_different_shards(tmp_path):
    folders = [tmp_path / place / "same" for place in "ab"]
    for folder in folders:
        folder.mkdir(parents=True)
    with pytest.raises(UsageError, match="have the same name"):
        list_captures([*folders, Path("none")], Shard(1, 3))
