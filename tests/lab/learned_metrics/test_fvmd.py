"""FVMD's windows, histograms and distance, with Lucas-Kanade tracks."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from alpasim_plugin.lab.learned_metrics.fvmd import (
    ANGLES,
    fvmd_lk,
    histograms,
    lk_tracks,
    motion_features,
)

CUBES = (4, 4, 4, ANGLES)  # time, rows, columns, angle


def moving(velocity: tuple[float, float]) -> np.ndarray:
    return np.arange(16)[:, None, None] * np.array(velocity) + np.zeros((1, 400, 2))


def reference_histograms(tracks: np.ndarray) -> np.ndarray:
    """The definition, point by point."""
    velocity = np.zeros_like(tracks)
    velocity[1:] = tracks[1:] - tracks[:-1]
    acceleration = np.zeros_like(tracks)
    acceleration[2:] = velocity[2:] - velocity[1:-1]
    out = []
    for field in (velocity, acceleration):
        counts = np.zeros(CUBES)
        for t in range(16):
            for p in range(400):
                x, y = field[t, p]
                weight = np.ceil(min(np.log2(min(np.hypot(x, y), 255.0) + 1), 8.0)) / 8
                angle = min(int((np.arctan2(x, y) + np.pi) // (np.pi / 4)), 7)
                counts[t // 4, p // 20 // 5, p % 20 // 5, angle] += weight
        out.append(counts.ravel())
    return np.concatenate(out)


def test_constant_motion_to_the_right_fills_one_bin() -> None:
    velocity = histograms(moving((3.0, 0.0)))[:512].reshape(CUBES)
    assert np.flatnonzero(velocity.sum(axis=(0, 1, 2))).tolist() == [6]
    assert velocity[0, ..., 6] == pytest.approx(18.75)  # the first velocity is zero
    assert velocity[1:, ..., 6] == pytest.approx(25.0)
    assert not histograms(moving((3.0, 0.0)))[512:].any()


def test_reversed_time_turns_the_angle_by_half_a_circle() -> None:
    forward = histograms(moving((2.0, 1.0)))[:512].reshape(CUBES).sum(axis=(0, 1, 2))
    back = histograms(moving((2.0, 1.0))[::-1])[:512].reshape(CUBES).sum(axis=(0, 1, 2))
    assert np.roll(forward, 4) == pytest.approx(back)


def test_against_the_definition_on_random_tracks() -> None:
    tracks = np.random.default_rng(0).normal(0, 3, (16, 400, 2)).cumsum(axis=0)
    tracks[3:6, :50] = tracks[2, :50]  # standing points
    tracks[8, 7] += 900.0  # beyond the cap of the length
    assert histograms(tracks) == pytest.approx(reference_histograms(tracks))


def texture(shift: int) -> np.ndarray:
    noise = np.random.default_rng(1).integers(0, 255, (160, 320)).astype(np.uint8)
    image = cv2.GaussianBlur(noise, (0, 0), 2.0)
    return np.repeat(np.roll(image, shift, axis=1)[8:152, 32:288, None], 3, axis=2)


def test_tracks_follow_a_moving_image_in_pixels_of_256() -> None:
    tracks = lk_tracks(np.stack([texture(2 * t) for t in range(16)]))
    step = np.diff(tracks, axis=0)
    assert np.median(step[..., 0]) == pytest.approx(2.0, abs=0.1)
    assert np.median(np.abs(step[..., 1])) < 0.1
    assert tracks[0, [0, 19, 399]].tolist() == [[8.0, 8.0], [248.0, 8.0], [248.0, 248.0]]


def test_windows_and_distance_of_a_set() -> None:
    clip = np.stack([texture(t // 2) for t in range(41)])
    features = motion_features(clip)
    assert features.shape == (2, 1024)  # starts at 0 and 25
    assert motion_features(clip[:15]).shape == (0, 1024)
    # With its ridge inside the root only, FVMD's code gives -2 r d instead of 0 for one set twice;
    # the distance stops at 0.
    few = features[:, :40]
    assert fvmd_lk([few], [few]) == pytest.approx(0.0, abs=1e-6)
