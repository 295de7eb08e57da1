"""The paper's tables beside ours, its claims with a verdict each, and all systems side by side on
one page.
"""
