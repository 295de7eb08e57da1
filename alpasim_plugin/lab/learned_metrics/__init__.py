"""What learned networks and classical trackers measure: lanes, cuboids, Frechet distances, motion
(docs/lab/judges.md). No torch here.
"""
