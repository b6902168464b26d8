"""From configurations to scene sets: what is cached is what was built, what is left out
is counted."""

import importlib
import os
import pickle
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from e2rl.run.errors import InputError
from e2rl.run.files import hash_files
from e2rl.scenes import source
from e2rl.scenes.builder import BuildSettings
from e2rl.scenes.bundled import BundledSource
from e2rl.scenes.recording import Lane, Recording
from e2rl.scenes.source import Source, load_scenes
from tests.scenes.descriptions import (
    Malicious,
    data_config,
    description,
    lane,
    numbered,
    straight,
    write_folder,
    write_zip,
)


def scenes_of(count: int) -> list[dict]:
    return numbered(
        [
            description(
                {"ego": straight(20 + k, 0, speed=8), "7": straight(50, 3.5, speed=6)}
            )
            for k in range(count)
        ]
    )


def bad_scenes() -> dict[str, dict | bytes]:
    """Named ways to be no scene."""
    nan = description()
    nan["tracks"]["7"]["state"]["position"][40] = np.nan
    return {
        "forbidden class posix.system": pickle.dumps(
            {"x": Malicious(os.system, "true")}
        ),
        "no ego": description(sdc_id="nobody"),
        "no lanes": description(lanes={"b": lane([[0, 0]])}),
        "NaN or infinite": nan,
        "cannot be read": b"nonsense",
    }


def same(a, b) -> None:
    assert a.scene_id == b.scene_id
    assert a.location == b.location
    assert a.dropped == b.dropped
    assert (a.dataset, a.split) == (b.dataset, b.split)
    assert set(a.scenes.keys()) == set(b.scenes.keys())
    for key, value in a.scenes.items():
        assert torch.equal(value, b.scenes[key]), key
        assert value.dtype == b.scenes[key].dtype, key


def test_folder_zip_cache_and_workers_give_identical_scenes(tmp_path, monkeypatch):
    folder = write_folder(tmp_path / "x", scenes_of(3))
    first = load_scenes(data_config(folder, tmp_path / "a"))
    assert first.scene_id == ["scene-0", "scene-1", "scene-2"]
    assert first.dataset == "made"
    assert first.split == "x"
    zipped = write_zip(tmp_path / "x.zip", scenes_of(3))
    same(first, load_scenes(data_config(zipped, tmp_path / "b")))
    same(first, load_scenes(data_config(folder, tmp_path / "c", workers=2)))
    assert [path.suffix for path in (tmp_path / "a").iterdir()] == [".map"]
    monkeypatch.setattr(source, "SceneBuilder", None)  # nothing is built again
    same(first, load_scenes(data_config(folder, tmp_path / "a")))
    limited = load_scenes(data_config(folder, tmp_path / "a"), num_scenes=2)
    assert limited.scene_id == first.scene_id[:2]


@pytest.mark.parametrize("workers", [1, 2])
def test_the_first_scenes_take_no_more_than_their_logs(tmp_path, workers):
    """The rest is not even read: here it is damaged."""
    folder = write_folder(tmp_path / "x", [*scenes_of(2), *[b"nonsense"] * 3])
    config = data_config(folder, tmp_path / "cache", workers=workers)
    assert load_scenes(config, num_scenes=2).scene_id == ["scene-0", "scene-1"]
    assert load_scenes(config, num_scenes=1).scene_id == ["scene-0"]
    with pytest.raises(InputError, match=r"sd_02\.pkl"):
        load_scenes(config, num_scenes=3)


def test_the_cache_is_keyed_by_content_and_settings(tmp_path):
    folder = write_folder(tmp_path / "x", scenes_of(1))
    cache = tmp_path / "cache"
    load_scenes(data_config(folder, cache))
    write_folder(folder, numbered([description({"ego": straight(33, 0, speed=5)})]))
    assert load_scenes(data_config(folder, cache)).scenes["start"][
        0, 0, 3
    ].item() == pytest.approx(5.0, abs=1e-4)
    assert load_scenes(data_config(folder, cache, build={"field_cells": 32})).scenes[
        "field"
    ].shape == (1, 32, 32)
    assert load_scenes(data_config(folder, cache, split="mine")).split == "mine"
    assert load_scenes(data_config(folder, cache), starts=[10, 30]).scene_id == [
        "scene-0@10",
        "scene-0@30",
    ]
    assert len(list(cache.iterdir())) == 5


