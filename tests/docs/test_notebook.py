"""The notebook runs from its first cell to its last, and shows what it says."""

from pathlib import Path

import pytest

nbformat = pytest.importorskip("nbformat", reason="of the extra test")
nbclient = pytest.importorskip("nbclient", reason="of the extra test")

NOTEBOOK = Path(__file__).resolve().parents[2] / "examples" / "first_steps.ipynb"
SMALL = "frames=2_000, num_envs=4, frames_per_batch=1_000"


def test_the_notebook_trains_plots_evaluates_and_shows_a_video(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(NOTEBOOK.parents[1]))
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert not any(cell.outputs for cell in code)
    code[0].source = code[0].source.replace("frames=200_000", SMALL)
    for cell in code[3:]:
        cell.source = cell.source.replace("episodes=20", "episodes=2")
    nbclient.NotebookClient(
        notebook, timeout=600, resources={"metadata": {"path": tmp_path}}
    ).execute()
    shown = [set().union(*(o.get("data", ()) for o in cell.outputs)) for cell in code]
    run, plot, table, _, video, _ = shown
    assert {"text/html"} <= run & table & video
    assert "image/png" in plot
