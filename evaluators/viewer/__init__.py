"""Watch rollouts: one offline page that replays them, and a server on this machine that shows a run
while it goes on.
"""
