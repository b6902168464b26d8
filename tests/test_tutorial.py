"""The tutorial notebook runs from its first to its last cell, and is stored without
outputs."""

import json
import os
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
NOTEBOOK = ROOT / "docs" / "tutorial.ipynb"


def test_no_outputs_are_stored():
    cells = [
        cell
        for cell in json.loads(NOTEBOOK.read_text())["cells"]
        if cell["cell_type"] == "code"
    ]
    assert cells
    assert not [cell for cell in cells if cell["outputs"] or cell["execution_count"]]


@pytest.mark.slow
def test_the_notebook_runs_and_shows_a_failure(tmp_path, monkeypatch):
    pytest.importorskip("ipykernel", reason="needs ipykernel, of the extra test")
    nbclient = pytest.importorskip(
        "nbclient", reason="needs nbclient, of the extra test"
    )
    nbformat = pytest.importorskip("nbformat")
    monkeypatch.setenv(
        "PYTHONPATH", os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    )
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    client = nbclient.NotebookClient(
        notebook, timeout=600, resources={"metadata": {"path": str(tmp_path)}}
    )
    client.execute()  # raises where a cell does
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    kinds = {kind for output in outputs for kind in output.get("data", {})}
    said = "".join(output.get("text", "") for output in outputs)
    assert {"image/png", "image/gif"} <= kinds
    assert "duty broken" in said
    assert "12 rollouts" in said
