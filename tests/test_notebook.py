"""The notebook of the documentation, cell by cell, on a run that takes seconds."""

import nbformat
from nbclient import NotebookClient

from rgs_mi.commands.optimize import optimize

from runs import ROOT, SMALL


def test_notebook(inputs, tmp_path, monkeypatch):
    scene, data = inputs
    monkeypatch.setenv("RGS_MI_RUN", str(optimize(scene, data=data, overrides=SMALL, out=tmp_path / "run", quiet=True)))
    notebook = nbformat.read(ROOT / "docs" / "notebook.ipynb", as_version=4)
    NotebookClient(notebook, timeout=120, kernel_name="python3").execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    assert sum("image/png" in output.get("data", {}) for output in outputs) == 5
    (told,) = [output["text"] for output in outputs if output.output_type == "stream" and output.name == "stdout"]
    first, last = (float(part.split()[0]) for part in told.split("factor ")[1].split(" (")[0].split(" -> "))
    assert abs(last - 1) < 0.5 * abs(first - 1)
