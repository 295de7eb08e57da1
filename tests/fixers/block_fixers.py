"""Small fixers with a real history, and broken ones, for tests of the loop."""

from dataclasses import replace

import numpy as np

from alpasim_plugin.core.interfaces import BlockRule


class Blend:
    """Mix every frame with its camera's whole block and with the last frame of the block before:
    both matter bit for bit.
    """

    trained = True
    label = "blend"
    blocks = BlockRule(5, 8)

    def __init__(self):
        self.reset(0)

    def reset(self, seed):
        self.past = {}
        self.taken = []  # blocks that entered the history
        self.previews = 0

    def preview(self, block, maps):
        self.previews += 1
        return self._mix(block)

    def step(self, block, maps):
        assert len(maps) in (0, len(block))
        fixed = self._mix(block)
        self.taken.append(list(block))
        for frame in fixed:
            self.past[frame.camera] = frame.rgb
        return fixed

    def _mix(self, block):
        out = []
        for frame in block:
            mean = np.mean([f.rgb for f in block if f.camera == frame.camera], axis=0)
            past = self.past.get(frame.camera, frame.rgb)
            out.append(
                replace(frame, rgb=(0.5 * frame.rgb + 0.25 * mean + 0.25 * past).astype(np.uint8))
            )
        return out


class Raises(Blend):
    def _mix(self, block):
        raise RuntimeError("out of memory")


class LosesAFrame(Blend):
    def _mix(self, block):
        return super()._mix(block)[:-1]


class ShiftsTime(Blend):
    def _mix(self, block):
        return [replace(frame, t_us=frame.t_us + 1) for frame in super()._mix(block)]


class GivesFloats(Blend):
    def _mix(self, block):
        return [
            replace(frame, rgb=np.full(frame.rgb.shape, np.nan, dtype=np.float32))
            for frame in block
        ]  # type: ignore[arg-type]


class GuardSteps(Blend):
    """As a fixer whose guard passes every third frame on raw."""

    def _mix(self, block):
        return [
            replace(block[i], events=("fixer-nan",)) if i % 3 == 0 else fixed
            for i, fixed in enumerate(super()._mix(block))
        ]


def fixed_offline(fixer, frames):
    """Fix the frames of one camera in whole blocks, as one would with a finished video."""
    out = []
    done = 0
    while len(out) < len(frames):
        block = frames[len(out) : len(out) + fixer.blocks.frames(done)]
        out += fixer.step(block, [])
        done += 1
    return out