def test_mirror_images_are_scenes_of_the_same_place(tmp_path):
    """Drawn in the mirror, a scene is the other one: states, lanes and what is
    drivable."""
    turned = description(
        {"ego": straight(20, 0, speed=8), "7": straight(50, 3.5, speed=6)}
    ) | {"id": "turned"}
    loaded = load_scenes(
        data_config(
            write_folder(tmp_path / "x", [turned]),
            tmp_path / "cache",
            versions=("recorded", "mirrored"),
        )
    )
    assert loaded.scene_id == ["turned", "turned~mirrored"]
    assert loaded.location == [
        "turned",
        "turned",
    ]
    scene, other = loaded.scenes
    sign = torch.tensor([1.0, -1.0, -1.0, 1.0])
    assert torch.allclose(scene["start"] * sign, other["start"], atol=1e-5)
    assert torch.allclose(scene["logged"] * sign, other["logged"], atol=1e-5)
    assert torch.allclose(
        scene["lane_points"] * sign[:2], other["lane_points"], atol=1e-5
    )
    assert torch.equal(scene["field"], other["field"].flip(1))
    assert torch.equal(scene["valid"], other["valid"])
    cut = load_scenes(
        data_config(
            tmp_path / "x", tmp_path / "cache", versions=("recorded", "mirrored")
        ),
        starts=[10, 20],
    )
    assert cut.scene_id == [
        "turned@10",
        "turned@20",
        "turned~mirrored@10",
        "turned~mirrored@20",
    ]


@pytest.mark.parametrize("reason", bad_scenes())
def test_the_first_invalid_scene_stops_the_load_and_leaves_nothing(tmp_path, reason):
    folder = write_folder(tmp_path / "x", [*scenes_of(1), bad_scenes()[reason]])
    with pytest.raises(
        InputError, match=rf"(?s)sd_01\.pkl.*{reason}.*data\.skip_invalid=true"
    ) as caught:
        load_scenes(data_config(folder, tmp_path / "cache"))
    assert "\n" not in str(caught.value)
    assert not list((tmp_path / "cache").iterdir())


def test_invalid_scenes_are_skipped_and_counted_on_request(tmp_path):
    folder = write_folder(tmp_path / "x", [*bad_scenes().values(), *scenes_of(2)])
    config = data_config(folder, tmp_path / "cache", skip_invalid=True)
    loaded = load_scenes(config)
    assert loaded.scene_id == ["scene-0", "scene-1"]
    assert loaded.dropped == {"invalid": 5}
    assert load_scenes(config).dropped == {"invalid": 5}  # from the cache too
    for name in ("sd_05.pkl", "sd_06.pkl"):
        (folder / name).unlink()
    with pytest.raises(InputError, match="no valid scene.*5 invalid"):
        load_scenes(config)


def test_overlaps_with_the_ego_and_logs_too_short_are_dropped_and_counted(tmp_path):
    close = description(
        {"ego": straight(20, 0, speed=8), "7": straight(23, 0.5, speed=8)}
    )
    folder = write_folder(tmp_path / "x", [close, *scenes_of(1)])
    loaded = load_scenes(data_config(folder, tmp_path / "cache"))
    assert len(loaded) == 1
    assert loaded.dropped == {source.OVERLAP: 1}
    with pytest.raises(
        InputError, match=f"no valid scene in .*x .2 {source.TOO_SHORT}"
    ):
        load_scenes(data_config(folder, tmp_path / "cache"), starts=[80])


def test_what_overlaps_the_ego_is_counted_by_its_kind(tmp_path):
    ego = straight(20, 0, speed=8)
    kinds = {
        "PEDESTRIAN": "a pedestrian",
        "CYCLIST": "a cyclist",
        "TRAFFIC_CONE": "an object",
    }
    close = [
        description(
            {
                "ego": ego,
                "7": straight(
                    29,
                    0.5,
                    speed=0,
                    kind=kind,
                    size=(0.6, 0.6),
                ),
            }
        )
        for kind in kinds
    ]
    folder = write_folder(tmp_path / "x", [*close, *scenes_of(1)])
    loaded = load_scenes(data_config(folder, tmp_path / "cache"))
    assert loaded.dropped == {
        f"ego overlaps {word} at the start": 1 for word in kinds.values()
    }


