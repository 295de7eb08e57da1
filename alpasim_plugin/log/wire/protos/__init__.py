"""Wire messages in private packages (``simrun.wire.*``): the ``.proto`` files, and what
tests/alpasim/compile_protos.py made of them.
"""
