"""The cache of scenes: what is read is what was written, once; damage is mended; the folder stays within its size."""

import multiprocessing
import os
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from e2rl.run.errors import InputError
from e2rl.scenes import scene_cache as cache
from e2rl.scenes.scene_cache import Index, cached, pack


def build(keep, seed: int = 0, count: int = 3) -> Index:
    """A set of `count` scenes with random content."""
    index, draw = Index(dataset="made", split="test", dropped={"invalid": 2}), np.random.default_rng(seed)
    for number in range(count):
        lanes = {"lane_points": draw.normal(size=(number + 1, 2)).astype(np.float32)}
        packed = pack({"logged": draw.normal(size=(5, 3, 4)).astype(np.float32), **lanes})
        index.add(f"scene-{number}", f"place-{number}", packed)
        keep(packed.record)
    return index


def never(keep) -> Index:
    raise AssertionError("it is built again")


def same(one, other) -> None:
    assert one.scene_id == other.scene_id and one.location == other.location and one.dropped == other.dropped
    assert (one.dataset, one.split) == (other.dataset, other.split) and one.rows.hashes() == other.rows.hashes()
    assert all(torch.equal(value, other.scenes[key]) for key, value in one.scenes.items())


def test_a_set_is_built_once_and_read_from_its_file(tmp_path):
    path = tmp_path / "cache" / "scenes-a.packed"
    first = cached(path, build, 2, 1)
    records: list[bytes] = []
    same(build(records.append).scenes(records, 2), first)
    same(cached(path, never, 1, 1), first)
    assert list(path.parent.iterdir()) == [path]


DAMAGES = {
    "truncated": lambda content: content[: len(content) // 2],
    "nonsense": lambda content: b"\xff" * 64,
    "longer nonsense": lambda content: b"\xff" * 640,
    "empty": lambda content: b"",
    "a bit of a scene": lambda content: content[:20] + bytes([content[20] ^ 1]) + content[21:],
    "a bit of the index": lambda content: content[:-80] + bytes([content[-80] ^ 1]) + content[-79:],
    "a bit of the hash": lambda content: content[:-1] + bytes([content[-1] ^ 1]),
    "another format": lambda content: content.replace(cache.FORMAT, b"e2rl-scenes-cache/0"),
    "more at its end": lambda content: content + b"x",
    "more at its beginning": lambda content: b"x" + content,
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_file_is_rebuilt(tmp_path, capsys, damage):
    path = tmp_path / "scenes-a.packed"
    first, content = cached(path, build, 2, 1), path.read_bytes()
    path.unlink()  # the set above goes on with what it has mapped
    path.write_bytes(DAMAGES[damage](content))
    same(cached(path, build, 2, 1), first)
    assert "rebuilding the damaged cache file" in capsys.readouterr().err
    assert path.read_bytes() == content and list(tmp_path.iterdir()) == [path]


def test_a_set_in_use_survives_its_file(tmp_path):
    path = tmp_path / "scenes-a.packed"
    used, again = (cached(path, build, 1, 1) for _ in range(2))
    path.unlink()
    same(used, again)


def test_what_a_killed_process_left_is_removed(tmp_path):
    path, other = tmp_path / "scenes-a.packed", tmp_path / ".scenes-b.packed.x.part"
    left = tmp_path / ".scenes-a.packed.x.part"
    left.write_bytes(b"half"), other.write_bytes(b"half")
    cached(path, build, 1, 1)
    assert not left.exists() and other.exists()  # the other may be at work


def test_an_error_while_building_leaves_nothing(tmp_path):
    def fails(keep):
        keep(b"something")
        raise InputError("no")

    with pytest.raises(InputError, match="no"):
        cached(tmp_path / "scenes-a.packed", fails, 1, 1)
    assert not list(tmp_path.iterdir())


def test_sets_not_used_for_longest_make_room(tmp_path, capsys):
    names = [tmp_path / f"scenes-{name}.packed" for name in "abc"]
    for number, path in enumerate(names):
        cached(path, partial(build, seed=number), 1, 1)
        os.utime(path, (0, 100 * number))
    cached(names[0], never, 1, 1)  # used now
    size = names[0].stat().st_size
    new = tmp_path / "scenes-d.packed"
    cached(new, partial(build, seed=9), 1, 3.5 * size / 1e9)
    assert sorted(tmp_path.glob("*.packed")) == [names[0], names[2], new]
    assert f"removed {names[1]}" in capsys.readouterr().err
    cached(tmp_path / "scenes-e.packed", partial(build, seed=8), 1, 0)  # what is used stays, however small the limit
    assert [path.name for path in tmp_path.glob("*.packed")] == ["scenes-e.packed"]


def _counted(folder: Path, _: int) -> list[str]:
    def build_and_tell(keep):
        (folder / f"built-{os.getpid()}").touch()
        return build(keep)

    return cached(folder / "scenes-a.packed", build_and_tell, 1, 1).rows.hashes()


def test_of_several_processes_one_builds(tmp_path):
    with multiprocessing.get_context("fork").Pool(4) as pool:
        found = pool.map(partial(_counted, tmp_path), range(8), chunksize=1)
    assert len(list(tmp_path.glob("built-*"))) == 1 and all(hashes == found[0] for hashes in found)


def test_a_full_disk_is_told_and_leaves_nothing(tmp_path, monkeypatch):
    def full(keep):
        raise OSError(28, "No space left on device")

    with pytest.raises(InputError, match=r"data\.cache=.*No space left.*free space"):
        cached(tmp_path / "scenes-a.packed", full, 1, 1)
    assert not list(tmp_path.iterdir())
