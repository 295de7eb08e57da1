"""Published numbers that ours are printed beside."""
