"""The transformer written out once more from the published description: plain functions, float64,
one explicit mask.

Shares no code with the package. Slow and meant to be read beside docs/fixers.md.
"""

import math

import torch
from einops import rearrange, repeat

from alpasim_plugin.block_fixers.dit import initial_weights


def random_weights(sizes, seed=0):
    """Draw weights that leave no path at zero; gains are around 1."""
    g = torch.Generator().manual_seed(seed)
    out = {}
    for key, value in initial_weights(sizes, 0).items():
        x = torch.randn(value.shape, generator=g)
        out[key] = 1 + 0.1 * x if key.endswith("norm.weight") else x / math.sqrt(x.shape[-1])
    return out


def rms(x, gain):
    return x / (x.pow(2).mean(-1, keepdim=True) + 1e-6).sqrt() * gain


def norm(x):
    return (x - x.mean(-1, keepdim=True)) / (x.var(-1, unbiased=False, keepdim=True) + 1e-6).sqrt()


def silu(x):
    return x / (1 + torch.exp(-x))


def gelu(x):
    return x * 0.5 * (1 + torch.erf(x / math.sqrt(2)))


def rope_angles(start, frames, rows, columns, head_width, ratios):
    """(frames * rows * columns, head_width): t, h, w angles, twice."""
    spatial = 2 * (head_width // 6)
    out = []
    for t in range(start, start + frames):
        for h in range(rows):
            for w in range(columns):
                angle = []
                for position, width, ratio in (
                    (t, head_width - 2 * spatial, ratios[2]),
                    (h, spatial, ratios[0]),
                    (w, spatial, ratios[1]),
                ):
                    theta = 10000 * ratio ** (width / (width - 2)) if width > 2 else 1.0
                    angle += [position / theta ** (2 * k / width) for k in range(width // 2)]
                out.append(angle + angle)
    return torch.tensor(out, dtype=torch.float64)


def rotate(x, angles):
    half = x.shape[-1] // 2
    turned = torch.cat([-x[..., half:], x[..., :half]], dim=-1)
    return x * angles.cos()[:, None] + turned * angles.sin()[:, None]


def attend(q, k, v, mask):
    scores = torch.einsum("bqhd,bkhd->bhqk", q, k) / math.sqrt(q.shape[-1])
    weights = scores.masked_fill(~mask, -torch.inf).softmax(-1)
    return rearrange(torch.einsum("bhqk,bkhd->bqhd", weights, v), "b l h d -> b l (h d)")


def latent_mask(frames, block, window=None, sink=0):
    """(frames, frames) bool: which latent sees which."""
    mask = torch.zeros(frames, frames, dtype=torch.bool)
    for q in range(frames):
        start = q - q % block
        end = min(start + block, frames)
        for k in range(end):
            recent = window is None or k >= end - (window - sink)
            mask[q, k] = k >= start or recent or k < sink
    return mask


def velocity(
    sd,
    x,
    t,
    text,
    hdmap,
    condition_mask=None,
    block=2,
    ratios=(3.0, 3.0, 1.0),
    padding_mask=None,
    window=None,
    sink=0,
    start=0,
):
    """Return the velocity of a whole clip in float64; arguments as in `CosmosCausalDiT.forward`."""
    sd = {key: value.double() for key, value in sd.items() if value.is_floating_point()}
    x, t, text, hdmap = (a.double() for a in (x, t, text, hdmap))
    b, _, frames, height, width = x.shape
    rows, columns = height // 2, width // 2
    condition = (
        torch.zeros(b, 1, frames, height, width).double()
        if condition_mask is None
        else condition_mask.double()
    )
    padding = (
        torch.zeros(b, 1, frames, height, width).double()
        if padding_mask is None
        else padding_mask.double()
    )
    cut = "b c t (h p) (w q) -> b (t h w) (c p q)"
    stream = (
        rearrange(torch.cat([x, condition, padding], 1), cut, p=2, q=2)
        @ sd["x_embedder.proj.1.weight"].T
    )
    maps = sd["additional_patch_embedding.proj.1.weight"].shape[1] // 4
    stream = (
        stream
        + rearrange(hdmap[:, :maps], cut, p=2, q=2)
        @ sd["additional_patch_embedding.proj.1.weight"].T
    )
    opacity = rearrange(
        hdmap[:, maps:], cut, p=2, q=2
    )  # of no channels where the network embeds none
    d = stream.shape[-1]

    angle = (t * 0.001)[..., None] * torch.exp(
        -math.log(10000) * torch.arange(d // 2).double() / (d // 2)
    )
    sinusoid = torch.cat([angle.cos(), angle.sin()], -1)
    emb = rms(sinusoid, sd["t_embedding_norm.weight"])
    lora = (
        silu(sinusoid @ sd["t_embedder.1.linear_1.weight"].T) @ sd["t_embedder.1.linear_2.weight"].T
    )
    context = gelu(text @ sd["crossattn_proj.0.weight"].T + sd["crossattn_proj.0.bias"])

    def modulation(name, parts):
        low = (
            silu(emb) @ sd[f"{name}.1.weight"].T @ sd[f"{name}.2.weight"].T + lora[..., : parts * d]
        )
        return repeat(low, "b t d -> b (t n) d", n=rows * columns).chunk(parts, -1)

    angles = rope_angles(
        start, frames, rows, columns, sd["blocks.0.self_attn.q_norm.weight"].shape[0], ratios
    )
    causal = (
        latent_mask(frames, block or frames, window, sink)
        .repeat_interleave(rows * columns, 0)
        .repeat_interleave(rows * columns, 1)
    )
    everything = torch.ones(1, 1, dtype=torch.bool)

    def heads(y, name, part):
        gain = sd.get(f"{name}.{part}_norm.weight")
        y = rearrange(
            y @ sd[f"{name}.{part}_proj.weight"].T,
            "b l (h d) -> b l h d",
            d=sd[f"{name}.q_norm.weight"].shape[0],
        )
        return y if gain is None else rms(y, gain)

    i = 0
    while f"blocks.{i}.mlp.layer1.weight" in sd:
        for sub in ("self_attn", "cross_attn", "mlp"):
            shift, scale, gate = modulation(f"blocks.{i}.adaln_modulation_{sub}", 3)
            y = norm(stream) * (1 + scale) + shift
            name = f"blocks.{i}.{sub}"
            if sub == "self_attn" and opacity.shape[-1]:
                y = y + opacity @ sd[f"blocks.{i}.opacity_embed.weight"].T
            if sub == "mlp":
                y = gelu(y @ sd[f"{name}.layer1.weight"].T) @ sd[f"{name}.layer2.weight"].T
            else:
                source = y if sub == "self_attn" else context.expand(b, *context.shape[1:])
                q = heads(y, name, "q")
                k = heads(source, name, "k")
                v = heads(source, name, "v")
                if sub == "self_attn":
                    q, k = rotate(q, angles), rotate(k, angles)
                y = (
                    attend(q, k, v, causal if sub == "self_attn" else everything)
                    @ sd[f"{name}.output_proj.weight"].T
                )
            stream = stream + gate * y
        i += 1
    shift, scale = modulation("final_layer.adaln_modulation", 2)
    out = (norm(stream) * (1 + scale) + shift) @ sd["final_layer.linear.weight"].T
    return rearrange(
        out, "b (t h w) (p q c) -> b c t (h p) (w q)", t=frames, h=rows, w=columns, p=2, q=2
    )
