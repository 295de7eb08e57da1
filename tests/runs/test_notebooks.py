"""The notebooks of docs/notebooks run from the first cell to the last, in a process and a folder of
their own.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("pandas")

NOTEBOOKS = sorted((Path(__file__).resolve().parents[2] / "docs" / "notebooks").glob("*.ipynb"))
SAYS = {
    "first-policy": "at-fault collision",
    "compare-renderers": "4 rollouts. No difference shown",
}


def code_of(notebook: Path) -> str:
    """Return a program of the notebook's cells, which prints what the last line of each shows."""
    cells = [
        cell
        for cell in json.loads(notebook.read_text(encoding="utf-8"))["cells"]
        if cell["cell_type"] == "code"
    ]
    assert not any(cell["outputs"] for cell in cells), (
        f"{notebook.name}: clear the outputs before it is committed"
    )
    return "\n".join(f"exec_cell({''.join(cell['source'])!r})" for cell in cells)


SHELL = """
import ast
space = {"__name__": "__main__"}

def exec_cell(text):
    tree = ast.parse(text)
    last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
    exec(compile(tree, "cell", "exec"), space)
    if last is not None:
        print(repr(eval(compile(ast.Expression(last.value), "cell", "eval"), space)))
"""


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=[path.stem for path in NOTEBOOKS])
def test_its_cells_run(notebook: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MPLBACKEND", "agg")
    done = subprocess.run(
        [sys.executable, "-c", SHELL + code_of(notebook)],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    assert SAYS[notebook.stem] in done.stdout
