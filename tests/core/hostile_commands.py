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
    script = folder.parent / "bin" / "simrun"
    script.parent.mkdir(exist_ok=True)
    script.write_text(SCRIPT)
    environment = {
        key: value
        for key, value in os.environ.items()
        if key not in ("PYTHONPATH", "PYTHONSAFEPATH")
    }
    command = [sys.executable, str(script), *arguments]
    return subprocess.run(
        command,
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=240,
    )
