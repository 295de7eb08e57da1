"""Ways in which files from a stranger could run as code: none does, in whatever verb meets them.

Each way is a bait that leaves its name in a file if it is run. The working directory is the
stranger's folder.
"""

import pickle
import stat
import subprocess
import zipfile

import numpy as np
import pytest
import torch

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.log.run_folder.schema import ROLLOUTS_FOLDER
from tests.core.hostile_commands import DRIVE, simrun

SHORT_DRIVE = [
    *DRIVE,
    *("--out", "new", "--seeds", "1", "--set", "timing.duration_us=1200000", "smoke/straight"),
]


class Bait:
    """What leaves its name in a file when it is run, in the languages that the ways need."""

    def __init__(self, folder, name):
        self.mark = folder.parent / "ran"
        self.name = name

    @property
    def python(self):
        return f"open({str(self.mark)!r}, 'a').write({self.name!r} + ' ')\n"

    @property
    def shell(self):
        return f"echo {self.name} >> {self.mark}"

    def __reduce__(self):
        return exec, (self.python,)


def python_file(*names):
    def way(folder, bait):
        for name in names:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_text(bait.python)
        return [
            ["compare", "run"],
            ["list", "policies"],
            ["run", "--dry-run", *DRIVE[1:], "smoke/straight"],
        ]

    return way


def metadata(folder, bait):
    (folder / "evil.py").write_text(bait.python)
    info = folder / "evil-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: evil\nVersion: 1.0\n")
    groups = (
        "simrun.policies",
        "simrun.commands",
        "simrun.evaluators",
        "simrun.sources",
        "numba_extensions",
        "pydantic",
    )
    (info / "entry_points.txt").write_text(
        "".join(f"[{group}]\nevil = evil:Evil\n" for group in groups)
    )
    return [["list", "policies"], ["--help"], ["evil"]]


def path_file(folder, bait):
    (folder / "evil.pth").write_text(f"import os; exec({bait.python!r})\n")
    (folder / "lib" / "python3.11" / "site-packages").mkdir(parents=True)
    (folder / "lib" / "python3.11" / "site-packages" / "evil.pth").write_text(
        f"import os; exec({bait.python!r})\n"
    )
    (folder / "pyvenv.cfg").write_text("home = .\n")
    return [["compare", "run"]]


def git_hooks(folder, bait):
    subprocess.run(["git", "init", "-q", "."], cwd=folder, check=True)
    (folder / "kept.txt").write_text("as committed")
    subprocess.run(["git", "add", "kept.txt"], cwd=folder, check=True)
    subprocess.run(
        ["git", "-c", "user.name=a", "-c", "user.email=a@b", "commit", "-qm", "a"],
        cwd=folder,
        check=True,
    )
    (folder / "kept.txt").write_text("otherwise")
    hook = folder / "hook"
    hook.write_text(f"#!/bin/sh\n{bait.shell}\n")
    hook.chmod(hook.stat().st_mode | stat.S_IXUSR)
    core = (f"core.{name}" for name in ("fsmonitor", "sshCommand", "pager", "editor", "hooksPath"))
    for name in (*core, "diff.external", "filter.x.clean", "gpg.program"):
        subprocess.run(
            ["git", "config", name, str(hook) if name != "core.hooksPath" else "."],
            cwd=folder,
            check=True,
        )
    for name in ("post-checkout", "pre-commit", "post-index-change"):
        (folder / name).write_bytes(hook.read_bytes())
        (folder / name).chmod(0o755)
    (folder / ".gitattributes").write_text("* filter=x\n")
    return [SHORT_DRIVE]


def yaml_tags(folder, bait):
    (folder / "tag.yaml").write_text(f"!!python/object/apply:os.system [{bait.shell!r}]\n")
    (folder / "key.yaml").write_text(
        f"version: 1\nscene_id: !!python/object/apply:os.system [{bait.shell!r}]\n"
    )
    commands = [["run", "--dry-run", *DRIVE[1:], name] for name in ("tag.yaml", "key.yaml")]
    return [*commands, ["gate", "run", "--gate", "tag.yaml"]]


