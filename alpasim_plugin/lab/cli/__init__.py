"""The laboratory's verbs: train and bench."""
