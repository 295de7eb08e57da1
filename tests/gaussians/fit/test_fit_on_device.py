"""The fit on a pretended device: the gradients of the CPU, one wait an update, and checkpoints that
go on on the CPU.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch

from alpasim_plugin.gaussians.fit.loop import SplatFit
from alpasim_plugin.gaussians.fit.recipe import SplatRecipe
from alpasim_plugin.gaussians.fit.start import Start
from alpasim_plugin.gaussians.fit.views import halved

pytest.importorskip("triton", reason="Triton is not installed")

from tests.pretended_device import pretended_device

RECIPE = replace(
    SplatRecipe.street(), steps=20, save_every=2, densify_every=3, densify_from=0.0, sh_share=0.0
)


@pytest.fixture(scope="module")
def case(posed):
    """Give two small views, one with a mask and without the car, and a start of 30 Gaussians."""
    first, second = (halved(view) for view in posed.views[:2])
    second = replace(second, actors={}, mask=np.arange(24) < np.full((16, 1), 20))
    car = posed.start.actors["car"].take(np.arange(10))
    return [first, second], Start(posed.start.background.take(np.arange(0, 280, 14)), {"car": car})


def begun(case, device, folder=None):
    return SplatFit(*case, RECIPE, "s", 1, folder, device)


@pytest.mark.slow
def test_every_view_gives_the_processors_gradients(case, monkeypatch):
    host = begun(case, "cpu")
    with pretended_device(monkeypatch):
        card = begun(case, "cuda")
        for ours, theirs in zip(card.targets, host.targets, strict=True):
            found = card._differentiate(ours)
            wanted = host._differentiate(theirs)
            assert found["loss"] == pytest.approx(wanted["loss"], rel=1e-5)
            assert found["mse"] == pytest.approx(wanted["mse"], rel=1e-5)
            for name, p in host.model.params.items():
                gradients = card.model.params[name].grad.cpu(), p.grad
                atol = 1e-3 * float(p.grad.abs().max()) + 1e-9
                torch.testing.assert_close(*gradients, rtol=0, atol=atol)
                p.grad = card.model.params[name].grad = None
        for name in ("total", "count"):
            found = getattr(card.gradients, name).cpu()
            wanted = getattr(host.gradients, name)
            torch.testing.assert_close(found, wanted, rtol=1e-3, atol=1e-6)


def test_an_update_waits_once_and_goes_on_on_the_cpu(case, tmp_path, monkeypatch):
    with pretended_device(monkeypatch) as traffic:
        card = begun(case, "cuda", tmp_path)
        # An update whose lists lacked room; one as usual; one that densifies.
        for capacity, waits in ((10, 2), (1 << 16, 1), (1 << 16, 2)):
            card.compositor.capacity = capacity
            traffic.reset()
            card.update()
            assert sum(traffic.waits.values()) == waits
            assert traffic.bytes_up < 2_500
            assert traffic.bytes_down < 600
        card.save()
        wanted = {name: p.cpu() for name, p in card.model.params.items()}
        background, actors = card.model.clouds()
    host = begun(case, "cpu", tmp_path)
    assert host.step == 3
    assert all(torch.equal(p, wanted[name]) for name, p in host.model.params.items())
    assert len(background) + len(actors["car"]) == len(host.model) > 30
    assert host.update()["loss"] < 1
