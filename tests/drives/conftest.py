"""A street of known shape, imported once; the fit is replaced by Gaussians at the points, which
takes no time.
"""

import json

import numpy as np
import pytest

from alpasim_plugin.drives import build
from alpasim_plugin.gaussians.fit.drive import FittedDrive
from alpasim_plugin.gaussians.fit.reconstruction import Reconstruction
from alpasim_plugin.gaussians.fit.trial import Trial
from alpasim_plugin.gaussians.scene.sky import HEIGHT, WIDTH, Sky
from tests.drives.street import write_kitti, write_transforms


def at_once(views, start, **rest):
    """Stand in for `fit_drive`."""
    model = Reconstruction(start, {}, Sky(np.zeros((HEIGHT, WIDTH, 3), dtype=np.float32)))
    return FittedDrive(model, {views[0].name: (1.1, 1.0, 0.9)})


def with_preview(views, start, *, preview, report, recipe, trial, **rest):
    """Stand in for `fit_drive`, and show the street when half of the updates are made."""
    trial(Trial(recipe, coarse_s=0.1, whole_s=0.4))
    report("fitting", recipe.steps // 2, recipe.steps, {})
    street = at_once(views, start)
    preview(street)
    return street


@pytest.fixture
def quick_fit(monkeypatch):
    """Leave the fit out."""
    monkeypatch.setattr(build, "fit_drive", at_once)


@pytest.fixture(scope="session")
def kitti_street(tmp_path_factory):
    """Return the street as a KITTI folder, not to be changed."""
    return write_kitti(tmp_path_factory.mktemp("kitti") / "street")


@pytest.fixture(scope="session")
def walk(tmp_path_factory):
    """Return the street as a ``transforms.json`` in metres, not to be changed."""
    return write_transforms(tmp_path_factory.mktemp("walk") / "walk", unit="m")


@pytest.fixture(scope="session")
def imported(tmp_path_factory):
    """Return an imported KITTI-like drive: 24 photographs with poses and one without, a right
    camera; beside it its preview, and in ``said.json`` what the import reported.
    """
    said = []
    folder = tmp_path_factory.mktemp("drive")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(build, "fit_drive", with_preview)
        source = write_kitti(folder / "street", spare_pictures=1)
        build.import_drive(source, folder / "out", report=lambda *told: said.append(told))
    (folder / "said.json").write_text(json.dumps(said))
    return folder / "out"
