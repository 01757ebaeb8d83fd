"""The two papers again, in simulation: ``python -m sim.papers`` writes docs/papers.md.

One module a group of tables and figures; what is labelled "ours" is computed in the run, what is
labelled "theirs" stands in ``published`` with its source.
"""
