"""The cache of scenes: what is read is what was built, bit for bit; damage is mended;
the folder keeps its size."""

import hashlib
import json
import multiprocessing
import os
from functools import partial

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from e2rl.scenes import scene_cache as cache
from e2rl.scenes.scene import RAGGED
from e2rl.scenes.scene_cache import cached, uncached

KINDS = st.sampled_from(("<f4", "<f2", "<i8", "|b1")).map(np.dtype)
SHAPES = arrays.array_shapes(
    min_dims=1,
    max_dims=3,
    min_side=0,
    max_side=4,
)
SCENES = st.tuples(KINDS, SHAPES).flatmap(
    lambda like: st.lists(
        st.fixed_dictionaries(
            {
                "logged": arrays.arrays(*like),
                "lane_exits": arrays.arrays("<i8", st.tuples(*[st.integers(0, 4)] * 2)),
            }
        ),
        min_size=1,
        max_size=4,
    )
)


def yielding(scenes, index):
    index.dataset = "made"
    index.split = "test"
    index.dropped["invalid"] = 2
    for number, stored in enumerate(scenes):
        index.add(f"scene-{number}", f"place-{number}", stored)
        yield stored


def build(
    index,
    seed: int = 0,
    count: int = 5,
):
    """Scenes with random content, of which each has one lane more than the last."""
    draw = np.random.default_rng(seed)
    rows = [
        np.arange(2 * number + 2, dtype=float).reshape(-1, 2) for number in range(count)
    ]
    scenes = [
        {"logged": draw.normal(size=(5, 3, 4)).astype("<f4"), "lane_points": row}
        for row in rows
    ]
    return yielding(scenes, index)


def never(index):
    raise AssertionError("it is built again")


def file_of(folder, letter: str = "a"):
    return folder / f"scenes-{letter * 64}.map"


def same(one, other) -> None:
    assert all(
        vars(one)[key] == vars(other)[key] for key in vars(one) if key != "scenes"
    )
    assert one.hashes() == other.hashes()
    assert one.scenes.keys() == other.scenes.keys()
    assert all(
        torch.equal(value, other.scenes[key]) for key, value in one.scenes.items()
    )


@settings(
    max_examples=100,
    deadline=None,
)
@given(SCENES)
def test_scenes_come_back_bit_for_bit_and_padded(scenes):
    result = uncached(partial(yielding, scenes))
    assert (
        result.scenes["scene_index"].tolist()
        == list(range(len(scenes)))
        == result.number
    )
    for stored, row in zip(scenes, result.scenes, strict=True):
        for key, value in stored.items():
            inner = row[key].numpy()[tuple(map(slice, value.shape))]
            assert inner.tobytes() == value.tobytes()
            assert inner.dtype == value.dtype
            assert (row[key] == RAGGED.get(key, 0)).sum() >= row[
                key
            ].numel() - value.size
    assert result.scenes["lane_exits"].shape[1:] == tuple(
        np.max([stored["lane_exits"].shape for stored in scenes], 0)
    )


def test_a_set_is_built_once_and_read_from_its_file(tmp_path):
    path = file_of(tmp_path / "cache")
    first = cached(path, build, gigabytes=1)
    same(uncached(build), first)
    changed = cached(path, never, gigabytes=1)
    changed.scenes["logged"].fill_(7.0)  # in memory, not in the file
    same(cached(path, never, gigabytes=1), first)
    assert list(path.parent.iterdir()) == [path]


