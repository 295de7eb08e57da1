"""The laboratory's verbs: train, judge, bench."""
