"""The image systems of the comparison: one step from the render, and windows from noise."""