DAMAGES = {
    "truncated": lambda content: content[: len(content) // 2],
    "empty": lambda content: b"",
    "a bit of a scene": lambda content: (
        content[:20] + bytes([content[20] ^ 1]) + content[21:]
    ),
    "a bit of the index": lambda content: (
        content[:-90] + bytes([content[-90] ^ 1]) + content[-89:]
    ),
    "another format": lambda content: content.replace(
        cache.FORMAT, b"e2rl-scenes-cache/0"
    ),
    "more at its end": lambda content: content + b"x",
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_file_is_rebuilt_and_a_set_in_use_survives_it(
    tmp_path,
    capsys,
    damage,
):
    path = file_of(tmp_path)
    first = cached(path, build, gigabytes=1)
    content = path.read_bytes()
    path.unlink()
    path.write_bytes(DAMAGES[damage](content))
    same(cached(path, build, gigabytes=1), first)
    assert "rebuilding the cache file" in capsys.readouterr().err
    assert path.read_bytes() == content
    assert list(tmp_path.iterdir()) == [path]


def test_a_scene_s_hash_is_of_what_is_used_not_of_what_its_file_says(tmp_path):
    """A cache entry with another scene in it, whose own hash was made anew."""
    first = cached(path := file_of(tmp_path), build, gigabytes=1).hashes()
    content = bytearray(path.read_bytes()[: -cache.END.size])
    length = cache.END.unpack(path.read_bytes()[-cache.END.size :])[0]
    content[20] ^= 1
    path.write_bytes(
        content + cache.END.pack(length, cache.FORMAT, hashlib.sha256(content).digest())
    )
    forged = cached(path, never, gigabytes=1).hashes()
    assert forged[0] != first[0]
    assert forged[1:] == first[1:]


@pytest.mark.parametrize(
    "change",
    [("|O", [5, 3, 4]), ("|V8", [5, 3]), ("<U2", [5, 3]), ("?", [5]), ("<f4", [9**9])],
)
def test_a_file_of_other_arrays_than_numbers_is_refused(tmp_path, change):
    """Its hash is right: somebody wrote it so."""
    cached(path := file_of(tmp_path), build, gigabytes=1)
    content = path.read_bytes()
    begin = (
        len(content) - cache.END.size - cache.END.unpack(content[-cache.END.size :])[0]
    )
    about = json.loads(content[begin : -cache.END.size])
    about["layout"]["logged"] = change if change[0] != "?" else ["no type", [5]]
    about = json.dumps(about).encode()
    body = content[:begin] + about
    path.write_bytes(
        body + cache.END.pack(len(about), cache.FORMAT, hashlib.sha256(body).digest())
    )
    assert cache.read(path) is None


def test_batches_are_copies_in_the_order_asked_for():
    result = uncached(build)
    for wanted in ([0], [1, 0], [4, 1, 4], [2, 3, 0, 1, 4]):
        batch = result.batch(wanted)
        assert batch["scene_index"].tolist() == wanted
        assert torch.equal(batch["lane_points"], result.scenes["lane_points"][wanted])
    batch = result.batch([0, 0, 0])
    result.copy_into(batch, torch.tensor([0, 2]), torch.tensor([4, 1]))
    assert batch["scene_index"].tolist() == [4, 0, 1]
    assert torch.equal(batch["logged"], result.batch([4, 0, 1])["logged"])
    result.copy_into(batch, torch.arange(3), torch.tensor([2, 3, 2]))
    assert torch.equal(batch["lane_points"], result.scenes["lane_points"][[2, 3, 2]])
    result.batch([0])["logged"].fill_(7.0)
    assert not (result.scenes["logged"][0] == 7.0).any()


def test_chosen_scenes_keep_names_noise_and_hashes():
    every = uncached(build)
    some = every.chosen([3, 1, 2]).chosen([2, 0])
    assert some.scene_id == ["scene-2", "scene-3"]
    assert some.number == [2, 3]
    assert some.location[1] == "place-3"
    assert (
        some.batch([1, 0])["scene_index"].tolist()
        == [1, 0]
        == some.scenes["scene_index"].flip(0).tolist()
    )
    assert torch.equal(some.scenes["logged"], every.scenes["logged"][2:4])
    assert some.hashes() == every.hashes()[2:4]
    assert len(set(every.hashes())) == 5
    first = every.first(2)
    assert first.scene_id == every.scene_id[:2]
    assert every.first(9) is every.first(None) is every
    assert (
        first.scenes["logged"].data_ptr() == every.scenes["logged"].data_ptr()
    )  # not copied


def test_sets_not_used_for_longest_make_room_and_nothing_else_does(tmp_path, capsys):
    others = [
        tmp_path / name
        for name in (
            "scenes-abc.map",
            f"scenes-{'a' * 64}.map.old",
            f"{'a' * 64}",
            "scenes.csv",
        )
    ]
    for path in others:
        path.write_bytes(bytes(10**6))
    names = [file_of(tmp_path, letter) for letter in "abc"]
    for number, path in enumerate(names):
        cached(path, partial(build, seed=number), gigabytes=1)
        os.utime(path, (0, 100 * number))
    cached(names[0], never, gigabytes=1)  # used now
    size = names[0].stat().st_size
    new = file_of(tmp_path, "d")
    cached(new, partial(build, seed=9), gigabytes=3.5 * size / 1e9)
    assert [path for path in [*names, new] if path.exists()] == [
        names[0],
        names[2],
        new,
    ]
    assert f"removed {names[1]}" in capsys.readouterr().err
    cached(
        file_of(tmp_path, "e"), build, gigabytes=0
    )  # what is used stays, however small the limit
    assert sorted(tmp_path.iterdir()) == sorted([*others, file_of(tmp_path, "e")])


def _counted(folder, _: int) -> list[str]:
    def build_and_tell(index):
        (folder / f"built-{os.getpid()}").touch()
        return build(index)

    return cached(file_of(folder), build_and_tell, gigabytes=1).hashes()


def test_of_several_processes_one_builds(tmp_path):
    with multiprocessing.get_context("fork").Pool(4) as pool:
        result = pool.map(partial(_counted, tmp_path), range(8), chunksize=1)
    assert len(list(tmp_path.glob("built-*"))) == 1
    assert all(hashes == result[0] for hashes in result)
