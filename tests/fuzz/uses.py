"""What is done with what a reader accepted: it is driven, drawn, scored, reported or read to its
end.
"""

from __future__ import annotations

import contextlib
import io
import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from tests.core.checksum_files import vouch_for


@dataclass(frozen=True)
class Target:
    """A reader: how valid files are made, and what is done with a folder of damaged ones."""

    name: str
    make: Callable[[Path], None]  # writes valid files into an empty folder
    use: Callable[[Path], None]  # reads the folder; raises what the reader raises
    damage: Sequence[str] = ("*",)  # patterns of the files to damage
    together: Callable[[dict[str, bytes], random.Random], dict[str, bytes]] | None = (
        None  # damages files that belong together
    )


class Refused(Exception):
    """The input was refused as it should be."""


def drive(path: Path, *overrides: str) -> None:
    """Load a scenario and drive three steps of it."""
    from alpasim_plugin.core.interfaces import Renderer
    from alpasim_plugin.runs.rollout import run_rollout
    from policies import make_policy
    from scenarios.load import load_scenario

    class Blind(Renderer):
        def render(self, request: Any) -> Any:
            raise AssertionError("the policy has no camera")

    scenario = load_scenario(path, overrides=overrides)
    steps = min(scenario.end_us - scenario.start_us, 3 * scenario.rates.control_us)
    short = replace(scenario, end_us=scenario.start_us + steps, warmup_us=0)
    run_rollout(short, Blind(), make_policy("constant-velocity", short))


def command(*args: str) -> Callable[[Path], None]:
    """Run a command line in this process; codes 0 and 1 to 3 are verdicts, a printed error with
    code 2 is a refusal.
    """

    def use(folder: Path) -> None:
        from alpasim_plugin.cli.main import run_command

        out, err = io.StringIO(), io.StringIO()
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            code = run_command([arg.replace("@", str(folder)) for arg in args])
        if code == 2:
            lines = [
                line
                for line in err.getvalue().strip().splitlines()
                if line and not line.startswith("warning: ")
            ]
            assert [line.split(":")[0].strip() for line in lines] == [
                "error",
                "with",
                "found",
                "do",
            ], err.getvalue()[:400]
            raise Refused
        is_verdict = (
            args[0] == "gate" and code in (4, 5) and not err.getvalue()
        )  # of rollouts that the tables call failed
        assert code in (0, 1, 3) or is_verdict, f"exit code {code}: {err.getvalue()[:400]}"

    return use


def resealed(use: Callable[[Path], None]) -> Callable[[Path], None]:
    """Seal a damaged run folder anew, as whoever damaged it on purpose would, so that what reads it
    behind the seal is reached.
    """

    def sealed(folder: Path) -> None:
        with contextlib.suppress(Exception):  # damage that cannot even be sealed is read as it is
            vouch_for(folder / "run")
        use(folder)

    return sealed


def one_of(pattern: str, use: Callable[[Path], object]) -> Callable[[Path], None]:
    """Use the one file of a folder."""
    return lambda folder: use(next(folder.glob(pattern))) and None


def use_gaussians(path: Path) -> None:
    from alpasim_plugin.gaussians import PinholeCamera, rasterize
    from alpasim_plugin.gaussians.files import read_gaussians

    cloud, _ = read_gaussians(path)
    camera = PinholeCamera(16, 12, np.array([[12.0, 0, 8], [0, 12.0, 6], [0, 0, 1]]), np.eye(4))
    picture = rasterize(cloud, camera, background=(0.0, 0.0, 0.0), backend="reference")
    assert np.isfinite(picture.rgb).all()


def use_log(path: Path) -> None:
    from alpasim_plugin.log import read_asl, read_facts
    from alpasim_plugin.log.trace import trace_log
    from alpasim_plugin.runs.scoring import contacts_of
    from evaluators import PRESETS, reduce_rollout, score
    from scenarios.load import load_scenario

    log = read_asl(path)
    facts = path.with_name("frames.jsonl")
    trace_log(path, read_facts(facts) if facts.exists() else ())
    series = tuple(score(log, load_scenario("smoke/straight").scene, PRESETS["paper"]))
    reduce_rollout(series, PRESETS["paper"])
    contacts_of(log, PRESETS["paper"])


def use_bundle(path: Path) -> None:
    from alpasim_plugin.fixers.bundle import bundle_fixer
    from alpasim_plugin.fixers.network.checkpoints import load_weights

    bundle_fixer(path)
    load_weights(path)


def use_weights(path: Path) -> None:
    from alpasim_plugin.fixers.network.checkpoints import load_weights

    load_weights(path)


def use_video(path: Path) -> None:
    from alpasim_plugin.log.video import VideoReader

    with VideoReader(path) as video:
        assert all(frame.image.ndim == 3 for frame in video)


def use_picture(path: Path) -> None:
    from alpasim_plugin.log import decode_image

    assert decode_image(path.read_bytes()).ndim == 3


def use_views(folder: Path) -> None:
    from alpasim_plugin.gaussians.fit.photographs import read_views

    read_views(folder)
