"""The semantic map that conditions a fixer: its layers, prepared once per scene and drawn once per
frame.
"""
