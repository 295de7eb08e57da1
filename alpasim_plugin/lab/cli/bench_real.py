"""``simrun bench real``: renderers and fixers measured by the photographs of imported drives."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from rich.console import Console

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.interfaces import Renderer
from alpasim_plugin.core.parts import (
    PartSpec,
    RendererSpec,
    resolve,
    resolve_renderer,
    split_names,
)
from alpasim_plugin.core.printing import say_document
from alpasim_plugin.core.types import U8, CameraSpec, Scenario
from alpasim_plugin.lab.bench.colour_video_vdp import load_metric
from alpasim_plugin.lab.bench.drawn_series import drawn_series, offset_requests
from alpasim_plugin.lab.bench.open_loop import TrueImage, roles_of, sensors_of
from alpasim_plugin.lab.bench.plan_gap import (
    RANGE_STEP_M,
    gap_intervals,
    gap_ranges,
    gap_rows,
)
from alpasim_plugin.lab.bench.real import (
    Judges,
    Row,
    image_rows,
    intervals,
    rendered_images,
    rendered_shots,
    series_of,
    shots_of,
    unseen_cameras,
)
from alpasim_plugin.lab.cli.bench_rows import print_rows
from alpasim_plugin.lab.cli.range_file import check_target, write_ranges
from alpasim_plugin.lab.video_metrics.image_distance import load_distance
from alpasim_plugin.lab.video_metrics.perceptual_net import NAME
from alpasim_plugin.runs.renderer import make_renderer
from scenarios.load import load_scenario

EPILOG = """
Examples:

- `simrun bench real runs/street --renderer 3dgs,onefixer`

- `simrun bench real runs/street runs/avenue --renderer 3dgs,onefixer --json`: with intervals over the drives

- `simrun bench real runs/street --policy learned`: and how far its plans move

- `simrun bench real hard/sharp_s_curve --policy learned --offsets 0,0.5,1`: in a built scene, beside its path

- `simrun bench real hard/sharp_s_curve --policy learned --range -o street.yaml`: how far beside it plans stay near, and a scene on which runs count the steps beyond
"""
EVERY = 10  # frames between lines of progress
MOST_OFFSET_M = 10.0
RANGE_OFFSETS = 13  # up to 3 m
TRUTH = "clean"  # of a built scene
KEY_OF_TRUTH = "the truth"  # no name of a renderer


Drives = Annotated[
    list[Path],
    typer.Argument(
        help="Folders of imported drives, or built scenes: scenario files, names and logs."
    ),
]
Renderers = Annotated[str, typer.Option("--renderer", help="Comma-separated renderers and fixers.")]
Policies = Annotated[
    str,
    typer.Option(
        "--policy",
        help="Comma-separated policies: how far their plans move when they see the renderer in place of the photograph.",
    ),
]
OffsetsText = Annotated[
    str,
    typer.Option(
        "--offsets",
        metavar="M,M...",
        help="Metres to the left of the path, for built scenes, whose truth is clean; by default 0.",
    ),
]
FindRange = Annotated[
    bool,
    typer.Option(
        "--range",
        help="Of built scenes: offsets of 0.25 m to both sides, up to where the plans' gap passes 0.3 m after two seconds.",
    ),
]
Out = Annotated[
    Path | None,
    typer.Option(
        "-o",
        "--out",
        metavar="FILE.yaml",
        help="With --range: write the scene with its range; a run on it counts the steps beyond.",
    ),
]
Seed = Annotated[
    int, typer.Option("--seed", min=0, help="Seed of the noise of fixers and policies.")
]
Device = Annotated[
    Literal["cpu", "cuda"], typer.Option("--device", help="Where to render and to fix.")
]
Threads = Annotated[
    int | None,
    typer.Option("--threads", min=1, help="Threads of the rasteriser; by default all cores."),
]
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON document on stdout.")]
Debug = Annotated[bool, typer.Option("--debug", help="Show tracebacks.")]


def real(
    drives: Drives,
    renderers: Renderers = "3dgs,onefixer",
    policies: Policies = "",
    offsets: OffsetsText = "",
    find_range: FindRange = False,
    out: Out = None,
    seed: Seed = 0,
    device: Device = "cpu",
    threads: Threads = None,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Compare renderers with photographs that no fit saw: on the recorded path, and beside it with
    a second camera.

    PSNR, SSIM, perceptual-syn, ColorVideoVDP (where cvvdp is installed), Warp L1, and precision and
    recall of lane markings; with --policy the distance between plans made of photographs and of
    renders.
    """
    del debug
    console = Console(stderr=True)
    bench = _Bench(
        {name: resolve_renderer(name) for name in _names("--renderer", renderers)},
        [resolve("policy", name) for name in _names("--policy", policies)] if policies else [],
        seed,
        device,
        threads,
        console,
    )
    scenarios = _loaded(drives)
    built = {name: drive for name, drive in scenarios.items() if drive.model is None}
    offsets_m = _offsets(offsets, find_range)
    if out is not None:
        check_target(out, drives, find_range)
    offset_option = "--range" if find_range else f"--offsets {offsets}" if offsets else ""
    _refuse_mixtures(scenarios, built, bench.policies, offset_option)
    recorded = {name: drive for name, drive in scenarios.items() if name not in built}
    # What cannot be measured is refused before anything is rendered.
    for scenario in recorded.values():
        unseen_cameras(scenario)
    bench.check_policies(recorded, built)
    images, gaps = bench.measure_recorded(recorded)
    for name, scenario in built.items():
        gaps += bench.measure_built(name, scenario, offsets_m)
    ranges = gap_ranges(gaps) if find_range else []
    if out is not None:
        (scenario,) = built.values()
        write_ranges(out, drives[0], scenario, ranges, gaps, bench.renderers, bench.policies)
        console.print(f"wrote {out}", highlight=False)
    _say(images, gaps, ranges, len(scenarios), as_json, console)


