"""Networks that judge images: lanes, cuboids, features of video, style. They measure, and are used
in no loss (docs/lab/judges.md).
"""