def test_equal_ids_are_told_apart_by_file_whatever_number_of_scenes_is_asked_for(
    tmp_path,
):
    same_ids = [scene | {"id": "same"} for scene in scenes_of(3)]
    folder = write_folder(tmp_path / "x", same_ids)
    config = data_config(folder, tmp_path / "cache")
    assert load_scenes(config, 2).scene_id == ["same", "same:sd_01"]
    assert load_scenes(config).scene_id == ["same", "same:sd_01", "same:sd_02"]
    windows = load_scenes(config, starts=[10, 20]).scene_id
    assert windows == [
        f"same{mark}@{start}" for mark in ("", ":sd_01", ":sd_02") for start in (10, 20)
    ]
    (folder / "b").mkdir()
    (folder / "sd_02.pkl").rename(folder / "b" / "sd_01.pkl")
    assert load_scenes(config).scene_id == ["same", "same:sd_00", "same:sd_01"]
    (folder / "c").mkdir()
    (folder / "b" / "sd_01.pkl").rename(folder / "c" / "sd_01.pkl")
    (folder / "b" / "sd_01.pkl").write_bytes((folder / "sd_01.pkl").read_bytes())
    assert load_scenes(config).scene_id == [
        "same",
        "same:sd_01",
        "same:sd_00",
        "same:sd_01:2",
    ]


@dataclass
class SpeedSource(Source):
    """An outside source: each *.txt file below `path` holds the speed of a car on a
    straight road."""

    lane_width: float = 3.5

    holds = "text files"

    def logs(self) -> list[str]:
        return sorted(file.name for file in self.root().glob("*.txt"))

    def read(self, log: str) -> Iterator[Recording]:
        speed = float((self.root() / log).read_text())
        frames = np.arange(200)
        states = np.stack(
            [0.1 * speed * frames, 0 * frames, 0 * frames, 0 * frames + speed], -1
        )[:, None]
        road = {"road": Lane(np.array([[0.0, 0], [900, 0]]), self.lane_width)}
        valid = np.ones((200, 1), bool)
        size = np.array([[4.5, 1.9]])
        yield Recording(
            log,
            "road",
            dataset="speeds",
            states=states,
            valid=valid,
            size=size,
            agent_type=np.zeros(1, int),
            ego=0,
            lanes=road,
            current=None,
        )

    def fingerprint(self) -> bytes:
        return hash_files(sorted(self.root().glob("*.txt")))


def test_an_outside_source_is_named_by_its_class_and_takes_part_in_all(
    tmp_path, monkeypatch
):
    (tmp_path / "a.txt").write_text("5.0")
    (tmp_path / "b.txt").write_text("9.0")
    config = {
        "_target_": "tests.scenes.test_source.SpeedSource",
        "path": str(tmp_path),
        "lane_width": 3.0,
    }
    config |= {
        "workers": 1,
        "cache": str(tmp_path / "cache"),
        "build": {"field_cells": 32, "steps": 80},
    }
    loaded = load_scenes(config)
    assert loaded.scene_id == ["a.txt@10", "a.txt@101", "b.txt@10", "b.txt@101"]
    assert loaded.dataset == "speeds"
    assert loaded.scenes["start"][:, 0, 3].tolist() == pytest.approx(
        [5, 5, 9, 9], abs=1e-4
    )
    assert (loaded.scenes["lane_width"] == 3.0).all()
    assert loaded.split == tmp_path.name
    same(loaded, load_scenes(config))
    assert len(list((tmp_path / "cache").iterdir())) == 1
    assert load_scenes(
        config,
        split="train",
        starts=[20],
    ).scene_id == [
        "a.txt@20",
        "b.txt@20",
    ]
    assert (load_scenes(config | {"lane_width": 4.0}).scenes["lane_width"] == 4.0).all()
    (tmp_path / "c.txt").write_text("1.0")
    assert len(load_scenes(config)) == 6
    monkeypatch.setenv("HOME", str(tmp_path.parent))
    assert len(load_scenes(config | {"path": f"~/{tmp_path.name}"})) == 6
    with pytest.raises(
        InputError, match="no such file or folder; pass one that holds text files"
    ):
        load_scenes(config | {"path": "nowhere"})
    with pytest.raises(InputError, match="data.lane_width=wide"):
        load_scenes(config | {"lane_width": "wide"})


