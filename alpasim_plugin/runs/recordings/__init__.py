"""Logged rollouts as recordings of other people's viewers: MCAP for Foxglove, .rrd for Rerun."""
