"""Budgets at which the comparison of the paper is made again (`simrun bench paper`)."""
