"""The transformer written out once more from the published description: plain functions, float64,
one explicit mask.

Shares no code with the package. Slow and meant to be read beside docs/fixers.md.
"""

import math

import torch
from einops import rearrange, repeat
from torch.nn.functional import (
    gelu,
    layer_norm,
    linear,
    rms_norm,
    scaled_dot_product_attention,
    silu,
)

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
    return rms_norm(x, gain.shape, gain, 1e-6)


def norm(x):
    return layer_norm(x, x.shape[-1:], eps=1e-6)


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
    heads = (x.transpose(1, 2) for x in (q, k, v))
    return rearrange(scaled_dot_product_attention(*heads, mask), "b h l d -> b l (h d)")


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
    rows = height // 2
    columns = width // 2
    nothing = torch.zeros_like(x[:, :1])
    masks = [nothing if mask is None else mask.double() for mask in (condition_mask, padding_mask)]

    def apply(name, y):
        return linear(y, sd[f"{name}.weight"], sd.get(f"{name}.bias"))

    def cut(y):
        return rearrange(y, "b c t (h p) (w q) -> b (t h w) (c p q)", p=2, q=2)

    name = "additional_patch_embedding.proj.1"
    maps = sd[f"{name}.weight"].shape[1] // 4
    stream = apply("x_embedder.proj.1", cut(torch.cat([x, *masks], 1)))
    stream = stream + apply(name, cut(hdmap[:, :maps]))
    opacity = cut(hdmap[:, maps:])  # of no channels where the network embeds none
    d = stream.shape[-1]

    angle = (t * 0.001)[..., None] * 10000 ** (-torch.arange(d // 2).double() / (d // 2))
    sinusoid = torch.cat([angle.cos(), angle.sin()], -1)
    emb = rms(sinusoid, sd["t_embedding_norm.weight"])
    lora = apply("t_embedder.1.linear_2", silu(apply("t_embedder.1.linear_1", sinusoid)))
    context = gelu(apply("crossattn_proj.0", text))

    def modulation(name, parts):
        low = apply(f"{name}.2", apply(f"{name}.1", silu(emb))) + lora[..., : parts * d]
        return repeat(low, "b t d -> b (t n) d", n=rows * columns).chunk(parts, -1)

    head_width = len(sd["blocks.0.self_attn.q_norm.weight"])
    angles = rope_angles(start, frames, rows, columns, head_width, ratios)
    causal = latent_mask(frames, block or frames, window, sink)
    causal = causal.repeat_interleave(rows * columns, 0).repeat_interleave(rows * columns, 1)

    def heads(y, name, part):
        y = rearrange(apply(f"{name}.{part}_proj", y), "b l (h d) -> b l h d", d=head_width)
        gain = sd.get(f"{name}.{part}_norm.weight")
        return y if gain is None else rms(y, gain)

    i = 0
    while f"blocks.{i}.mlp.layer1.weight" in sd:
        for sub in ("self_attn", "cross_attn", "mlp"):
            shift, scale, gate = modulation(f"blocks.{i}.adaln_modulation_{sub}", 3)
            y = norm(stream) * (1 + scale) + shift
            name = f"blocks.{i}.{sub}"
            if sub == "self_attn" and opacity.shape[-1]:
                y = y + apply(f"blocks.{i}.opacity_embed", opacity)
            if sub == "mlp":
                y = apply(f"{name}.layer2", gelu(apply(f"{name}.layer1", y)))
            else:
                is_self = sub == "self_attn"
                source = y if is_self else context.expand(b, *context.shape[1:])
                q, k, v = heads(y, name, "q"), heads(source, name, "k"), heads(source, name, "v")
                if is_self:
                    q = rotate(q, angles)
                    k = rotate(k, angles)
                y = apply(f"{name}.output_proj", attend(q, k, v, causal if is_self else None))
            stream = stream + gate * y
        i += 1
    shift, scale = modulation("final_layer.adaln_modulation", 2)
    out = apply("final_layer.linear", norm(stream) * (1 + scale) + shift)
    return rearrange(
        out, "b (t h w) (p q c) -> b c t (h p) (w q)", t=frames, h=rows, w=columns, p=2, q=2
    )
