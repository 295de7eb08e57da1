"""Reading with limits, atomic writes, checksums, locks, the cache, configuration with positions."""
