"""Figures as PNG files."""

from PIL import Image

from e2rl.report.drawing import new_figure, save_figure


def test_no_name_in_a_figure_is_a_formula(tmp_path):
    figure = new_figure(410, 270)
    axes = figure.subplots(1, 2)
    axes[0].plot([0, 1, 2], [0, 1, 0], linewidth=2)
    axes[0].set_title("$\\frac{")
    save_figure(tmp_path / "a.png", figure)
    with Image.open(tmp_path / "a.png") as image:
        assert image.size == (410, 270)