def pickles_of_a_run(folder, bait):
    for name in (
        "results.pkl",
        "rollouts.pkl",
    ):
        (folder / "run" / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / "run" / name).write_bytes(pickle.dumps(("success", bait)))
    return [
        ["check", "run", "run"],
        ["report", "run"],
        [*DRIVE, "--out", "run", "--resume", "smoke/straight"],
    ]


def weights(folder, bait):
    torch.save({"weight": bait}, folder / "evil.pt")
    (folder / "evil.pkl.pt").write_bytes(pickle.dumps(bait))
    (folder / "evil.safetensors").write_bytes(pickle.dumps(bait))
    return [
        [
            "run",
            *DRIVE[3:],
            "--renderer",
            "onefixer",
            "--set",
            f"fixer.weights={name}",
            "--dry-run",
            "smoke/straight",
        ]
        for name in ("evil.pt", "evil.pkl.pt", "evil.safetensors")
    ]


def object_arrays(folder, bait):
    np.save(folder / "evil.npy", np.array([bait], dtype=object), allow_pickle=True)
    np.savez(folder / "evil.npz", a=np.array([bait], dtype=object))
    (folder / "evil.asl").write_bytes((folder / "evil.npy").read_bytes())
    return [
        ["score", "evil.asl", "--scene", "smoke/straight", "--out", "scored"],
        ["view", "evil.npz"],
    ]


def archive_that_leaves_its_folder(folder, bait):
    with zipfile.ZipFile(folder / "evil.usdz", "w") as archive:
        for name in (
            "../evil.py",
            "../../sitecustomize.py",
            "/tmp/evil-of-an-archive.py",
            "metadata.yaml",
        ):
            archive.writestr(name, bait.python)
    return [["run", "--dry-run", *DRIVE[1:], "evil.usdz"], ["view", "evil.usdz"]]


def names_in_a_scenario(folder, bait):
    (folder / "evil.py").write_text(bait.python + "class Evil: pass\n")
    (folder / "scene.yaml").write_text(
        "version: 1\nextends: smoke/straight\npolicy: evil.py:Evil\nrenderer: evil:Evil\n"
    )
    (folder / "weights.yaml").write_text("version: 1\nextends: evil.py\n")
    return [["run", "--dry-run", *DRIVE[1:], name] for name in ("scene.yaml", "weights.yaml")]


def notebook_and_startup(folder, bait):
    (folder / ".ipython" / "profile_default" / "startup").mkdir(parents=True)
    (folder / ".ipython" / "profile_default" / "startup" / "00.py").write_text(bait.python)
    (folder / "matplotlibrc").write_text(f"backend: module://evil\n# {bait.shell}\n")
    (folder / "evil.py").write_text(bait.python)
    (folder / "conftest.py").write_text(bait.python)
    (folder / "setup.cfg").write_text(
        "[options.entry_points]\nsimrun.policies =\n  evil = evil:Evil\n"
    )
    return [["report", "run"], ["view", "smoke/straight", "--out", "p.png"]]


def shells(folder, bait):
    """Give names that a shell would run."""
    names = (f"$({bait.shell})", f"; {bait.shell} #", f"`{bait.shell}`", f"| {bait.shell}")
    commands = [["run", "--dry-run", *DRIVE[1:], name.replace("/", "")] for name in names]
    return [
        *commands,
        ["compare", names[0]],
        [*DRIVE, "--dry-run", "--policy", f"exec:true {names[1]}", "smoke/straight"],
    ]


def programs(folder, bait):
    for name in ("git", "ffmpeg", "nvidia-smi", "sinfo", "sysctl", "ps", "python", "python3", "sh"):
        (folder / name).write_text(f"#!/bin/sh\n{bait.shell}\n")
        (folder / name).chmod(0o755)
    return [["doctor"], SHORT_DRIVE]


