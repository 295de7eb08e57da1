"""Contents of a KV cache in order of time, for comparisons."""


def history(cache, layer):
    """Return a layer's cached keys and values, oldest first, ``(B, latents * tokens, heads,
    head_width)``.
    """
    ring = cache.window - cache.sink
    rolling = range(max(cache.sink, cache.filled - ring), cache.filled)
    slots = [
        *range(min(cache.sink, cache.filled)),
        *(cache.sink + (i - cache.sink) % ring for i in rolling),
    ]
    rows = cache._token_rows(slots).to(cache.device)
    return tuple(cache.buffers[layer][:, :, rows])