def test_a_log_of_one_frame_is_told_so(tmp_path):
    class Short(SpeedSource):
        def read(self, log):
            whole = next(SpeedSource.read(self, log))
            yield replace(
                whole,
                states=whole.states[:1],
                valid=whole.valid[:1],
            )

    (tmp_path / "a.txt").write_text("5.0")
    with pytest.raises(
        InputError,
        match=r"^a\.txt: scene 'a\.txt': fewer than two frames .*; leave it out",
    ):
        Short(
            str(tmp_path),
            cache=str(tmp_path),
            workers=1,
        ).load()


@pytest.mark.parametrize("what", ["scene_id", "location", "dataset"])
@pytest.mark.parametrize(
    "name", ["a\ud800", "a\x1b[2J", "a\nb", "a\u202eb", "x" * 129, 7, None]
)
def test_names_that_no_file_table_or_terminal_can_hold_are_refused_whatever_the_source(
    tmp_path,
    what,
    name,
):
    class Named(Mended):
        def read(self, log):
            yield replace(next(SpeedSource.read(self, log)), **{what: name})

    (tmp_path / "a.txt").write_text("5.0")
    with pytest.raises(
        InputError,
        match=rf"^a\.txt: its {what} .* is no line of 128 printable characters",
    ) as caught:
        Named(
            str(tmp_path),
            cache=str(tmp_path),
            workers=1,
        ).load()
    assert str(caught.value).isprintable()
    assert str(caught.value).isascii()


@pytest.mark.parametrize("part", ["lane", "ring"])
@pytest.mark.parametrize(
    "points",
    [
        np.array([["0", "0"], ["9", "0"]]),
        np.zeros(3),
        np.array([[None, 1], [2, 3]]),
        np.full((3, 2), np.nan),
    ],
)
def test_maps_of_other_points_than_numbers_are_refused_whatever_the_source(
    tmp_path,
    part,
    points,
):
    class Drawn(Mended):
        def read(self, log):
            steady = next(SpeedSource.read(self, log))
            yield (
                replace(steady, lanes={"road": Lane(points)})
                if part == "lane"
                else replace(steady, drivable=[points])
            )

    (tmp_path / "a.txt").write_text("5.0")
    with pytest.raises(
        InputError, match=r"^a\.txt: scene .* is not a list of finite points"
    ):
        Drawn(
            str(tmp_path),
            cache=str(tmp_path),
            workers=1,
        ).load()


class Torn(SpeedSource):
    """Its logs cannot be read."""

    def read(self, log):
        raise ZeroDivisionError("of a file\nby zero")


class Mended(Torn):
    mend = "write it again"


def test_what_reading_a_log_raises_is_told_where_the_source_knows_what_to_do(tmp_path):
    (tmp_path / "a.txt").write_text("5.0")
    with pytest.raises(
        InputError,
        match=r"^a\.txt: Torn\.read failed at .*test_source\.py:\d+: ZeroDivisionError of a",
    ):
        Torn(
            str(tmp_path),
            cache=str(tmp_path),
            workers=1,
        ).load()
    text = (
        r"a\.txt: is none of text files: ZeroDivisionError of a file at .*; "
        r"write it again \(data\.skip_invalid"
    )
    with pytest.raises(InputError, match=text):
        Mended(
            str(tmp_path),
            cache=str(tmp_path),
            workers=1,
        ).load()


class Unread(Mended):
    extra = "files"

    def read(self, log: str) -> Iterator[Recording]:
        raise ImportError("No module named 'files'")


def test_a_library_that_is_missing_ends_the_load_whatever_may_be_skipped(tmp_path):
    (tmp_path / "a.txt").write_text("5.0")
    (tmp_path / "b.txt").write_text("5.0")
    with pytest.raises(
        InputError,
        match=r"a\.txt: a library of its reader .* pip install -e '.*\[files\]'",
    ):
        Unread(
            str(tmp_path),
            cache=str(tmp_path),
            workers=1,
            skip_invalid=True,
        ).load()


