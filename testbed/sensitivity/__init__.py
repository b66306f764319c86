"""Sensitivity: which line of a data sheet decides a result.

`study.sensitivity` drives it: figures of a scenario (`factors`) are moved over ranges after a plan (`design`: Morris, Sobol),
every point is sensed and estimated with the same random numbers (`evaluate`), and the indices (`indices`) say how much of
a metric's variance each figure makes.
"""
