"""The folder of a run: what is in it (`schema`, `shapes`), how it is written, read, checked and
repaired.

It knows files and tables, not how they come about: it imports neither the loop nor the evaluators.
What a metric means is theirs; here it is a column of numbers with a column that tells where they
are valid.
"""
