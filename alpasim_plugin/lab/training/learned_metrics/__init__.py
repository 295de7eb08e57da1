"""Training of the judges: networks that measure images and are used in no loss
(docs/lab/judges.md).
"""
