"""Wire messages in private packages (``simrun.wire.*``), compiled from the ``.proto`` files here when the package is built."""
