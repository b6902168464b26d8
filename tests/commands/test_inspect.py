"""The command that says what a data set holds: counts with known answers, reasons by
log, a picture of a scene."""

import numpy as np
import pytest
from PIL import Image

from e2rl.commands.inspect import main
from e2rl.report import drawing
from tests.report.pixels import rgb
from tests.scenes.descriptions import ALL, description, straight, write_folder


def run(*arguments, capsys) -> str:
    main([str(argument) for argument in (*arguments, "--workers", 1)])
    return capsys.readouterr().out


def number(text: str, name: str) -> str:
    """What stands behind a name in the report."""
    (value,) = [
        rest
        for first, _, rest in (
            line.strip().partition("  ") for line in text.splitlines()
        )
        if first == name
    ]
    return value.strip()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two scenes, the second with lights and three pedestrians more, one that is too
    short, and one in degrees."""
    crowd = {
        f"p{index}": straight(
            60 + index, -6, speed=1, kind="PEDESTRIAN", size=(0.6, 0.6)
        )
        for index in range(3)
    }
    lit = description(description()["tracks"] | crowd, scenario_id="lit") | {
        "id": "lit"
    }
    lit["dynamic_map_states"] = {
        "on": {"state": {"object_state": ["LANE_STATE_STOP"] * len(ALL)}}
    }
    turned = description(scenario_id="turned") | {"id": "turned"}
    for track in turned["tracks"].values():
        track["state"]["heading"] = track["state"]["heading"] + 57.0
    absent = description(scenario_id="absent") | {"id": "absent"}
    absent["tracks"]["ego"]["state"]["valid"] = np.zeros(len(ALL), bool)
    return write_folder(
        tmp_path_factory.mktemp("data") / "made", [description(), lit, turned, absent]
    )


def test_a_data_set_is_counted_and_what_is_left_out_has_its_reason(
    folder, tmp_path, capsys
):
    text = run(folder, "--out", tmp_path / "x.png", capsys=capsys)
    assert number(text, "data") == f"scenarionet, {folder}"
    assert number(text, "logs") == "4"
    assert number(text, "scenes") == "2, places not known"
    assert number(text, "left out") == "2"
    assert "1 x sd_02.pkl" in text
    assert "57 rad is the largest heading" in text
    assert "1 x sd_03.pkl" in text
    assert number(text, "vehicles") == "2 (2 to 2)"
    assert number(text, "pedestrians") == "2 (1 to 4)"
    assert number(text, "lanes") == "4 (4 to 4)"
    assert number(text, "traffic lights") == "0 (0 to 1)"
    assert number(text, "speed of the ego at the start, m/s") == "8.0 (8.0 to 8.0)"
    assert number(text, "distance driven by the ego, m") == "64 (64 to 64)"
    limits = number(text, "limits").removeprefix("km/h on the routes: ").split(", ")
    assert sorted(limit.split(" ")[0] for limit in limits) == ["50", "72"]
    assert sum(int(limit.split(" ")[1].strip("%")) for limit in limits) == 100
    assert (
        number(text, "% of lanes with a successor") == "25 (25 to 25)"
    )  # `in` alone goes on


def test_the_chosen_scene_is_drawn_with_the_ego_in_the_middle(folder, tmp_path, capsys):
    text = run(
        folder,
        "--scene",
        "lit",
        "--metres",
        60,
        "--out",
        tmp_path / "lit.png",
        capsys=capsys,
    )
    assert text.endswith(f"lit: {tmp_path / 'lit.png'}\n")
    with Image.open(tmp_path / "lit.png") as picture:
        width, height = picture.size
        assert width == 900
        assert height == 900 + 34 + 30
        assert picture.getpixel((450 - 15, 34 + 450)) == rgb(
            drawing.EGO
        )  # 1 m behind its middle, at 15 pixels a m


@pytest.mark.parametrize(
    ("path", "arguments", "messages"),
    [
        (".", ("--scene", "nobody"), ["--scene=nobody: name a scene of"]),
        (".", ("--data", "nothing"), ["data=nothing: none of"]),
        (
            "none",
            (),
            [".pkl", ".xml", "scenario_*.parquet"],
        ),  # what each of the sources reads
    ],
)
def test_what_is_not_there_ends_with_one_line_and_writes_nothing(
    folder, tmp_path, capsys, path, arguments, messages
):
    (folder / "none").mkdir(exist_ok=True)
    with pytest.raises(SystemExit) as ended:
        run(folder / path, *arguments, "--out", tmp_path / "x.png", capsys=capsys)
    error = capsys.readouterr().err.splitlines()[-1]
    assert ended.value.code == 2
    assert error.startswith("error: ")
    assert all(message in error for message in messages)
    assert not (tmp_path / "x.png").exists()


def test_where_no_log_makes_a_scene_the_reasons_are_told(tmp_path, capsys):
    folder = write_folder(
        tmp_path / "x",
        [
            description(
                {"ego": straight(20, 0, speed=8), "7": straight(23, 0.5, speed=8)}
            )
        ],
    )
    with pytest.raises(SystemExit):
        run(folder, "--out", tmp_path / "x.png", capsys=capsys)
    shown = capsys.readouterr()
    assert number(shown.out, "left out") == "1"
    assert "1 x ego overlaps a vehicle at the start" in shown.out
    assert "no log makes a scene" in shown.err
    assert "None" not in shown.err


def test_two_data_sets_are_apart_where_they_share_no_place(tmp_path, capsys):
    """As a split into training and test scenes must be; what has no place cannot be
    told."""
    index = "file,location_group\none/sd_00.pkl,a\none/sd_01.pkl,b\n"
    for name, ids in (("one", ("x", "y")), ("two", ("z",)), ("three", ("v", "w"))):
        write_folder(
            tmp_path / name,
            [description(scenario_id=item) | {"id": item} for item in ids],
        )
    for name, place in (("two", "c"), ("three", "b")):
        for path in sorted((tmp_path / name).glob("*.pkl")):
            path = path.rename(path.with_stem(f"{name}-{path.stem}"))
            index += f"{name}/{path.name},{place}\n"
    (tmp_path / "index.csv").write_text(index)
    out = tmp_path / "x.png"
    text = run(
        tmp_path / "one", "--apart", tmp_path / "two", "--out", out, capsys=capsys
    )
    assert number(text, "apart") == f"from the 1 places of {tmp_path / 'two'}"
    assert number(text, "scenes") == "2, of 2 places"
    for other, message in (
        ("three", "1 places in common (b); part them by place"),
        ("alone/four", "is not known"),
    ):
        if other == "alone/four":
            write_folder(tmp_path / other, [description()])
        with pytest.raises(SystemExit):
            run(
                tmp_path / "one",
                "--apart",
                tmp_path / other,
                "--out",
                out,
                capsys=capsys,
            )
        assert message in capsys.readouterr().err
