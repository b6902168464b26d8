"""Files of other tools inside the page: the bytes that `e2rl export` writes, on request
only, and one message for what does not go together."""

import base64
import io
import zipfile
import zlib

import pytest

from e2rl.commands import export, report
from e2rl.report.html import PAGE
from tests.report.failed_run import failed_run
from tests.report.test_html import data_of


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return failed_run(tmp_path_factory.mktemp("run"))


def attached_to(run, out, *options: str) -> dict:
    """The data block of the page of these options."""
    report.main([str(run), "--no-scene", "--out", str(out), *options])
    return data_of(out.read_text())


def content_of(file: dict) -> bytes:
    content = zlib.decompress(base64.b64decode(file["data"]))
    assert len(content) == file["size"]
    return content


def refused(capsys, *arguments: object) -> str:
    with pytest.raises(SystemExit) as end:
        report.main([str(argument) for argument in arguments])
    assert end.value.code == 2
    return capsys.readouterr().err.strip().splitlines()[-1]


def test_each_replayed_failure_holds_what_export_writes(run, tmp_path):
    options = ("--attach", "npz", "--replays", "3")
    data = attached_to(run, tmp_path / "page.html", *options)
    replayed = [
        entry["key"] for entry in data["failures"] if entry["replay"] is not None
    ]
    assert len(replayed) == 3
    assert sorted(data["attached"]) == sorted(replayed)
    out = tmp_path / "exported"
    export.main([str(run), "--to=npz", "--no-scene", "--out", str(out)])
    for name, (file,) in data["attached"].items():
        assert file["name"] == f"{name}.npz.zip"
        with zipfile.ZipFile(io.BytesIO(content_of(file))) as archive:
            (inside,) = archive.namelist()
            assert archive.read(inside) == (out / inside).read_bytes()


def test_a_file_that_needs_no_other_is_no_archive(run, tmp_path):
    pytest.importorskip("foxglove", reason="needs the extra mcap")
    options = ("--attach", "mcap", "--attach", "npz", "--replays", "1")
    data = attached_to(run, tmp_path / "page.html", *options)
    ((name, files),) = data["attached"].items()
    assert [file["name"] for file in files] == [f"{name}.mcap", f"{name}.npz.zip"]
    assert content_of(files[0]).startswith(b"\x89MCAP0\r\n")


def test_without_the_option_nothing_is_attached(run):
    report.main([str(run)])
    assert "attached" not in data_of((run / PAGE).read_text())


def test_what_does_not_go_together_gets_one_message(run, capsys):
    message = refused(capsys, run, "--attach", "npz", "--replays", 0)
    assert message == (
        "error: --attach: goes with replays, and --replays 0 has none; leave one out"
    )
    message = refused(capsys, run, run, "--attach", "npz")
    assert message == "error: --attach: for one run; leave it out"
    message = refused(capsys, run, "--no-scene")
    assert message == "error: --no-scene, --plugin: for --attach FORMAT; pass it, too"
    assert "invalid choice: 'zip'" in refused(capsys, run, "--attach", "zip")


def test_data_that_are_missing_are_named_before_a_page_is_written(
    run, tmp_path, capsys
):
    out = tmp_path / "page.html"
    message = refused(capsys, run, "--attach", "npz", "--out", out)
    assert "says where its scenes come from" in message
    assert not out.exists()
