"""Commands that drive in a folder of the user's."""

import os
import subprocess
import sys
from pathlib import Path

REPO = Path(__file__).resolve().parents[2]
SCRIPT = f"import sys\nsys.path.append({str(REPO)!r})\nfrom alpasim_plugin.cli.main import main\nif __name__ == '__main__':\n    main()\n"
DRIVE = (
    "run",
    "--renderer",
    "clean",
    "--images",
    "none",
    "--no-report",
    "--seeds",
    "2",
)


def simrun(folder, *arguments):
    """Run a command in a folder by a script that lies elsewhere, as the installed one does."""
    return run_python(folder, str(written_script(folder)), *arguments)


def written_script(folder):
    """Write the script of the command beside the folder; return its path."""
    script = folder.parent / "bin" / "simrun"
    script.parent.mkdir(exist_ok=True)
    script.write_text(SCRIPT)
    return script


def run_python(folder, *arguments):
    """Run Python in a folder, with none of its variables that say what may be imported."""
    environment = {
        key: value
        for key, value in os.environ.items()
        if key not in ("PYTHONPATH", "PYTHONSAFEPATH")
    }
    return subprocess.run(
        [sys.executable, *arguments],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=240,
    )
