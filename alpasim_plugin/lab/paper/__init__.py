"""The paper's comparison as one experiment: its stages, its tables, its claims."""