WAYS = {
    "module of a library that is missing": python_file(
        "colorama.py", "numexpr.py", "coverage.py", "pytz.py", "bottleneck.py"
    ),
    "module of the standard library": python_file(
        "pickle.py", "selectors.py", "multiprocessing.py", "json.py", "runpy.py"
    ),
    "package of ours": python_file(
        "alpasim_plugin/__init__.py",
        "evaluators/__init__.py",
        "policies/__init__.py",
        "scenarios/__init__.py",
    ),
    "sitecustomize": python_file("sitecustomize.py"),
    "usercustomize": python_file("usercustomize.py"),
    "__main__ and __init__": python_file(
        "__main__.py", "__init__.py", "run/__init__.py", "run/__main__.py"
    ),
    "compiled cache": python_file("__pycache__/colorama.cpython-311.pyc", "numba_cache.py"),
    "distribution metadata and entry points": metadata,
    "path file": path_file,
    "git hooks and configuration": git_hooks,
    "YAML tag": yaml_tags,
    "pickles in a run folder": pickles_of_a_run,
    "weights": weights,
    "object arrays": object_arrays,
    "archive that leaves its folder": archive_that_leaves_its_folder,
    "names in a scenario": names_in_a_scenario,
    "start-up files of notebooks, matplotlib and pytest": notebook_and_startup,
    "words that a shell would run": shells,
    "programs beside the command": programs,
}


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("finished")
    assert (
        run_command(
            [
                *DRIVE,
                "--policy",
                "constant-velocity",
                "--workers",
                "1",
                "--set",
                "timing.duration_us=1000000",
                "--out",
                str(folder / "run"),
                "smoke/straight",
            ]
        )
        == 0
    )
    return folder / "run"


ALL_AT_ONCE = [
    ["compare", "run"],
    ["run", "--dry-run", *DRIVE[1:], "smoke/straight"],
    ["run", "--dry-run", *DRIVE[1:], "scene.yaml"],
]


@pytest.mark.parametrize(
    "names",
    [
        pytest.param(tuple(WAYS), id="all ways at once"),
        *(pytest.param((name,), id=name, marks=pytest.mark.slow) for name in WAYS),
    ],
)
def test_nothing_of_a_strangers_folder_runs(names, finished, tmp_path):
    folder = tmp_path / "stranger"
    folder.mkdir()
    subprocess.run(["cp", "-r", str(finished), str(folder / "run")], check=True)
    assert (folder / "run" / ROLLOUTS_FOLDER).is_dir()
    bait = Bait(folder, "bait")
    own = [command for name in names for command in WAYS[name](folder, bait)]
    for command in own if len(names) == 1 else ALL_AT_ONCE:
        done = simrun(folder, *command)
        assert not bait.mark.exists(), f"{command} ran it"
        assert "Traceback" not in done.stderr, done.stderr
        assert done.returncode in (0, 1, 2, 3, 4, 5), (command, done.stderr)
        assert "\x1b" not in done.stderr, "control characters reach the terminal"
    assert {path.name for path in tmp_path.iterdir()} <= {"bin", "stranger"}, (
        "written outside of the folder"
    )


def test_the_baits_work_where_they_are_run(tmp_path):
    bait = Bait(tmp_path / "x", "bait")
    exec(bait.python)
    subprocess.run(bait.shell, shell=True, check=True)
    pickle.loads(pickle.dumps(bait))
    assert bait.mark.read_text().split() == ["bait"] * 3


@pytest.mark.parametrize(
    "text",
    [
        "<script>alert(1)</script>",
        "<img src=x onerror=alert(1)>",
        "\x1b]0;evil\x07",
        "\x1b[2J",
        "\u202eevil",
    ],
)
def test_text_of_a_stranger_stays_text(text):
    from alpasim_plugin.core.errors import InputError
    from alpasim_plugin.core.escape import markdown, terminal

    said = str(InputError(f"{text}: {text}", text))
    assert all(part.isprintable() for part in said.splitlines())
    assert terminal(text).isprintable()
    assert "<script" not in markdown(text)
