"""Every command on every page: it is understood by the command line, and it works from an empty
folder with the built wheel.

The second is slow: ``pytest -m slow`` on this file.
"""

import itertools
import os
import re
import shlex
import shutil
import subprocess
import sys
import venv
from pathlib import Path

import cv2
import numpy as np
import pytest

from alpasim_plugin.cli.main import PANELS, verbs
from alpasim_plugin.log import write_mp4
from tests.docs.commands import (
    LONGER,
    NOTHING_FITTED,
    OTHER,
    SHORT,
    TINY,
    TUTORIALS,
    commands,
    lines_of,
    pages,
)
from tests.docs.parsed_commands import needing_the_checkout, not_understood

REPO = Path(__file__).resolve().parents[2]
COMMANDS = [one for one in commands(REPO, pages(REPO)) if not one.is_of_lab]
RUN = [command for command in COMMANDS if not command.why_not_run]


def test_every_command_of_the_pages_is_understood():
    assert not_understood(COMMANDS) == []
    assert len(COMMANDS) > 50
    assert len(RUN) > 20


def test_every_verb_is_on_a_page():
    text = "\n".join(page.read_text(encoding="utf-8") for page in pages(REPO))
    own = [verb for group in PANELS.values() for verb in group]
    assert [verb for verb in own if not re.search(rf"simrun {verb}\b", text)] == []


def test_commands_do_not_need_the_checkout_nor_an_index():
    """But for the two that set it up, and the records of experiments, which say where they were
    run.
    """
    assert needing_the_checkout(pages(REPO)) == []


# --- with the wheel, from an empty folder


@pytest.fixture(scope="module")
def simrun(tmp_path_factory):
    """Build the wheel and give the command that it installs, in an environment whose libraries are
    those of the tests.
    """
    folder = tmp_path_factory.mktemp("wheel")
    build = [
        sys.executable,
        "-m",
        "pip",
        "wheel",
        "-q",
        "--no-deps",
        "--no-build-isolation",
        "-w",
        str(folder),
        str(REPO),
    ]
    subprocess.run(build, check=True, cwd=folder)
    venv.create(folder / "env", with_pip=True)
    (packages,) = (folder / "env").glob("lib/python*/site-packages")
    libraries = folder / "libraries"
    link_libraries(libraries)
    (packages / "libraries.pth").write_text(f"{libraries}\n")
    (wheel,) = folder.glob("*.whl")
    python = folder / "env" / "bin" / "python"
    subprocess.run(
        [python, "-m", "pip", "install", "-q", "--no-deps", "--no-index", str(wheel)], check=True
    )
    where = subprocess.run(
        [python, "-c", "import scenarios; print(scenarios.__file__)"],
        check=True,
        capture_output=True,
        text=True,
        cwd=folder,
    )
    assert where.stdout.startswith(str(packages)), "the checkout is in the way"
    return folder / "env" / "bin" / "simrun"


def link_libraries(folder):
    """Link what is installed beside the tests, but for this project and its laboratory: the wheel is
    the only simrun.
    """
    folder.mkdir()
    for packages in (Path(path) for path in sys.path if path.endswith("site-packages")):
        for entry in packages.iterdir():
            link = folder / entry.name
            is_own = entry.name.startswith(("alpasim_onefixer", "__editable__"))
            if not is_own and entry.suffix != ".pth" and not link.exists():
                link.symlink_to(entry)


@pytest.fixture(scope="module")
def empty(tmp_path_factory):
    """Give a folder that is empty but for what the pages call the reader's own."""
    folder = tmp_path_factory.mktemp("elsewhere")
    parts = (REPO / "docs" / "extending.md").read_text(encoding="utf-8")
    own = "\n".join(re.findall(r"^```python\n(.*?)^```", parts, re.S | re.M))
    (folder / "my_parts.py").write_text(own)
    (folder / "weights.npz").write_bytes(b"weights")
    policy = f"{own}\n\nMine = MyPolicy = Straight\n"
    (folder / "my_policy.py").write_text(policy)
    (folder / "my_second.py").write_text(policy)
    page = (REPO / "docs" / "policies.md").read_text(encoding="utf-8")
    (commanded,) = re.findall(r"^```python\n([^`]*serve_policy\(.*?)^```", page, re.S | re.M)
    (folder / "remote_policy.py").write_text(commanded)
    (folder / "my_package").mkdir()
    (folder / "my_package" / "__init__.py").touch()
    (folder / "my_package" / "my_module.py").write_text(policy)
    (folder / "drive.csv").write_text("\n".join(f"{100_000 * i},{0.5 * i},0" for i in range(26)))
    (folder / "scenario.yaml").write_text(
        "version: 1\nroad: {segments: [{kind: straight, length_m: 120}]}\ntiming: {duration_us: 1200000}\n"
    )
    picture = cv2.GaussianBlur(
        np.random.default_rng(0).integers(0, 256, (144, 256, 3), dtype=np.uint8), (0, 0), 4
    )
    for name, value in (
        ("drive", picture),
        ("render", picture),
        ("alpha", np.full_like(picture, 255)),
        ("map", np.zeros_like(picture)),
    ):
        write_mp4(folder / f"{name}.mp4", [value] * 6, 10.0)
    for name in ("frames", "alphas"):
        (folder / name).mkdir()
        for i in range(3):
            cv2.imwrite(
                str(folder / name / f"{i}.png"),
                picture if name == "frames" else np.full_like(picture, 255),
            )
    yield folder
    shutil.rmtree(folder, ignore_errors=True)


