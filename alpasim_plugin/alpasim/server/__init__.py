"""Services that AlpaSim's runtime calls: the renderer's (`sensorsim`) and the video model's
(`world_model`).
"""
