"""Figures as files: a PNG, and the same as vectors in a PDF."""

import re
import zlib

from PIL import Image

from e2rl.report.drawing import add_legend, new_panels, save_figure
from e2rl.report.plots import plain_figure


def figure():
    made, axes = new_panels(2, 200, 10, 40, 30)
    axes[0].plot([0, 1, 2], [0, 1, 0], linewidth=2)
    axes[1].set_title("collisions η, ± 95%")
    add_legend(made, {"ego": "#1565d8"}, 10)
    return made


def test_a_figure_is_written_as_pixels_and_as_vectors_with_its_fonts(tmp_path):
    save_figure(tmp_path / "x.png", figure())
    with Image.open(tmp_path / "x.png") as picture:
        assert picture.size == (410, 270)
    content = (tmp_path / "x.pdf").read_bytes()
    assert content.startswith(b"%PDF") and b"/FontFile2" in content and b"/Subtype /Image" not in content
    assert re.search(rb"/MediaBox \[ 0 0 410 270 \]", content), "a point is a point"
    drawn = b"".join(
        zlib.decompress(part) for part in re.findall(rb"stream\r?\n(x.*?)\r?\nendstream", content, re.DOTALL)
    )
    assert re.search(rb"\d m\n.*\d l\n.*S\n", drawn, re.DOTALL), "lines, not pixels"


def test_the_same_figure_makes_the_same_bytes(tmp_path):
    for name in "ab":
        save_figure(tmp_path / f"{name}.png", figure())
    for suffix in ("png", "pdf"):
        assert (tmp_path / f"a.{suffix}").read_bytes() == (tmp_path / f"b.{suffix}").read_bytes()
    assert b"Date" not in (tmp_path / "a.pdf").read_bytes()


def test_layouts_that_are_made_on_drawing_fit_both(tmp_path):
    made, axes = plain_figure(300, 200, 1)
    axes[0].bar([0, 1], [1, 2])
    axes[0].set_ylabel("failures [%]")
    save_figure(tmp_path / "x.png", made)
    assert re.search(rb"/MediaBox \[ 0 0 300 200 \]", (tmp_path / "x.pdf").read_bytes())