# a field of a recording of 200 frames and one car: what a mistaken reader may yield,
# and what is said
WRONG = {
    "states": (
        [None, [[0.0]], np.zeros((200, 1, 3)), np.zeros((200, 1, 4), int)],
        "a float array",
    ),
    "valid": ([None, np.ones((200, 1)), np.ones(200, bool)], "a bool array"),
    "size": ([None, [4.5, 1.9], np.ones((2, 2)), np.array([["4", "2"]])], "an array"),
    "agent_type": (
        [None, [0], np.zeros(1), np.zeros(2, int), np.full(1, 7)],
        "an integer array|numbers from 0 to 3",
    ),
    "ego": ([None, "0", 0.0, True], "the index of a track"),
    "current": (["10", 10.0], "a frame, or None"),
    "lanes": (
        [None, [], {1: Lane(np.zeros((2, 2)))}, {"a": np.zeros((2, 2))}],
        "a dict of|a Lane by",
    ),
    "drivable": ([None, np.zeros((3, 2)), [[[0, 0], [1, 1]]]], "a list of arrays"),
    "lights": (
        [
            None,
            {"road": [1] * 200},
            {"road": np.ones(9, int)},
            {"no lane": np.ones(200, int)},
        ],
        "a dict|an integer array",
    ),
    "repairs": ([None, 3], "a Counter"),
    "heights": (
        [[0.0], np.zeros((200, 2)), np.full((200, 1), "low")],
        "an array|numbers",
    ),
    "towed": ([None, 0, (1,), (-1,), ("0",), (True,)], "a tuple of tracks"),
    "coupled": ([None, 0, (1,), (-1,), ("0",), (0.0,)], "a tuple of tracks"),
}


@pytest.mark.parametrize(
    ("name", "value"),
    [(name, value) for name, (values, _) in WRONG.items() for value in values],
)
def test_a_field_of_another_kind_type_or_shape_is_named_with_its_log(
    tmp_path,
    name,
    value,
):
    class Wrong(SpeedSource):
        def read(self, log):
            yield replace(next(SpeedSource.read(self, log)), **{name: value})

    (tmp_path / "a.txt").write_text("5.0")
    with pytest.raises(
        InputError,
        match=rf"^a\.txt: scene 'a\.txt': its {name}.* is .*expected ({WRONG[name][1]})",
    ):
        Wrong(
            str(tmp_path),
            cache=str(tmp_path),
            workers=1,
        ).load()


@pytest.mark.parametrize(
    ("part", "value"),
    [
        ("points", [[0, 0], [9, 0]]),
        ("width", None),
        ("exits", [1]),
        ("left", "road"),
        ("heights", [0]),
        ("heights", np.zeros(3)),
        ("heights", np.array(["low", "low"])),
    ],
)
def test_a_field_of_a_lane_is_named_with_its_log(
    tmp_path,
    part,
    value,
):
    class Wrong(SpeedSource):
        def read(self, log):
            yield replace(
                next(SpeedSource.read(self, log)), lanes={"a": Lane(np.zeros((2, 2)))}
            )

    (tmp_path / "a.txt").write_text("5.0")
    lane_of = Lane(np.array([[0.0, 0], [900, 0]]))
    setattr(lane_of, part, value)
    Wrong.read = lambda self, log: iter(
        [replace(next(SpeedSource.read(self, log)), lanes={"a": lane_of})]
    )
    with pytest.raises(
        InputError, match=rf"^a\.txt: scene 'a\.txt': its lanes\['a'\]\.{part} is "
    ):
        Wrong(
            str(tmp_path),
            cache=str(tmp_path),
            workers=1,
        ).load()


@pytest.mark.parametrize(
    ("method", "result", "message"),
    [
        ("read", None, r"^a\.txt: Wrong\.read returns NoneType; yield"),
        ("read", [None], r"^a\.txt: Wrong\.read yields NoneType; yield"),
        ("read", [{}], r"^a\.txt: Wrong\.read yields dict; yield"),
        ("logs", None, r"^Wrong\.logs returns NoneType; return a list"),
        ("logs", [3], r"^Wrong\.logs returns other than texts; return a list"),
    ],
)
def test_methods_of_a_reader_that_return_anything_else_are_named(
    tmp_path,
    method,
    result,
    message,
):
    (tmp_path / "a.txt").write_text("5.0")
    wrong = type("Wrong", (SpeedSource,), {method: lambda *_: result})
    with pytest.raises(InputError, match=message):
        wrong(
            str(tmp_path),
            cache=str(tmp_path),
            workers=1,
        ).load()


