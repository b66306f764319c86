"""Tuning: searches the declared parameters of any estimator on any scenario, for the best value of any metric.

`testbed.tuning.tune` drives it, `search` holds the ask/tell interface, one module per algorithm its equations. What an
algorithm sees are coordinates in a box; `space` turns them into parameters.
"""
