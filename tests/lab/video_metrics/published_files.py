"""Files in the layout of the published weights, with random tensors."""

from dataclasses import replace

import torch

from alpasim_plugin.core.files import file_sha256
from alpasim_plugin.lab.video_metrics.lpips import LPIPS, TRUNKS


def write(folder, kind):
    """Write random weights under the published names; their digests are wrong unless a test says
    otherwise.
    """
    plan = TRUNKS[kind]
    net = LPIPS(kind)
    layers = [(f"features.{c.index}", net.features[str(c.index)]) for c in plan.convolutions]
    trunk = {
        f"{name}.{part}": getattr(layer, part).detach()
        for name, layer in layers
        for part in ("weight", "bias")
    }
    heads = {
        f"lin{i}.model.1.weight": head.detach().view(1, -1, 1, 1)
        for i, head in enumerate(net.heads)
    }
    torch.save(trunk | {"classifier.1.weight": torch.zeros(2, 2)}, folder / plan.file)
    torch.save(heads, folder / plan.heads_file)


def write_trunk(folder, kind, monkeypatch):
    """Write random weights whose digests are those that the loader expects; return their plan."""
    write(folder, kind)
    plan = TRUNKS[kind]
    name = plan.file.rsplit("-", 1)[0]
    named = f"{name}-{file_sha256(folder / plan.file)[:8]}.pth"
    (folder / plan.file).rename(folder / named)
    heads_sha256 = file_sha256(folder / plan.heads_file)
    monkeypatch.setitem(TRUNKS, kind, replace(plan, file=named, heads_sha256=heads_sha256))
    return TRUNKS[kind]
