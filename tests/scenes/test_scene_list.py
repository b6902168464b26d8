"""Lists of scenes: what they name comes out, in their order, with its noise; what is
another scene is refused."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from e2rl.run.errors import InputError
from e2rl.scenes.scene import SceneSet
from e2rl.scenes.scene_cache import uncached
from e2rl.scenes.scene_list import (
    SCENES,
    Listed,
    listed,
    listed_scenes,
    read_list,
    scene_hashes,
)
from tests.synthetic import make_scenes

SMALL = {
    "num_vehicles": 3,
    "max_vehicles": 4,
    "max_agents": 5,
    "num_routes": 1,
    "num_points": 120,
    "steps": 10,
}


def scenes_of(count=4):
    """Scenes that differ, of which the last has a larger map than the others; changes
    to them change their hashes."""

    def build(index):
        index.dataset = "made"
        index.split = "test"
        for k in range(count):
            scene = {
                key: value.numpy()
                for key, value in make_scenes(
                    1,
                    speed=8 + k,
                    **SMALL,
                )
                .scenes[0]
                .items()
            }
            del scene["scene_index"]
            for key, value in (
                (("lane_points", 7.0), ("lane_index", 1)) if k == count - 1 else ()
            ):
                scene[key] = np.concatenate(
                    [scene[key], np.full_like(scene[key][:9], value)]
                )
            index.add(f"s{k}", "place", scene)
            yield scene

    return replace(uncached(build), files="f" * 64)


def written(folder, text):
    (folder / "list.csv").write_text(text)
    return folder / "list.csv"


def test_a_hash_is_of_the_scene_alone_and_of_all_of_it():
    scenes = scenes_of()
    hashes = scene_hashes(scenes)
    assert len(set(hashes)) == 4
    alone = SceneSet(
        make_scenes(
            1,
            speed=8,
            **SMALL,
        ).scenes,
        ["s0"],
        location=["place"],
        dataset="made",
        split="other",
        dropped={"too short": 1},
    )
    assert (
        scenes.scenes["lane_points"].shape[1]
        == alone.scenes["lane_points"].shape[1] + 9
    ), "the first is padded"
    assert scene_hashes(alone) == hashes[:1]
    assert scene_hashes(scenes.chosen([2, 1])) == [hashes[2], hashes[1]]
    for key, value in scenes.scenes.items():
        if key != "scene_index" and value[1].numel():
            changed = scenes_of()
            flat = changed.scenes[key][1].reshape(-1)
            flat[0] = ~flat[0] if flat.dtype == torch.bool else flat[0] + 1
            assert scene_hashes(changed)[1] != hashes[1], key
    changed = scenes_of()
    changed.location[3] = "elsewhere"
    assert [a == b for a, b in zip(scene_hashes(changed), hashes, strict=True)] == [
        True,
        True,
        True,
        False,
    ]


def test_what_a_run_lists_is_what_another_takes(tmp_path):
    """Its scenes in its order, with their noise, wherever they stand in the data."""
    scenes = scenes_of()
    some = scenes.chosen([3, 1])
    assert some.number == [3, 1]
    assert some.scenes["scene_index"].tolist() == [0, 1]
    (tmp_path / SCENES).write_text(listed(some)[0])
    for data in (scenes, scenes.chosen([2, 1, 0, 3])):
        taken = listed_scenes(tmp_path, data.first)
        assert taken.scene_id == ["s3", "s1"]
        assert taken.number == [3, 1]
        assert torch.equal(taken.scenes["logged"], some.scenes["logged"])
        assert taken.scenes["scene_index"].tolist() == [0, 1]
    assert listed_scenes(tmp_path, scenes.first, most=1).scene_id == ["s3"]


def test_a_list_by_hand_names_scenes_only(tmp_path):
    """A part of rollouts.csv, say, or what a spreadsheet writes; a scene that it names
    twice is taken once."""
    scenes = scenes_of()
    file = written(tmp_path, "\ufeffmethod,scene_id\ne2,s2\r\ne2,s0\nnominal,s2\n")
    taken = listed_scenes(file, scenes.first)
    assert taken.scene_id == ["s2", "s0"]
    assert taken.number == [2, 0]
    assert read_list(written(tmp_path, "scene_id,number\na,7\n")) == [Listed("a", 7)]


def test_other_scenes_of_the_same_name_are_refused_unless_their_files_are_the_same(
    tmp_path, capsys
):
    scenes = scenes_of()
    moved = scenes_of()
    moved.scenes["logged"][1, 3, 2, 0] += 0.01
    (tmp_path / SCENES).write_text(listed(scenes)[0])
    for files in ("", "0" * 64):
        with pytest.raises(
            InputError, match=r"1 of 4 scenes are not those listed \(s1\): .*sha256"
        ):
            listed_scenes(tmp_path, moved.first, files=files)
    taken = listed_scenes(tmp_path, moved.first, files="f" * 64)
    assert taken.scene_id == scenes.scene_id
    assert (
        "1 of 4 scenes are not those listed (s1), though the data files are"
        in capsys.readouterr().err
    )
    with pytest.raises(
        InputError,
        match=r"2 of 4 scenes are not in the data \(s1, s2\), whose first is s0; pass the data",
    ):
        listed_scenes(tmp_path, scenes.chosen([0, 3]).first)


@pytest.mark.parametrize(
    ("content", "what"),
    [
        ("id,number\na,1\n", "no column scene_id"),
        ("scene_id,number\na,1\nb,-1\n", "line 3: number -1"),
        ("scene_id,number\na,99999999999\n", "number 99999999999"),
        ("scene_id,number\na,²\n", "number ²"),
        ('scene_id\n"a', "cannot be read"),
    ],
)
def test_what_is_no_list_is_named(
    tmp_path,
    content,
    what,
):
    with pytest.raises(InputError, match=what):
        read_list(written(tmp_path, content))
