"""Where work runs: processes of this machine, the nodes of a Ray cluster, jobs of Slurm. Results do
not depend on it.
"""