def shortened(words):
    """Return a command that does the same in seconds: short drives, one seed, nothing fitted. What
    is fitted from the wheel is on the page of a good renderer, whose commands are walked whole.
    """
    if words[:3] == ("new", "policy", "my_policy"):  # the folder has one of the page's name already
        return ["new", "policy", "my_first_policy"]
    args = [
        "scenario.yaml"
        if word == "SCENARIO"
        else re.sub("suites/(urban|hard|first)", "suites/smoke", word)
        for word in words
    ]
    if args[0] not in verbs() or args[0] == "run":
        short = LONGER if "timing.timeline=alpasim" in args else SHORT
        if "--until-decided" in args:  # it needs many scenes
            short = (*short, *TINY)
        more = () if any("drive.csv" in word for word in args) else (*short, *NOTHING_FITTED)
        return [*without_option(args, "--seeds"), *more, "--seeds", "1"]
    return args


def without_option(words, option):
    """Return words without an option and its value."""
    if option not in words:
        return words
    place = words.index(option)
    return [*words[:place], *words[place + 2 :]]


def distinct(of):
    """Return the first command of those that are the same once they are shortened."""
    first = {}
    for command in of:
        first.setdefault(tuple(shortened(command.words)), command)
    return list(first.values())


def call(simrun, folder, words):
    environment = {
        key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "VIRTUAL_ENV")
    }
    environment["PATH"] = f"{simrun.parent}{os.pathsep}{environment.get('PATH', '')}"
    return subprocess.run(
        [simrun, *words], cwd=folder, env=environment, capture_output=True, text=True, check=False
    )


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("command", distinct(RUN), ids=str)
def test_the_command_works_from_an_empty_folder_with_the_wheel(simrun, empty, command):
    words = shortened(command.words)
    if command.words[0] in ("fork", "compare", "report", "score", "view", "export"):
        prepare(simrun, empty, words)
    if words[0] == "new":  # other pages write the same files
        for file in (*empty.glob(f"{words[2]}*"), *empty.glob(f"test_{words[2]}*")):
            shutil.rmtree(file) if file.is_dir() else file.unlink()
    if words[0] == "gate":  # the newest run has two variants
        prepare(simrun, empty, ["runs/two"])
    if words[0] == "refine":  # other pages write the same files
        for made in (
            empty / word
            for option, word in itertools.pairwise(words)
            if option in ("-o", "--compare")
        ):
            shutil.rmtree(made) if made.is_dir() else made.unlink(missing_ok=True)
    done = call(simrun, empty, words)
    assert (
        done.returncode in (0, 1, 3)
        if words[0] in ("check", "compare", "gate")
        else done.returncode == 0
    ), done.stderr[-3000:]
    assert "Traceback" not in done.stderr


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("page", TUTORIALS)
def test_every_step_of_the_tutorial_ends_as_it_says(simrun, tmp_path, page):
    text = (REPO / page).read_text(encoding="utf-8")
    for block in re.findall(r"^```yaml\n(# .*?)^```", text, re.S | re.M):
        (tmp_path / block.split()[1]).write_text(block)
    blocks = re.findall(r"^```bash\n(.*?)^```", text, re.S | re.M)
    lines = [line for block in blocks for line in block.splitlines()]
    assert len(lines) > 4
    for line in lines:
        command, *words = shlex.split(line, comments=True)
        assert command == "simrun"
        if "--images" in words:  # which says none: no film of failures is looked at either
            words += ["--video", "none"]
        code = re.search(r"# exit code (\d)$", line)
        done = call(simrun, tmp_path, words)
        assert done.returncode == (int(code[1]) if code else 0), line + done.stderr[-3000:]


def prepare(simrun, folder, words):
    """Make the run that a command reads, once."""
    runs = {
        "runs/us101": ["--renderer", "3dgs", "real/us101", *NOTHING_FITTED],
        "runs/lead_car": ["--renderer", "clean", "smoke/lead_car", *SHORT, *NOTHING_FITTED],
        "runs/two": ["--renderer", "clean,3dgs", "suites/smoke", *SHORT, *NOTHING_FITTED],
        "runs/smoke": ["--renderer", "clean", "suites/smoke", *SHORT, *NOTHING_FITTED],
    }
    for name in [word for word in words if word in runs and not (folder / word).exists()]:
        made = call(simrun, folder, [*runs[name], "--out", name])
        assert made.returncode == 0, made.stderr[-3000:]


def test_other_commands_of_the_pages_are_those_of_a_checkout_or_of_pip_or_the_wizard():
    # test_bridge.py runs the wizard
    known = (
        "tests",
        "docs/scripts",
        "-m alpasim_plugin.",
        "venv",
        "pip ",
        "-m alpasim_wizard ",
    )
    others = {line for page in pages(REPO) for line in lines_of(page) if OTHER.match(line)}
    assert [line for line in sorted(others) if not any(part in line for part in known)] == []
