"""Recorded calls are eager calls bit for bit; the past stays the caller's; nothing falls back in
silence.
"""

from __future__ import annotations

import pytest
import torch

from alpasim_plugin.block_fixers.dit import CosmosCausalDiT
from alpasim_plugin.block_fixers.graphs import CudaRecorder, GraphedFunction
from alpasim_plugin.block_fixers.networks import at_precision, codec_at_precision, text_at_precision
from alpasim_plugin.block_fixers.sampling import finalise, mixed_source, sample_block
from alpasim_plugin.block_fixers.sizes import DiTSizes
from alpasim_plugin.block_fixers.tiny_vae import TinyVAE
from alpasim_plugin.block_fixers.tiny_vae_nets import TinySizes
from alpasim_plugin.core.errors import InfrastructureError
from alpasim_plugin.fixers.network.schedule import steps
from tests.block_fixers.cache_history import history
from tests.block_fixers.dit_reference import random_weights
from tests.block_fixers.eager_recorder import EagerRecorder
from tests.examples import first_of

SIZES = DiTSizes(
    width=32, blocks=2, head_width=16, mlp_width=48, adaln_rank=4, text_width=6, context_width=8
)


class Drive:
    """A rollout of blocks: render and map encoded side by side, one step, decoded, the history
    finalised.
    """

    def __init__(self, recorder=None, device="cpu", precision="fp32", window=4):
        net = CosmosCausalDiT.from_state_dict(random_weights(SIZES)).to(device)
        self.text = text_at_precision(
            net.encode_text(torch.ones(1, 3, 6, device=device)), precision
        )
        self.net, self.writer = (at_precision(net.folded(t), precision) for t in (1000.0, 128.0))
        self.vae = codec_at_precision(TinyVAE.random(TinySizes(16, 16, 16, 16, 16)), precision).to(
            device
        )
        self.cache = self.net.new_cache(1, 4, 6, window=window)
        self.function = (
            self.block if recorder is None else GraphedFunction(self.block, recorder, warmups=1)
        )
        self.graphed, self.device = recorder is not None, device
        self.states = (None, None)

    def block(self, views, m, noise, encoder, decoder):
        z, encoder = self.vae.encode_next(views, encoder)
        z_render, z_map = z.float().split(1)
        z_0 = sample_block(
            self.net,
            [mixed_source(z_render, m, noise[0])],
            self.text,
            z_map,
            self.cache,
            steps(1),
            "last-forward",
            commit=False,
        )
        finalise(self.writer, z_0, noise[1], self.text, z_map, self.cache, commit=False)
        out, decoder = self.vae.decode_next(z_0, decoder, render=views[:1])
        return out, encoder, decoder

    @torch.inference_mode()
    def push(self, index):
        g = torch.Generator().manual_seed(index)
        views = torch.rand(2, 3, 8 if index else 5, 32, 48, generator=g) * 2 - 1
        m = (torch.rand(1, 1, 2, 4, 6, generator=g) > 0.5).float()
        noise = [torch.randn(1, 16, 2, 4, 6, generator=g) for _ in range(2)]
        args = [
            views.to(self.device),
            m.to(self.device),
            [eps.to(self.device) for eps in noise],
            *self.states,
        ]
        self.cache.begin(2)
        out, *self.states = (
            self.function(*args, key=self.cache.visible) if self.graphed else self.function(*args)
        )
        self.cache.commit()
        return out


def addresses(cache):
    table = cache.begin(2)
    return [part.data_ptr() for part in (cache.keys, cache.values, cache._rows, *table)]


@pytest.mark.parametrize("precision", first_of(["fp32", "bf16"]))
def test_replayed_blocks_are_eager_blocks_bit_for_bit(precision):
    eager, recorded = Drive(precision=precision), Drive(EagerRecorder(), precision=precision)
    places = []
    for index in range(9):
        assert torch.equal(recorded.push(index), eager.push(index)), index
        places.append(addresses(recorded.cache))
    # blocks 0 to 2 have shapes of their own (first frame, window filling, codecs' memories), the
    # fourth warms up
    assert recorded.function.counts["replayed"] >= 4
    assert recorded.function.counts["recorded"] == 1
    assert sum(recorded.function.counts.values()) == 9
    assert all(place == places[1] for place in places[1:]), "the cache moved"
    for layer in range(SIZES.blocks):
        for ours, theirs in zip(
            history(recorded.cache, layer), history(eager.cache, layer), strict=True
        ):
            assert torch.equal(ours, theirs)