@dataclass(frozen=True)
class _Bench:
    """What is measured, and how."""

    renderers: Mapping[str, RendererSpec]
    policies: Sequence[PartSpec]
    seed: int
    device: str
    threads: int | None
    console: Console

    def check_policies(
        self, recorded: Mapping[str, Scenario], built: Mapping[str, Scenario]
    ) -> None:
        """Build every policy for every drive.

        Raises:
            InputError: A policy cannot be asked there.
            PolicyError: A policy raised.
        """
        for policy in self.policies:
            for scenario in recorded.values():
                roles_of(policy, scenario, series_of(shots_of(scenario)))
            for scenario in built.values():
                _cameras_of(policy, scenario)

    def measure_recorded(
        self, recorded: Mapping[str, Scenario]
    ) -> tuple[list[Row], list[dict[str, Any]]]:
        """Return the rows of images and of plans of drives with photographs."""
        images: list[Row] = []
        gaps: list[dict[str, Any]] = []
        if not recorded:
            return images, gaps  # no network is loaded
        judges = _judges(self.console)
        for name, scenario in recorded.items():
            image_part, gap_part = self._measured(name, scenario, judges)
            images += image_part
            gaps += gap_part
        return images, gaps

    def _measured(
        self, name: str, scenario: Scenario, judges: Judges
    ) -> tuple[list[Row], list[dict[str, Any]]]:
        shots = shots_of(scenario)
        rendered = rendered_shots(
            scenario, self._makers(scenario), shots, partial(_tell, self.console, name)
        )
        return image_rows(name, shots, rendered, judges), self._gaps(
            name, scenario, series_of(shots), rendered
        )

    def measure_built(
        self, name: str, scenario: Scenario, offsets: Offsets
    ) -> list[dict[str, Any]]:
        """Return the rows of plans of a built scene at offsets from its path; of a range, until the
        plans behind no renderer are near those behind the truth.
        """
        rows: list[dict[str, Any]] = []
        for offset_m in offsets.metres:
            rows_here = self._with_offset(name, scenario, offset_m)
            if offsets.is_range and offset_m:
                rows_here += self._with_offset(name, scenario, -offset_m)
            rows += rows_here
            if offsets.is_range and not any(
                row["passes_at_m"] is None for row in gap_ranges(rows_here)
            ):
                break
        return rows

    def _with_offset(self, name: str, scenario: Scenario, offset_m: float) -> list[dict[str, Any]]:
        rows = self._at_offset(name, scenario, offset_m)
        return [{**row, "offset_m": offset_m} for row in rows]

    def _at_offset(self, name: str, scenario: Scenario, offset_m: float) -> list[dict[str, Any]]:
        cameras = {policy.name: _cameras_of(policy, scenario) for policy in self.policies}
        requests = {
            camera.name: offset_requests(scenario, camera, offset_m)
            for camera in itertools.chain.from_iterable(cameras.values())
        }
        makers = {
            **self._makers(scenario),
            KEY_OF_TRUTH: self._maker(resolve_renderer(TRUTH), scenario),
        }
        subject = f"{name}, {offset_m:g} m"
        rendered = rendered_images(makers, requests, partial(_tell, self.console, subject))
        series = drawn_series(requests, rendered.pop(KEY_OF_TRUTH), offset_m)
        rows = []
        for policy in self.policies:
            policy_series = {camera.name: series[camera.name] for camera in cameras[policy.name]}
            rows += self._gaps_of(policy, name, scenario, policy_series, rendered)
        return rows

    def _gaps(
        self,
        name: str,
        scenario: Scenario,
        series: Mapping[str, Sequence[TrueImage]],
        rendered: Mapping[str, Mapping[str, Sequence[U8]]],
    ) -> list[dict[str, Any]]:
        rows = []
        for policy in self.policies:
            rows += self._gaps_of(policy, name, scenario, series, rendered)
        return rows

    def _gaps_of(
        self,
        policy: PartSpec,
        name: str,
        scenario: Scenario,
        series: Mapping[str, Sequence[TrueImage]],
        rendered: Mapping[str, Mapping[str, Sequence[U8]]],
    ) -> list[dict[str, Any]]:
        rows, notes = gap_rows(name, scenario, policy, series, rendered, self.seed)
        for note in notes:
            self.console.print(f"{name}: {note}", highlight=False)
        return rows

    def _makers(self, scenario: Scenario) -> dict[str, Callable[[], Renderer]]:
        return {name: self._maker(spec, scenario) for name, spec in self.renderers.items()}

    def _maker(self, spec: RendererSpec, scenario: Scenario) -> Callable[[], Renderer]:
        return lambda: make_renderer(spec, scenario, self.seed, self.device, self.threads)


