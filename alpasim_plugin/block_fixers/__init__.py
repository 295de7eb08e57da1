"""The generators of frames in blocks: causal transformer on the latents of a video autoencoder, in
chunks or along predicted poses.
"""
