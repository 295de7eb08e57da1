"""Places that nobody drives through: furnished rooms, objects on a table, garden paths; of textured
surfels, lit by lamps or the sun.
"""
