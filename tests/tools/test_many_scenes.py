"""Many scenes out of few logs: cut at other starts and mirrored, built, opened and driven."""

import re

from tests.scenes.descriptions import description, numbered, straight, write_folder
from tools import many_scenes


def test_logs_make_many_scenes_whose_cost_is_told(tmp_path, monkeypatch, capsys):
    logs = numbered([description({"ego": straight(20, 0, 8), "7": straight(60 + k, 0, 3)}) for k in range(2)])
    monkeypatch.setattr(many_scenes, "apart", many_scenes.told)  # its processes would import all of it three times
    folder = write_folder(tmp_path / "logs", logs)
    small = ["data.workers=1", "data.build.field_cells=64", "processes=1", "methods=[replay]", "seeds=[0]"]
    many_scenes.main([str(folder), "--scenes", "40", "--evaluate", "3", *small])
    built, driven = capsys.readouterr().out.strip().splitlines()
    assert re.match(
        r"built 40 scenes in \d+ s: 0\.\d+ s of CPU and 0\.\d+ MB each, cache \d+ MB, at most \d+ MiB", built
    )
    assert "opened 40 scenes" in driven and "drove 3 rollouts in 3 of them" in driven
    assert re.search(r"\d failures, \d+ an hour; 0 without a score", driven)
