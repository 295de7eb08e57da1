"""Reports from a run folder: HTML, Markdown, JUnit and the terminal table. A pure reader: no
renderer, no policy, no scenario files.
"""
