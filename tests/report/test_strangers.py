"""A stranger's run folder: what is damaged, no file or elsewhere is refused in one
line, and nothing is written."""

import json
import os
import shutil
from functools import reduce

import pytest

from e2rl.commands import export, merge, replay, report
from e2rl.evaluation.rollout_files import (
    METRICS_FILE,
    MODES_FILE,
    TABLE,
    read_rows,
    write_rows,
)
from e2rl.run.run import PROVENANCE
from e2rl.sim.rollout_file import ROLLOUTS
from tests.report.failed_run import failed_run


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run that all commands read."""
    folder = failed_run(tmp_path_factory.mktemp("strange") / "run")
    names = ("choices", "files", "inputs", "settings")
    provenance = {"command": "", "cwd": ""} | {name: {} for name in names}
    provenance["versions"] = [{"git": "0"}]
    (folder / PROVENANCE).write_text(json.dumps(provenance))
    (folder / "parts").mkdir()
    (folder / "parts" / "rollouts-000000.pt").write_bytes(b"a part")
    return folder


def json_with(*place):
    """A change of a JSON file: what lies at a place is the last argument; None: is not
    there."""
    *where, key, value = place

    def change(path):
        content = json.loads(path.read_text())
        part = reduce(lambda found, each: found[each], where, content)
        part.pop(key) if value is None else part.__setitem__(key, value)
        path.write_text(json.dumps(content))

    return change


def rows_with(**values):
    return lambda path: write_rows(path, [row | values for row in read_rows(path)])


def instead(content):
    return lambda path: path.write_bytes(content)


def link(target):
    return lambda path: (path.unlink(), path.symlink_to(target))


def pipe(path):
    path.unlink()
    os.mkfifo(path)


def swapped(path):
    """Each rollout has the content of another."""
    files = sorted(path.iterdir())
    contents = [file.read_bytes() for file in files]
    for file, content in zip(files, contents[1:] + contents[:1], strict=True):
        file.write_bytes(content)


COMMANDS = {
    "report": lambda run, out: report.main([str(run), "--out", str(out / "x.html")]),
    "replay": lambda run, out: replay.main([str(run), "--modes", "--out", str(out)]),
    "export": lambda run, out: export.main(
        [str(run), "--to", "npz", "--no-scene", "--out", str(out)]
    ),
    "merge": lambda run, out: merge.main([str(run), "--into", str(out)]),
}
DAMAGE = [
    ("report", TABLE, instead(b"dataset,split,method,ego_policy,scene_id,seed,eta\n")),
    ("report", TABLE, rows_with(contact_step=1e6)),
    (
        "report",
        TABLE,
        lambda path: path.write_bytes(path.read_bytes().replace(b"test", b"\x1b[2J")),
    ),
    (
        "report",
        TABLE,
        lambda path: path.write_bytes(
            path.read_bytes().replace(b"test", b"\xed\xa0\x80")
        ),
    ),
    ("export", TABLE, link("/dev/zero")),
    ("report", METRICS_FILE, json_with(0, "metrics", "cfr", "mean", None)),
    ("report", METRICS_FILE, json_with(0, "paired", "planned", "cfr", "n", None)),
    ("report", METRICS_FILE, json_with(0, "n_scenes", 10**400)),
    ("report", METRICS_FILE, json_with(0, "ego", "\ud800")),
    ("report", METRICS_FILE, instead(b"[" * 200_000)),
    ("report", METRICS_FILE, instead(b"[]")),
    ("report", METRICS_FILE, pipe),
    ("report", MODES_FILE, link("/etc/hostname")),
    ("replay", MODES_FILE, instead(b"[1]")),
    ("replay", MODES_FILE, json_with("modes", 0, "typical", "file", "../secret.npz")),
    ("replay", MODES_FILE, json_with("modes", 0, "typical", "file", "other.npz")),
    ("replay", MODES_FILE, json_with("modes", 0, "name", "\u202egnp.exe")),
    ("export", ROLLOUTS, swapped),
    (
        "export",
        ROLLOUTS,
        lambda path: [link("/dev/zero")(file) for file in path.iterdir()],
    ),
    ("merge", "parts/rollouts-000000.pt", link("/etc/hostname")),
    ("merge", "parts/rollouts-000000.pt", pipe),
    ("merge", TABLE, link("/dev/zero")),
    ("merge", PROVENANCE, json_with("command", "it's")),
]


@pytest.mark.parametrize(("command", "name", "damage"), DAMAGE)
def test_a_damaged_folder_is_refused_in_one_line(
    run, tmp_path, capsys, command, name, damage
):
    copy = shutil.copytree(run, tmp_path / "run")
    damage(copy / name)
    before = sorted(copy.rglob("*"))
    with pytest.raises(SystemExit) as end:
        COMMANDS[command](copy, tmp_path / "out")
    said = capsys.readouterr().err
    assert end.value.code == 2
    assert said.startswith(f"error: {copy}")
    assert said.removesuffix("\n").isprintable()
    assert sorted(copy.rglob("*")) == before
    assert not list(tmp_path.rglob("out/*"))


def test_the_folder_itself_is_read_by_all_commands(run, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(
        "e2rl.commands.replay.save_animation", lambda path, frames: None
    )
    monkeypatch.setattr("e2rl.report.picture.Replay.frames", lambda shown: [])
    for name, command in COMMANDS.items():
        command(run, tmp_path / name)
        assert not capsys.readouterr().err.startswith("error"), name


@pytest.mark.parametrize("command", ["replay", "export"])
def test_a_link_out_of_the_folder_is_not_written_to(run, tmp_path, capsys, command):
    copy = shutil.copytree(run, tmp_path / "run")
    (tmp_path / "home").mkdir()
    for name in ("replays", "export"):
        (copy / name).symlink_to(tmp_path / "home")
    main = {"replay": replay.main, "export": export.main}[command]
    with pytest.raises(SystemExit) as end:
        main(
            [str(copy), *(["--to", "npz", "--no-scene"] if command == "export" else [])]
        )
    assert end.value.code == 2
    assert "a link out of" in capsys.readouterr().err
    assert not list((tmp_path / "home").iterdir())
