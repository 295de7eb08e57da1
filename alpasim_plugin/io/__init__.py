"""Reading with limits, atomic writes, checksums, locks, configuration with positions."""