def _say(
    images: Sequence[Row],
    gaps: Sequence[dict[str, Any]],
    ranges: Sequence[dict[str, Any]],
    drives: int,
    as_json: bool,
    console: Console,
) -> None:
    """Print rows and their intervals."""
    if drives == 1:
        console.print(
            "one drive: no interval over drives; how these numbers vary from drive to drive is not known",
            highlight=False,
        )
    parts = {
        "rows": images,
        "intervals": intervals(images),
        "plan_gap": gaps,
        "plan_gap_intervals": gap_intervals(gaps),
        "plan_gap_range": ranges,
    }
    if as_json:
        say_document({name: rows for name, rows in parts.items() if rows})
        return
    for rows in parts.values():
        if rows:
            print_rows([_with_ranges(row) for row in rows], False)


def _with_ranges(row: Mapping[str, Any]) -> dict[str, Any]:
    """Return a row for the terminal, with intervals as texts."""
    return {
        name: _range_text(value) if name.endswith("ci95") else value for name, value in row.items()
    }


def _judges(console: Console) -> Judges:
    vdp, why_not = load_metric()
    if why_not:
        console.print(why_not, highlight=False)
    return Judges(load_distance(NAME), vdp)


def _cameras_of(policy: PartSpec, scenario: Scenario) -> list[CameraSpec]:
    """Return the cameras of a policy.

    Raises:
        InputError: It has none, or the scenario lacks one.
    """
    names = [sensor.camera for sensor in sensors_of(policy, scenario)]
    cameras = {camera.name: camera for camera in scenario.cameras}
    lacking = [name for name in names if name not in cameras]
    if lacking or not names:
        raise InputError(
            f"--policy {policy.name}: "
            + (
                f"{scenario.scene_id} has no camera {', '.join(lacking)}"
                if lacking
                else "it has no camera, so that no image changes its plans"
            ),
            "name a policy whose cameras the scene has, for example learned",
        )
    return [cameras[name] for name in names]


