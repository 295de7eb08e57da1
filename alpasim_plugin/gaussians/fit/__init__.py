"""Reconstruct a scene: fit 3D Gaussians to posed views.

`logged_views` gives views, `start_from_depth` gives a start, and
`loop.fit` the `Reconstruction`.
"""