def test_results_and_states_outlive_later_calls():
    drive = Drive(EagerRecorder())
    kept = []
    for index in range(7):
        out = drive.push(index)
        kept.append(
            (
                out,
                out.clone(),
                drive.states,
                [[part.clone() for part in state] for state in drive.states],
            )
        )
    for out, copy, states, copies in kept:
        assert torch.equal(out, copy)
        assert all(
            torch.equal(a, b)
            for state, then in zip(states, copies, strict=True)
            for a, b in zip(state, then, strict=True)
        )


def test_a_block_can_be_run_again_from_a_remembered_state():
    drive, eager = Drive(EagerRecorder()), Drive()
    for index in range(6):
        drive.push(index), eager.push(index)
    with torch.inference_mode():
        before = drive.states
        drive.cache.begin(2)
        wrong = drive.function(
            torch.ones(2, 3, 8, 32, 48),
            torch.ones(1, 1, 2, 4, 6),
            [torch.ones(1, 16, 2, 4, 6)] * 2,
            *before,
            key=4,
        )
    drive.states = before  # the guess is taken back
    assert torch.equal(drive.push(6), eager.push(6))
    assert wrong[0].shape == (1, 3, 8, 32, 48)


def test_another_shape_or_key_is_another_recording_and_the_limit_holds():
    calls = []

    def function(x):
        calls.append(x.shape)
        return {"twice": 2 * x, "none": None}

    graphed = GraphedFunction(function, EagerRecorder(), warmups=0, limit=2)
    for size, key in ((1, 0), (2, 0), (1, 0), (1, 1), (3, 0)):
        assert torch.equal(
            graphed(torch.full((size,), 3.0), key=key)["twice"], torch.full((size,), 6.0)
        )
    assert dict(graphed.counts) == {"recorded": 2, "replayed": 1, "beyond limit": 2}


def test_arguments_are_left_alone_and_none_may_be_among_them():
    graphed = GraphedFunction(lambda pair, other: (pair[0] + 1, other), EagerRecorder(), warmups=0)
    x = torch.zeros(3)
    for value in (1.0, 2.0):
        x.fill_(value)
        out, none = graphed((x, None), None)
        assert out.tolist() == [value + 1] * 3
        assert none is None
        assert x.tolist() == [value] * 3


def test_results_are_not_there_before_the_replay():
    """The eager recorder must also leave its outputs undefined before the first replay, as a graph
    does.
    """
    recording = EagerRecorder().record(lambda: (torch.ones(2), torch.ones(2, dtype=torch.long)))
    assert recording.outputs[0].isnan().all()
    assert not recording.outputs[1].any()
    recording.replay()
    assert recording.outputs[0].tolist() == [1, 1]


def test_what_cannot_be_recorded_is_an_error():
    class Broken:
        def record(self, function):
            raise InfrastructureError("cuda:0: operation not permitted", "run without graphs")

    with pytest.raises(InfrastructureError, match="run without graphs"):
        GraphedFunction(lambda x: x, Broken(), warmups=0)(torch.zeros(1))


@pytest.mark.gpu
@pytest.mark.parametrize("precision", ["fp32", "bf16", "fp16"])
def test_cuda_graph_replays_are_eager_blocks(precision):
    device = torch.device("cuda")
    eager, recorded = Drive(None, device, precision), Drive(CudaRecorder(device), device, precision)
    for index in range(12):
        assert torch.equal(recorded.push(index), eager.push(index)), index
    assert recorded.function.counts["replayed"] >= 6


@pytest.mark.gpu
def test_a_function_that_waits_for_the_device_is_refused():
    graphed = GraphedFunction(
        lambda x: x + float(x.sum()), CudaRecorder(torch.device("cuda")), warmups=0
    )
    with pytest.raises(InfrastructureError, match="recording a CUDA graph"):
        graphed(torch.ones(2, device="cuda"))


def test_counts_say_how_every_call_ran():
    double = GraphedFunction(lambda x: 2 * x, EagerRecorder(), warmups=1)
    assert [float(double(torch.tensor(float(i)))) for i in range(3)] == [0.0, 2.0, 4.0]
    assert dict(double.counts) == {"eager": 1, "recorded": 1, "replayed": 1}
