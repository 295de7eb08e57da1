"""The recipe ``appearance``: targets with the depth of their scene, a start that is OneFixer's, and
prompts that alone decide the style.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from alpasim_plugin.block_fixers.networks import load_networks
from alpasim_plugin.block_fixers.settings import CLEAR, STYLES, OneFixerSettings
from alpasim_plugin.block_fixers.tiny_vae import TinyVAE
from alpasim_plugin.block_fixers.tiny_vae_nets import TinySizes
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.parts import build, resolve
from alpasim_plugin.fixers.bundle import bundle_fixer
from alpasim_plugin.fixers.network.checkpoints import load_weights
from alpasim_plugin.gaussians.scene.builder import street_lights
from alpasim_plugin.lab.training.appearance import lights_of_posts
from alpasim_plugin.lab.training.clip_batches import BatchForm
from alpasim_plugin.lab.training.fixer_run import FixerRun, stage_inputs, train_fixer
from alpasim_plugin.lab.training.latent_clips import ClipForm, LatentClips
from alpasim_plugin.lab.training.pair_store import PairDataset, PairSequence
from alpasim_plugin.lab.training.recipes.registry import recipe_of, with_attention
from alpasim_plugin.lab.training.seen_scene import restyle_video, scene_of, seen_frames
from alpasim_plugin.lab.training.trainer import Schedule
from alpasim_plugin.world.ground import height_at
from scenarios.load import load_scenario
from tests.block_fixers.fixer_cases import run_blocks, small_settings
from tests.fixers.clip_cases import maps_of, moving_picture, pixels
from tests.lab.training.corner import make_corner

pytestmark = pytest.mark.slow  # pictures of a study that no drive needs


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with one scene, seven frames of pairs and an autoencoder."""
    root = tmp_path_factory.mktemp("appearance")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SIMRUN_CACHE", str(root / "cache"))
        make_corner(root / "scenes", root, "train", 600_000)
    TinyVAE.random(TinySizes(16, 16, 16, 16, 16)).save(root / "vae.safetensors")
    return root


def run_of(data: Path, scenes: Path | None, recipe: str = "appearance") -> FixerRun:
    settings = small_settings("window=4", "history=finalise", "holes=noise")
    schedule = Schedule(1, peak_lr=1e-2, warmup=1, accumulate=1, save_every=1, ema=0.5)
    chosen = with_attention(recipe_of(recipe), window=4)
    form = ClipForm(latents=2, stride=1)
    return FixerRun(
        settings,
        chosen,
        data,
        data / "vae.safetensors",
        {},
        form,
        BatchForm(clips=3),
        schedule,
        scenes=scenes,
    )


def task_of(run: FixerRun, folder: Path) -> Any:
    def brightness(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        return (a.mean(dim=(1, 2, 3)) - b.mean(dim=(1, 2, 3))).abs()

    clips = LatentClips(
        PairDataset(run.data, "train").sequences, TinyVAE.load(run.vae), run.form, folder
    )
    stage = run.recipe.stages[0]
    return stage.objective.task(stage_inputs(run, stage, clips, {}, ("brightness", brightness)))


def test_fog_hides_by_the_depth_of_the_scene(data: Path) -> None:
    """Of two rows of level ground the share of fog follows from their distances, 1.5 m below the
    camera's height over the sine.
    """
    sequence = PairSequence(data / "train" / "corner")
    seen = seen_frames(sequence, scene_of(sequence, data / "scenes"), 0, 1)
    clean = np.array(sequence.clip.rgb_gt[:1])
    foggy = restyle_video(clean, seen, "fog", "corner")[0].astype(float)
    light = restyle_video(
        np.zeros_like(clean),
        [replace(seen[0], depth_m=np.zeros_like(seen[0].depth_m))],
        "fog",
        "corner",
    )[0, 0, 0]
    through = [
        np.median((light - foggy[v]) / (light - clean[0, v].astype(float))) for v in (20, 30)
    ]
    T = seen[0].T_world_camera
    rays = [
        (v + 0.5 - seen[0].K[1, 2]) / seen[0].K[1, 1] for v in (20, 30)
    ]  # straight ahead, depth 1
    depth = [-T[2, 3] / (T[2, 1] * ray + T[2, 2]) for ray in rays]
    assert depth[0] > 1.8 * depth[1]
    density = [-np.log(t) / d for t, d in zip(through, depth, strict=True)]
    assert density[0] == pytest.approx(density[1], rel=0.1)
    assert 0.03 <= np.mean(density) <= 0.06


def test_street_lights_hang_over_the_road_and_those_behind_are_not_seen(data: Path) -> None:
    scenario = load_scenario(data / "scenes" / "train" / "corner.yaml")
    lights = street_lights(scenario, partial(height_at, scenario.ground))
    assert len(lights) >= 6
    assert np.ptp(lights[:, 2]) < 0.1
    assert lights[:, 2] == pytest.approx(7.15, abs=0.1)
    T = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1.5], [0, 0, 0, 1]])
    T[0, 3] = lights[:, 0].mean()
    ahead = lights_of_posts(lights, T)
    assert 0 < len(ahead) < len(lights)
    assert (ahead[:, 2] > 0).all()
    assert ahead[:, 1] == pytest.approx(1.5 - 7.15, abs=0.1)


