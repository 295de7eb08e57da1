"""The environment of a process that imports the generated messages."""

import subprocess
import venv


def environment(folder, *requirements):
    """Make a virtual environment with some packages; return its Python."""
    venv.create(folder, with_pip=True)
    python = folder / "bin" / "python"
    subprocess.run([python, "-m", "pip", "install", "-q", *requirements], check=True)
    return python
