"""One file per fixer, named after it."""
