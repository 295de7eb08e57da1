"""Finished runs of the closed loop as measurements of the paper's arms."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from alpasim_plugin.core.checksums import sha256_of
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.lab.bench.drives import read_drives
from tests.report.make_run import Plan, make_run

BASES = {
    "difix": "3dgs",
    "omnidreams": "3dgs",
    "omnidreams@4": "3dgs",
    "onefixer-dit-tiny": "3dgs",
    "onefixer": "3dgs",
}


@pytest.fixture
def arms(tmp_path: Path) -> Path:
    """Return a folder of arms; what is in their bundles is not read."""
    for name in ("difix", "omnidreams", "V9"):
        path = tmp_path / "arms" / name / "fixer.safetensors"
        path.parent.mkdir(parents=True)
        path.write_bytes(name.encode())
    return tmp_path / "arms"


def driven(
    folder: Path, arms: Path, renderers: tuple[str, ...], weights: dict[str, str], **more: Any
) -> Path:
    """Write a run whose renderers have the weights of these arms, or others."""
    run = make_run(
        folder,
        Plan(
            renderers=renderers,
            scenes=("a", "b", "c"),
            seeds=(0, 1),
            steps=40,
            pictures=False,
            clips=False,
            **more,
        ),
    )
    info = json.loads((run / "run.json").read_text())
    fixers = {}
    for name in (name for name in renderers if name in BASES):
        arm = arms / weights.get(name, "-") / "fixer.safetensors"
        digest = sha256_of(arm) if arm.is_file() else "0" * 64
        fixers[name] = {
            "name": name,
            "label": f"{name}, trained",
            "trained": True,
            "files": {"w": digest},
            "settings": {"steps": [1.0] * 4},
        }
    info |= {"fixers": fixers, "bases": {name: BASES[name] for name in fixers}}
    (run / "run.json").write_text(json.dumps(info))
    return run


def test_a_renderer_is_the_arm_whose_weights_it_has(tmp_path: Path, arms: Path) -> None:
    renderers = ("clean", "3dgs", "difix", "omnidreams@4", "onefixer-dit-tiny", "onefixer")
    weights = {"difix": "difix", "omnidreams@4": "omnidreams", "onefixer-dit-tiny": "V9"}
    found = read_drives([driven(tmp_path / "run", arms, renderers, weights)], arms)
    assert list(found) == ["closed-loop, lane-camera"]
    assert found["closed-loop, lane-camera"].arms == (
        "clean",
        "3dgs",
        "difix",
        "omnidreams@4",
        "V9",
        "onefixer",
    )
    assert len(found["closed-loop, lane-camera"].rows) == 6 * 3 * 2


def test_an_arm_with_several_numbers_of_steps_is_the_row_of_its_own_number(
    tmp_path: Path, arms: Path
) -> None:
    run = driven(
        tmp_path / "run", arms, ("3dgs", "omnidreams"), {"omnidreams": "omnidreams"}
    )  # without @N: the steps are the bundle's
    assert read_drives([run], arms)["closed-loop, lane-camera"].arms == ("3dgs", "omnidreams@4")


def test_policies_may_share_a_folder_or_have_their_own(tmp_path: Path, arms: Path) -> None:
    both = driven(
        tmp_path / "both", arms, ("clean", "3dgs"), {}, policies=("learned", "lane-camera")
    )
    assert list(read_drives([both], arms)) == ["closed-loop, learned", "closed-loop, lane-camera"]
    alone = driven(tmp_path / "alone", arms, ("clean", "3dgs"), {}, policies=("learned",))
    with pytest.raises(InputError) as caught:
        read_drives([both, alone], arms)
    assert "policy learned" in caught.value.message


def test_another_arm_by_the_same_name_is_refused(tmp_path: Path, arms: Path) -> None:
    run = driven(tmp_path / "run", arms, ("3dgs", "difix"), {})
    with pytest.raises(InputError) as caught:
        read_drives([run], arms)
    assert "difix drove with weights that are not those" in caught.value.message


def test_two_renderers_with_one_arms_weights_are_refused(tmp_path: Path, arms: Path) -> None:
    run = driven(
        tmp_path / "run",
        arms,
        ("3dgs", "onefixer-dit-tiny", "onefixer"),
        {"onefixer-dit-tiny": "V9", "onefixer": "V9"},
    )
    with pytest.raises(InputError) as caught:
        read_drives([run], arms)
    assert "onefixer-dit-tiny, onefixer" in caught.value.message


def test_a_run_without_the_raw_render_is_refused(tmp_path: Path, arms: Path) -> None:
    with pytest.raises(InputError) as caught:
        read_drives([driven(tmp_path / "run", arms, ("clean", "onefixer"), {})], arms)
    assert "drive 3dgs too" in caught.value.hint


def test_a_folder_without_a_finished_run_is_refused(tmp_path: Path, arms: Path) -> None:
    with pytest.raises(InputError, match="run"):
        read_drives([tmp_path], arms)
