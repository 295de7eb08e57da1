"""Wire messages in private packages (``simrun.wire.*``): the ``.proto`` files, and what `compile.py` made of them."""
