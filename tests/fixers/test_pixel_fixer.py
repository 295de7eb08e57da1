"""The per-frame session: streaming equals the training's rollout, cameras are independent, and no
fault stays in the history.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch

from alpasim_plugin.core.errors import InputError, RendererError
from alpasim_plugin.core.interfaces import BlockRule
from alpasim_plugin.core.parts.resolve import resolve
from alpasim_plugin.fixers import fixer_settings, guard, make_fixer
from alpasim_plugin.fixers.bundle import bundle_header, read_bundle, save_bundle
from alpasim_plugin.fixers.guard import render_share
from alpasim_plugin.fixers.network.pixel_generator import PixelGenerator
from alpasim_plugin.fixers.pixel_network import load_generator
from alpasim_plugin.fixers.pixel_settings import PixelFixerSettings
from tests.block_fixers.fixer_cases import small_settings
from tests.fixers.clip_cases import SIZE, maps_of, moving_picture, pixels
from tests.fixers.pixel_cases import (
    FRAMES,
    MAPS,
    SIZES,
    at,
    generator,
    run,
    session,
    write_bundle,
)


@pytest.fixture(scope="module")
def bundle(tmp_path_factory):
    return write_bundle(tmp_path_factory.mktemp("pixel") / "small.safetensors")


def test_one_frame_in_one_frame_out_and_the_label_says_the_precision(bundle):
    fixer = session(bundle)
    assert fixer.blocks == BlockRule(1, 1)
    assert fixer.trained
    assert fixer.label == "onefixer, 9 updates, fp32"
    (out,) = fixer.step(FRAMES[:1], MAPS[:1])
    assert (out.t_us, out.camera, out.rgb.dtype, out.rgb.shape) == (
        0,
        "front",
        np.uint8,
        (*SIZE, 3),
    )
    assert out.alpha is FRAMES[0].alpha


def test_cameras_are_alike_alone_together_and_at_different_rates(bundle):
    left = moving_picture(8, key="left", camera="left")
    right = moving_picture(8, key="right", camera="right")
    small = moving_picture(8, (16, 32), key="small", camera="small")
    alone = {
        name: pixels(run(session(bundle), clip))
        for name, clip in (("left", left), ("small", small))
    }
    slow = pixels(run(session(bundle), right[::2]))
    fixer = session(bundle)
    out = {"left": [], "right": [], "small": []}
    for i in range(8):
        frames = [small[i], left[i], *([right[i]] if i % 2 == 0 else [])]
        for frame in fixer.step(frames, ()):
            out[frame.camera].append(frame)
    for name, expected in (*alone.items(), ("right", slow)):
        assert np.abs(pixels(out[name]).astype(int) - expected).max() <= 1, name


def test_a_reset_session_starts_anew_and_noise_follows_the_seed(bundle):
    fixer = session(bundle)
    first = pixels(run(fixer, FRAMES))
    fixer.reset(0)
    assert np.array_equal(pixels(run(fixer, FRAMES)), first)
    other = pixels(run(session(bundle, seed=1), FRAMES))
    assert not np.array_equal(other, first)
    assert not np.array_equal(pixels(run(session(bundle, "holes=render"), FRAMES)), first)
    opaque = [replace(frame, alpha=None) for frame in FRAMES]
    assert np.array_equal(
        pixels(run(session(bundle), opaque)), pixels(run(session(bundle, seed=1), opaque))
    )


@pytest.mark.parametrize(("size", "scale"), [((17, 33), 1), ((30, 50), 1), ((70, 101), 3)])
def test_odd_sizes_are_padded_and_cropped(bundle, size, scale):
    fixer = session(bundle, f"scale={scale}")
    frames = moving_picture(3, size)
    out = run(fixer, frames, maps_of(frames))
    assert [frame.rgb.shape for frame in out] == [(*size, 3)] * 3
    assert not any(frame.events for frame in out)
    assert fixer._history["front"].state.output.shape[1] == 32
    assert all(frame.facts["guessed_share"] > 0 for frame in out)


def test_a_missing_map_is_a_black_one(bundle):
    black = [np.zeros((*SIZE, 3), dtype=np.uint8)] * len(FRAMES)
    without = pixels(run(session(bundle), FRAMES))
    assert np.array_equal(pixels(run(session(bundle), FRAMES, black)), without)
    assert np.array_equal(pixels(run(session(bundle, "uses_map=false"), FRAMES, MAPS)), without)
    assert not np.array_equal(pixels(run(session(bundle), FRAMES, MAPS)), without)


def test_a_refused_step_leaves_the_history(bundle):
    expected = run(session(bundle), FRAMES[:3])
    fixer = session(bundle)
    run(fixer, FRAMES[:2])
    holes = np.ones(SIZE, dtype=np.float32)
    holes[3, 4] = np.nan
    with pytest.raises(RendererError):
        fixer.step([replace(FRAMES[2], alpha=holes)], ())
    with pytest.raises(InputError):
        fixer.step(FRAMES[1:2], ())
    with pytest.raises(InputError):
        fixer.step([replace(moving_picture(3, (16, 32))[2], t_us=FRAMES[2].t_us)], ())
    with pytest.raises(InputError):
        fixer.step(FRAMES[2:4], ())
    assert np.array_equal(fixer.step(FRAMES[2:3], ())[0].rgb, expected[2].rgb)


def test_a_frame_that_is_not_finite_is_passed_raw_and_forgotten(bundle):
    fixer = session(bundle)
    run(fixer, FRAMES[:2])
    past = fixer._history["front"]
    broken = past.state._replace(hidden=torch.full_like(past.state.hidden, float("nan")))
    fixer._history["front"] = replace(past, state=broken)
    out = run(fixer, FRAMES[2:])
    assert out[0].events == (guard.NAN,)
    assert np.array_equal(out[0].rgb, FRAMES[2].rgb)
    assert not any(frame.events for frame in out[1:])


def test_bundles_of_the_two_kinds_are_told_apart(bundle, tmp_path):
    assert bundle_header(bundle)[1]["name"] == "onefixer"
    with pytest.raises(InputError):
        read_bundle(bundle, small_settings())
    with pytest.raises(InputError):
        save_bundle(tmp_path / "none.safetensors", {}, at(bundle), trained=False)
    with pytest.raises(InputError):
        at(bundle, "mode=chunk")
    with pytest.raises(InputError):
        fixer_settings("onefixer", ["weights.bundle=null", "weights.dit=a"])


def test_an_untrained_generator_returns_the_render(bundle):
    settings = fixer_settings(
        "onefixer", ["weights.bundle=null", "generator.widths=[8,8,8]", "untrained=identity"]
    )
    fixer = make_fixer("onefixer", settings, scene_id="scene")
    assert not fixer.trained
    assert np.array_equal(pixels([fixer.step(FRAMES[:1], ())[0]]), pixels(FRAMES[:1]))
    with pytest.raises(InputError):
        make_fixer(
            "onefixer",
            fixer_settings("onefixer", ["weights.bundle=null", "untrained=refuse"]),
            scene_id="scene",
        )


# --- the harmlessness guard


def share(out, opacity=1.0, sdmap=-1.0, before=None):
    road = torch.full((1, 64, 64, 3), -0.2)
    before = road if before is None else before
    cover = torch.full((1, 64, 64, 1), opacity)
    found = render_share(out, road, cover, torch.full_like(road, sdmap), before)
    return torch.zeros_like(cover) if found is None else found


def invented(level=0.9):
    """Return a road with a bright thing on it."""
    out = torch.full((1, 64, 64, 3), -0.2)
    out[:, 24:40, 24:40] = level
    return out


def test_an_invention_on_an_opaque_road_is_taken_back():
    kept = share(invented())
    assert float(kept[0, 32, 32]) > 0.9
    assert float(kept[0, :8].max()) == 0


def test_a_change_with_support_stays():
    assert not share(invented(), opacity=0.4).any()  # the render is a hole
    assert not share(invented(), sdmap=0.5).any()  # the map shows something there
    assert not share(invented(), before=invented().roll(8, 2)).any()  # it was there before, nearby
    assert not share(invented(level=0.1)).any()  # it is a repair, not an invention


@pytest.fixture(scope="module")
def reading(tmp_path_factory):
    """Write weights that read references and give them most of the picture."""
    torch.manual_seed(5)
    net = PixelGenerator(replace(SIZES, blend=8))
    with torch.no_grad():
        net.blend.write.bias[:4] = 4.0
    path = tmp_path_factory.mktemp("reading") / "small.safetensors"
    settings = fixer_settings(
        "onefixer", ["weights.bundle=null", "holes=render", "generator.blend=8", "references=2"]
    )
    assert isinstance(settings, PixelFixerSettings)
    save_bundle(path, {"generator": net.state_dict()}, settings, trained=True)
    return path


def with_reference(frame, grey, holds=255):
    image = np.full((*SIZE, 4), grey, dtype=np.uint8)
    image[..., 3] = holds
    return replace(frame, references=(image,))


def test_a_reference_becomes_the_picture_and_the_facts_say_so(reading):
    fixer = session(reading, "holes=render", "keep_render=false")
    (out,) = fixer.step([with_reference(FRAMES[0], 200)], MAPS[:1])
    assert np.abs(out.rgb.astype(int) - 200).mean() < 12
    assert out.references == ()
    assert out.facts["recorded_share"] > 0.9
    (none,) = session(reading, "holes=render").step([with_reference(FRAMES[0], 200, 0)], MAPS[:1])
    assert none.facts["recorded_share"] < 1e-3
    assert 0 <= none.facts["guessed_share"] <= 1


def test_cameras_with_and_without_references_are_one_batch_and_each_as_alone(reading):
    front = with_reference(FRAMES[0], 90)
    side = replace(FRAMES[1], camera="side", t_us=FRAMES[0].t_us)
    both = session(reading, "holes=render").step([front, side], MAPS[:2])
    for i, frame in enumerate((front, side)):
        (alone,) = session(reading, "holes=render").step([frame], MAPS[i : i + 1])
        assert np.abs(both[i].rgb.astype(int) - alone.rgb).max() <= 1


def test_the_guard_never_keeps_the_render_where_a_reference_is_shown(reading):
    grey = replace(
        FRAMES[0],
        rgb=np.full((*SIZE, 3), 20, dtype=np.uint8),
        alpha=np.ones(SIZE, dtype=np.float32),
    )
    (out,) = session(reading, "holes=render").step([with_reference(grey, 240)], [])
    assert out.rgb.mean() > 200


def test_more_steps_sample_from_noisier_sources(bundle):
    two = make_fixer("onefixer@2", at(bundle, "steps=[1000,500]"), scene_id="scene")
    assert two.label == "onefixer@2, 9 updates, steps [1000.0, 500.0] instead of [1000.0], fp32"
    assert not np.array_equal(
        pixels(list(two.step(FRAMES[:1], ()))), pixels(run(session(bundle), FRAMES[:1]))
    )


def test_a_reference_of_another_size_is_refused(reading):
    wrong = replace(FRAMES[0], references=(np.zeros((4, 4, 4), dtype=np.uint8),))
    with pytest.raises(InputError):
        session(reading).step([wrong], MAPS[:1])


def test_weights_that_read_no_references_leave_them_alone(bundle):
    plain, given = (
        session(bundle).step([frame], MAPS[:1])[0]
        for frame in (FRAMES[0], with_reference(FRAMES[0], 200))
    )
    assert np.array_equal(plain.rgb, given.rgb)


def test_weights_that_were_replaced_under_their_name_are_read_again(tmp_path):
    file = write_bundle(tmp_path / "small.safetensors")
    first = load_generator(at(file))
    assert load_generator(at(file)) is first
    settings = fixer_settings("onefixer", ["weights.bundle=null", "holes=noise"])
    other = {"generator": PixelGenerator(SIZES).state_dict()}
    save_bundle(file, other, settings, trained=True, note="10 updates")
    assert load_generator(at(file)).note == "10 updates"


@pytest.mark.parametrize(
    ("updates", "words"),
    [(4, "hardly trained: 4 updates"), (1, "hardly trained: 1 update"), (50, "trained")],
)
def test_a_fixer_of_few_updates_is_marked_where_it_is_named(tmp_path, updates, words):
    path = tmp_path / "few.safetensors"
    settings = fixer_settings("onefixer", ["weights.bundle=null", "holes=noise"])
    save_bundle(
        path,
        {"generator": generator().state_dict()},
        settings,
        trained=True,
        note="first try",
        updates=updates,
    )
    spec = resolve("fixer", "onefixer", (f"weights.bundle={path}", "holes=noise"))
    assert spec.note == words
    assert spec.label == f"onefixer, {words}"
    assert (words in session(path).label) == (updates < 50)
