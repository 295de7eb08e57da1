"""Options of a training that takes seconds."""

SIZES = [
    "--set",
    "fixer.generator.widths=[8,8,8]",
    "--set",
    "fixer.generator.detail=8",
    "--set",
    "fixer.generator.hidden=4",
]
FEW = [
    "--streams",
    "2",
    "--frames",
    "2",
    "--crop",
    "48x32",
    "--precision",
    "fp32",
    "--threads",
    "1",
]