def test_a_sequence_of_another_scene_is_refused(data: Path, tmp_path: Path) -> None:
    sequence = PairSequence(data / "train" / "corner")
    with pytest.raises(InputError, match="name the folder of its scenes with --scenes"):
        scene_of(sequence, tmp_path)
    path = tmp_path / "train" / "corner.yaml"
    path.parent.mkdir()
    same = (data / "scenes" / "train" / "corner.yaml").read_text()
    path.write_text(same.replace("texture: 0", "texture: 0, sky: dusk"))
    with pytest.raises(InputError, match="differs by"):
        seen_frames(sequence, scene_of(sequence, tmp_path), 0, 2)


def test_targets_are_encoded_once_and_repeat(data: Path, tmp_path: Path) -> None:
    task = task_of(run_of(data, data / "scenes"), tmp_path)
    first = [task.batch(i) for i in range(4)]
    files = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("appearance-*/*.npy")}
    assert 2 <= len(files) <= 3, "starts 0, 1 and 2 of seven frames"
    again = [task_of(run_of(data, data / "scenes"), tmp_path).batch(i) for i in range(4)]
    assert {path: path.stat().st_mtime_ns for path in files} == files
    assert all(
        torch.equal(a.sample.z_0, b.sample.z_0) and a.styles == b.styles
        for a, b in zip(first, again, strict=True)
    )
    assert {style for batch in first for style in batch.styles} == set(STYLES)
    clip = task.batches.clips[1]
    assert clip.mirrored
    night = task.targets.target(clip, "night")
    assert night.shape == clip.z_0.shape
    assert torch.equal(task.targets.target(clip, CLEAR), clip.z_0)
    frames = task.vae.decode(torch.stack([night, clip.z_0]))
    assert frames[0].mean() < frames[1].mean() - 0.3


def test_the_clear_prompt_starts_as_onefixer_and_every_style_learns_its_own(
    data: Path, tmp_path: Path
) -> None:
    task, plain = (
        task_of(run_of(data, data / "scenes"), tmp_path),
        task_of(run_of(data, None, "V9"), tmp_path),
    )
    for key, value in plain.net.state_dict().items():
        assert torch.equal(task.net.state_dict()[key], value), key
    assert torch.equal(task.prompts((CLEAR,)), plain.text)
    batch, wanted = task.batch(0), plain.batch(0)
    assert torch.equal(batch.sample.z_r, wanted.sample.z_r)
    clear = batch._replace(sample=wanted.sample, styles=(CLEAR,) * 3)
    assert task.loss(clear, 0)[0].item() == plain.loss(wanted, 0)[0].item()
    torch.nn.init.normal_(
        task.net.final_layer.linear.weight, generator=torch.Generator().manual_seed(0)
    )
    task.loss(batch._replace(styles=("night", "fog", "fog")), 0)[0].backward()
    gradients = {style: task.prompts.get_parameter(style).grad for style in STYLES}
    assert {
        style for style, grad in gradients.items() if grad is not None and bool((grad != 0).any())
    } == {"night", "fog"}


def test_no_scenes_no_targets(data: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no folder of scenes"):
        task_of(run_of(data, None), tmp_path)


@pytest.fixture(scope="module")
def bundle(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    def distance(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        return (a - b).square().mean(dim=(1, 2, 3))

    path = train_fixer(
        run_of(data, data / "scenes"),
        tmp_path_factory.mktemp("run") / "appearance",
        ("squared", distance),
    )
    assert len((path.parent / "log.jsonl").read_text().splitlines()) == 4, (
        "four times the updates of V9"
    )
    return path


def fixed(bundle: Path, *overrides: str) -> Any:
    name, settings = bundle_fixer(bundle)
    frames = moving_picture(9)
    session: Any = build(resolve("fixer", name, (*settings, *overrides)), scene_id="s", seed=0)
    return session, pixels(run_blocks(session, frames, maps_of(frames)))


def test_the_bundle_renders_what_the_prompt_asks_for_and_is_clear_by_itself(bundle: Path) -> None:
    tensors = load_weights(bundle)
    assert {key for key in tensors if key.startswith("prompt.")} == {
        f"prompt.{style}" for style in STYLES
    }
    session, plain = fixed(bundle)
    assert isinstance(session.settings, OneFixerSettings)
    assert (session.settings.prompt, session.settings.shows_render) == (CLEAR, True)
    night, out = fixed(bundle, "prompt=night")
    assert night.label.endswith("prompt night")
    assert not night.settings.shows_render
    assert not night.settings.keeps_appearance, "refine does not take it for damage"
    assert (out != plain).any()
    weights = [net.networks.dit.state_dict() for net in (session, night)]
    assert all(torch.equal(value, weights[1][key]) for key, value in weights[0].items()), (
        "the embeddings alone differ"
    )
    assert (fixed(bundle, "prompt=fog")[1] != out).any()


@pytest.mark.parametrize(
    ("prompt", "found"),
    [
        ("rain", "its weights learned the prompts clear, fog, night, snow"),
        ("null", "choose one: --set fixer.prompt="),
    ],
)
def test_a_prompt_that_was_not_learned_is_refused(bundle: Path, prompt: str, found: str) -> None:
    with pytest.raises(InputError) as caught:
        fixed(bundle, f"prompt={prompt}")
    assert found in str(caught.value)


def test_weights_without_prompts_refuse_one() -> None:
    with pytest.raises(InputError) as caught:
        load_networks(small_settings("prompt=night"))
    assert "choosing a prompt" in str(caught.value)
    assert "its weights learned no prompts" in str(caught.value)
    assert "--recipe appearance" in str(caught.value)