def _refuse_mixtures(
    scenarios: Mapping[str, Scenario],
    built: Mapping[str, Scenario],
    policies: Sequence[PartSpec],
    offsets: str,
) -> None:
    """Refuse built scenes without a policy, and options for offsets of recorded drives.

    Raises:
        InputError: There are such.
    """
    if built and not policies:
        scenario = next(iter(built.values()))
        raise InputError(
            f"{scenario.scene_id}: no recorded drive: it has no photographs",
            "give a drive that was imported (simrun import drive FOLDER -o OUT), or name a policy with --policy: its plans behind clean are then the truth",
        )
    recorded = [name for name in scenarios if name not in built]
    if offsets and recorded:
        raise InputError(
            f"{offsets}: {recorded[0]} is a recorded drive: it has photographs where its cameras were, and no others",
            "leave it out, or give built scenes",
        )


@dataclass(frozen=True)
class Offsets:
    """Where built scenes are looked at.

    Attributes:
        metres: To the left of the path, in order.
        is_range: Whether it ends where plans are no longer near.
    """

    metres: Sequence[float]
    is_range: bool


def _offsets(text: str, find_range: bool) -> Offsets:
    """Return offsets from their text, or those that find a range.

    Raises:
        InputError: One is no number, twice there, or too large; or both are asked for.
    """
    if find_range:
        if text:
            raise InputError(
                f"--offsets {text}: --range chooses its own offsets", "leave one of the two out"
            )
        return Offsets([RANGE_STEP_M * number for number in range(RANGE_OFFSETS)], True)
    try:
        offsets_m = [float(part) for part in text.split(",")] if text else [0.0]
    except ValueError:
        offsets_m = []
    if (
        not offsets_m
        or len(set(offsets_m)) < len(offsets_m)
        or not all(abs(offset_m) <= MOST_OFFSET_M for offset_m in offsets_m)
    ):
        raise InputError(
            f"--offsets {text}: not numbers, each once and at most {MOST_OFFSET_M:g} m",
            "write for example 0,0.25,0.5",
        )
    return Offsets(offsets_m, False)


def _range_text(bounds: Sequence[float] | None) -> str | None:
    return None if bounds is None else "{:.3g} to {:.3g}".format(*bounds)


def _loaded(drives: Sequence[Path]) -> dict[str, Scenario]:
    out: dict[str, Scenario] = {}
    for drive in drives:
        imported = drive / "scenario.yaml"
        file = imported if imported.is_file() else drive
        # Ranges of plans that its file states change nothing of what is looked at.
        scenario = load_scenario(str(file), overrides=["plan_ranges=[]"])
        name = scenario.scene_id if scenario.model is None else file.parent.name
        if name in out:
            raise InputError(
                f"{drive}: two drives called {name!r}",
                "name each folder once, and give folders different names",
            )
        out[name] = scenario
    return out


def _names(option: str, text: str) -> list[str]:
    names = split_names(text)
    if not names or len(set(names)) < len(names):
        raise InputError(
            f"{option} {text}: no name, or one twice",
            "write for example --renderer 3dgs,onefixer or --policy learned,lane-camera",
        )
    return names


def _tell(console: Console, drive: str, subject: str, done: int, all: int) -> None:
    if done % EVERY == 0 or done == all:
        console.print(f"{drive}: {subject}: {done}/{all}", highlight=False)