@pytest.mark.parametrize(
    "error", [KeyError("x"), SystemExit(3), RecursionError(), IndexError("of a list")]
)
@pytest.mark.parametrize("method", ["read", "logs", "fingerprint"])
def test_what_a_reader_raises_has_the_line_that_raised_it(
    tmp_path,
    method,
    error,
):
    if isinstance(error, SystemExit) and method != "read":
        pytest.skip("only reading is done in processes that must not end")

    def fails(*_):
        raise error

    (tmp_path / "a.txt").write_text("5.0")
    wrong = type("Wrong", (SpeedSource,), {method: fails})
    with pytest.raises(
        InputError,
        match=rf"Wrong\.{method} failed at .*test_source\.py:\d+: {type(error).__name__}",
    ):
        wrong(
            str(tmp_path),
            cache=str(tmp_path),
            workers=1,
        ).load()


READER = """
from dataclasses import dataclass
import numpy as np
from my_reader.{helper} import SPEED
from tests.scenes.test_source import SpeedSource
@dataclass
class Reader(SpeedSource):
    def read(self, log):
        for recording in SpeedSource.read(self, log):
            recording.states[..., 0] *= SPEED / 5.0
            recording.states[..., 3] = SPEED
            yield recording
"""


@pytest.mark.parametrize(
    "edited", ["reader.py", "direct.py", "deep/table.py", "deep/__init__.py"]
)
def test_an_edited_reader_or_its_package_invalidates_its_cache(
    tmp_path,
    monkeypatch,
    edited,
):
    package = tmp_path / "code" / "my_reader"
    logs = tmp_path / "logs"
    (package / "deep").mkdir(parents=True)
    logs.mkdir()
    (logs / "a.txt").write_text("5.0")
    contents = {
        "__init__.py": "",
        "reader.py": READER.format(helper="direct"),
        "direct.py": "from .deep.table import SPEED",
        "deep/table.py": "SPEED = 5.0",
        "deep/__init__.py": "",
    }
    monkeypatch.syspath_prepend(str(tmp_path / "code"))
    monkeypatch.setattr("sys.dont_write_bytecode", True)

    def speed() -> float:
        for name, text in contents.items():
            (package / name).write_text(text)
        for name in [
            name for name in sys.modules if name.partition(".")[0] == "my_reader"
        ]:
            del sys.modules[name]
        importlib.invalidate_caches()
        config = {
            "_target_": "my_reader.reader.Reader",
            "path": str(logs),
            "workers": 1,
            "cache": str(tmp_path / "c"),
        }
        scenes = load_scenes(config | {"build": {"field_cells": 32}}).scenes
        return scenes["start"][0, 0, 3].item()

    assert speed() == pytest.approx(5.0, abs=1e-3)
    assert speed() == pytest.approx(5.0, abs=1e-3)
    assert len(list((tmp_path / "c").glob("*.map"))) == 1
    contents[edited] += "\n# another line\n"
    assert speed() == pytest.approx(5.0, abs=1e-3)
    assert len(list((tmp_path / "c").glob("*.map"))) == 2
    contents["deep/table.py"] = "SPEED = 9.0"
    assert speed() == pytest.approx(9.0, abs=1e-3)


def test_a_reader_in_no_file_is_not_cached(tmp_path):
    (tmp_path / "a.txt").write_text("5.0")
    typed = type("Typed", (SpeedSource,), {"__module__": "nowhere"})
    assert typed.code is None
    assert (
        len(
            typed(
                str(tmp_path),
                cache=str(tmp_path / "c"),
                workers=1,
            ).load()
        )
        == 2
    )
    assert not (tmp_path / "c").exists()


def test_split_chooses_only_where_a_source_has_splits(tmp_path):
    bundled = BundledSource(
        cache=str(tmp_path / "cache"),
        workers=1,
        build=BuildSettings(
            field_cells=32,
            steps=20,
        ),
    )
    assert load_scenes(bundled, 1).split == "test"
    assert load_scenes(bundled, 1, split="tune").split == "tune"
    folder = write_folder(tmp_path / "x", scenes_of(1))
    assert (
        load_scenes(data_config(folder, tmp_path / "cache"), split="tune").split == "x"
    )
