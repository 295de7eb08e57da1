"""The semantic map that conditions a fixer: what it shows, prepared once a scene, drawn once a frame."""
