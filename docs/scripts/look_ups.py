"""Time references of `alpasim-4` as they are carried here and by the commit before, in pairs."""

import importlib.util
import statistics
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from alpasim_plugin.fixers import ground, warp
from alpasim_plugin.runs.cameras import recorded_requests
from alpasim_plugin.runs.cell import make_renderer
from scenarios.load import load_scenario

OVERRIDES = ("cameras={rig: alpasim-4}", "degradation.share=0.002")

source = subprocess.check_output(["git", "show", "HEAD~1:alpasim_plugin/fixers/warp.py"])
folder = TemporaryDirectory()
path = Path(folder.name, "warp_before.py")
path.write_bytes(source)
spec = importlib.util.spec_from_file_location("warp_before", path)
before = importlib.util.module_from_spec(spec)
sys.modules["warp_before"] = before
spec.loader.exec_module(before)
scenario = load_scenario("smoke/curve", overrides=OVERRIDES)
runner = make_renderer("onefixer", scenario, threads=1).runner
instant = recorded_requests(scenario, scenario.start_us + 2_300_000)
requests = [part for whole in instant for part in runner.cover.requests(whole)]
frames = runner.render_base(requests)


def carried(by):
    """Return the CPU time of all references of an instant, seconds, and the images."""
    ground.warp = by.warp
    began = time.process_time()
    out = runner.references.added(requests, frames)
    images = [image for frame in out for image in frame.references]
    return time.process_time() - began, images


carried(before), carried(warp)
pairs = []
for _ in range(7):
    (then_s, then), (now_s, now) = carried(before), carried(warp)
    pairs.append((then_s, now_s))
shown = [(a[a[..., 3] > 0], b[a[..., 3] > 0]) for a, b in zip(then, now, strict=True)]
apart = np.concatenate([np.abs(a.astype(int) - b).max(axis=1) for a, b in shown])
medians = [statistics.median(column) for column in zip(*pairs, strict=True)]
print("CPU seconds before, now:", medians)
print("ratio of pairs:", statistics.median(now_s / then_s for then_s, now_s in pairs))
print(f"grey levels: at most {apart.max()}, in {(apart > 0).mean():.1e} of the pixels")
